"""Comparison of VMDNN with variants of itself and with networks of other kinds (rivals)."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.table import Table

from actors.tasks.registry import make_pretraining_task
from learner.rivals.networks import weights_of
from learner.rivals.rival_recipe import make_recipe
from learner.tutoring.store import TutoringStore
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from services.playing.tutoring import check_recorded, record, repeated_jobs
from services.terminal.rates import percent_text, rate_text
from services.trials.success import READINGS, Tally, difference95, pooled
from services.trials.sweeps import RunOutcomes, Variant, training_s

VMDNN: Final = "vmdnn"
FIXED_GAZE: Final = "fixed-gaze"

ONE_TAU: Final = 10.0
"""About the geometric mean of VMDNN's time constants 2, 30, 150, 10 and 2, which is 11.3."""


def _one_time_constant(name: str, config: Config) -> Variant:
    parts = ("mstnn_fast", "mstnn_slow", "pfc", "mtrnn_slow", "mtrnn_fast")
    return Variant.of(name, config, {f"network.{part}.tau": ONE_TAU for part in parts})


CONTENDERS: Final[Mapping[str, Callable[[str, Config], Variant]]] = {
    VMDNN: Variant,
    "one-time-constant": _one_time_constant,
    FIXED_GAZE: lambda name, config: Variant.of(name, config, {"task.attention": "fixed"}),
    "cnn-lstm": lambda name, config: Variant(name, config, rival="cnn-lstm"),
    "feed-forward": lambda name, config: Variant(name, config, rival="feed-forward"),
}
"""The networks to compare: VMDNN, variants of VMDNN, and networks of other kinds."""


def variants(config: Config, names: Sequence[str]) -> list[Variant]:
    """The contenders with these names."""
    return [CONTENDERS[name](name, config) for name in names]


def weights(variant: Variant) -> int:
    """Number of weights and biases of a contender."""
    questions = make_pretraining_task(variant.config).questions
    return weights_of(make_recipe(variant.config, variant.rival, questions).network)


def repeat_tutoring(
    store: TutoringStore, variant: Variant, active: Config, folder: Path, *, workers: int
) -> Generator[Episode, None, None]:
    """Repeat the tutoring in a store, its cases and noise, with a variant's config.

    Args:
        store: sequences that were tutored with the config `active`; their task may be another.
        variant: the variant that will learn from the repetition.
        active: the config of VMDNN.
        folder: where episodes are recorded; those already there are not played again.
        workers: processes to play in.

    Yields:
        All episodes.

    Raises:
        UserError: a sequence was tutored with another config, or it is a correction.
    """
    task = {"task.name": _task_of(store)}
    check_recorded(store.folder, Variant.of("data", active, task).config)
    jobs = repeated_jobs(store, folder)
    config = Variant.of(variant.name, variant.config, task).config
    return record(config, jobs, folder, workers=workers)


def _task_of(store: TutoringStore) -> str:
    episodes = (store.load(name) for name in store.ids)
    first: Episode | None = next(filter(None, episodes), None)
    if first is None:
        raise UserError(f"{store.folder} holds no sequence that can be read")
    return first.task


@dataclass(frozen=True)
class Score:
    """Results of one contender.

    Attributes:
        variant: the contender.
        by_seed: counted trials by training seed.
        training_s: processor time of a training, mean over the seeds (s).
    """

    variant: Variant
    by_seed: Mapping[int, Tally]
    training_s: float


def scores(tested: Sequence[RunOutcomes]) -> list[Score]:
    """Results of each contender, in the order of `tested`."""
    by_name: dict[str, list[RunOutcomes]] = {}
    for each in tested:
        by_name.setdefault(each.run.variant.name, []).append(each)
    return [
        Score(
            variant=group[0].run.variant,
            by_seed={each.run.seed: Tally.of(each.outcomes) for each in group},
            training_s=sum(training_s(each.run) for each in group) / len(group),
        )
        for group in by_name.values()
    ]


def numbers(found: Sequence[Score]) -> dict[str, Any]:
    """All results, for `json.dumps`."""
    return {
        "contenders": [
            {
                "name": each.variant.name,
                "weights": weights(each.variant),
                "training_s": each.training_s,
                "trials": sum(tally.trials for tally in each.by_seed.values()),
                "pooled": {
                    reading: pooled(each.by_seed.values(), reading).as_json()
                    for reading in READINGS
                },
                "by_seed": {str(seed): tally.as_json() for seed, tally in each.by_seed.items()},
                "against_vmdnn": _against_vmdnn(found, each),
            }
            for each in found
        ]
    }


def table(found: Sequence[Score]) -> Table:
    """Success by contender and reading."""
    result = Table(
        caption="% of the trials of all seeds with 95 % Wilson intervals, and by seed; the"
        " intervals cover the choice of trials, the seeds show how networks differ; weights include"
        " biases; minutes are processor time of training one network"
    )
    for heading in ("network", "reading", "all seeds", "by seed"):
        result.add_column(heading, no_wrap=heading != "by seed")
    for each in found:
        about = (
            each.variant.name,
            f"{weights(each.variant)} weights",
            f"{each.training_s / 60:.1f} min",
        )
        for line, reading in zip(about, READINGS, strict=True):
            rate = pooled(each.by_seed.values(), reading)
            seeds = (percent_text(tally.rate(reading).rate, 0) for tally in each.by_seed.values())
            result.add_row(line, reading, rate_text(rate), ", ".join(seeds))
        result.add_section()
    return result


def _against_vmdnn(found: Sequence[Score], each: Score) -> dict[str, Any]:
    """Return its rates minus those of VMDNN; empty for VMDNN, and if VMDNN was not tested."""
    vmdnn = next((other for other in found if other.variant.name == VMDNN), None)
    if vmdnn is None or vmdnn is each:
        return {}
    against = {}
    for reading in READINGS:
        ours, theirs = (pooled(one.by_seed.values(), reading) for one in (each, vmdnn))
        interval = list(difference95(ours, theirs))
        against[reading] = {"difference": ours.rate - theirs.rate, "interval95": interval}
    return against
