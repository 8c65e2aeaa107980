"""VMDNN beside variants of itself and networks of other kinds, on the same sequences."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.table import Table

from learner.network.subnets import subnets
from learner.rivals.networks import make_rival, rival_config, weights_of
from learner.tutoring.store import TutoringStore
from proto.config import Config
from proto.episode import Episode
from proto.errors import UserError
from services.playing.tutoring import check_recorded, record, tutoring_jobs_again
from services.trials.success import READINGS, Tally, difference95, pooled
from services.trials.sweeps import Tested, Variant, training_s

VMDNN: Final = "vmdnn"
FIXED_GAZE: Final = "fixed-gaze"

ONE_TAU: Final = 10.0
"""The middle of VMDNN's time constants: the geometric mean of 2, 30, 150, 10 and 2 is 11.3."""


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
"""What is compared: VMDNN, then what it does without, then what else could be in its place."""


def variants(config: Config, names: Sequence[str]) -> list[Variant]:
    """The contenders with these names."""
    return [CONTENDERS[name](name, config) for name in names]


def weights(variant: Variant) -> int:
    """Number of weights and biases of a contender."""
    config = variant.config
    if variant.rival is None:
        parts = subnets(config.network).values()
        return sum(part.weights + part.biases for part in parts)
    units = rival_config(config.comparison, variant.rival).units
    return weights_of(make_rival(variant.rival, units, config.network))


def tutored_again(
    store: TutoringStore, variant: Variant, active: Config, folder: Path, *, workers: int
) -> Generator[Episode, None, None]:
    """Tutor a variant in what a store shows, its cases and its noise, and yield all episodes.

    Args:
        store: sequences that were tutored as the config `active` says, but for the task.
        variant: who is to learn from it.
        active: the config of VMDNN.
        folder: where the episodes are recorded; what it holds is not played again.
        workers: processes to play in.

    Raises:
        UserError: a sequence was shown otherwise, or not by the tutor alone.
    """
    task = {"task.name": _task_of(store)}
    check_recorded(store.folder, Variant.of("data", active, task).config)
    jobs = tutoring_jobs_again(store, folder)
    config = Variant.of(variant.name, variant.config, task).config
    return record(config, jobs, folder, workers=workers)


def _task_of(store: TutoringStore) -> str:
    episodes = (store.load(name) for name in store.ids)
    first: Episode | None = next(filter(None, episodes), None)
    if first is None:
        raise UserError(f"{store.folder} holds no sequence that can be read")
    return first.task


@dataclass(frozen=True)
class Standing:
    """How one contender did.

    Attributes:
        variant: the contender.
        by_seed: what was counted by training seed.
        training_s: processor time of a training, mean over the seeds (s).
    """

    variant: Variant
    by_seed: Mapping[int, Tally]
    training_s: float


def standings(tested: Sequence[Tested]) -> list[Standing]:
    """How each contender did, in the order of `tested`."""
    by_name: dict[str, list[Tested]] = {}
    for each in tested:
        by_name.setdefault(each.member.variant.name, []).append(each)
    return [
        Standing(
            variant=group[0].member.variant,
            by_seed={each.member.seed: Tally.of(each.outcomes) for each in group},
            training_s=sum(training_s(each.member) for each in group) / len(group),
        )
        for group in by_name.values()
    ]


def numbers(found: Sequence[Standing]) -> dict[str, Any]:
    """All that was found, for `json.dumps`."""
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


def table(found: Sequence[Standing]) -> Table:
    """Success by contender and reading."""
    result = Table(
        caption="% of all seeds' trials with 95 % Wilson intervals, and by seed; the intervals are"
        " of trials: how far networks differ, the seeds tell; weights count biases; minutes are the"
        " processor's, for the training of one network"
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
            low, high = rate.wilson95
            seeds = (f"{100 * tally.rate(reading).rate:.0f}" for tally in each.by_seed.values())
            result.add_row(
                line,
                reading,
                f"{100 * rate.rate:.1f} ({100 * low:.1f} to {100 * high:.1f})",
                ", ".join(seeds),
            )
        result.add_section()
    return result


def _against_vmdnn(found: Sequence[Standing], each: Standing) -> dict[str, Any]:
    """How much higher its rates are than VMDNN's, where that was tested too."""
    vmdnn = next((other for other in found if other.variant.name == VMDNN), None)
    if vmdnn is None or vmdnn is each:
        return {}
    against = {}
    for reading in READINGS:
        ours, theirs = (pooled(one.by_seed.values(), reading) for one in (each, vmdnn))
        interval = list(difference95(ours, theirs))
        against[reading] = {"difference": ours.rate - theirs.rate, "interval95": interval}
    return against
