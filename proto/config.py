"""The configuration of a run, read from YAML. Every value is checked; unknown keys are refused."""

from __future__ import annotations

import hashlib
import json
import logging
import reprlib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self
from zlib import crc32

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails

from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.disturbances import DISTURBANCES
from proto.errors import UserError
from proto.plain_text import plain, plain_lines
from proto.reading import read_limited
from proto.seeds import PRACTICE, SEEDS_PER_CASE, TRIALS_BELOW
from proto.storage import written_whole
from proto.strict_yaml import (
    DEEPEST,
    LONGEST,
    MOST_VALUES,
    WrittenFloat,
    WrittenInt,
    dump_yaml,
    load_yaml,
)
from proto.suites import (
    BUILT_IN,
    MOST_STRETCH,
    MOST_SUITES,
    PRACTICE_OF_SUITE,
    PRACTICE_SEEDS,
    UNLEARNED,
    Suite,
    first_practice_seed,
    first_test_seed,
)

# Strict: a text or a truth value is not accepted as a number.
Switch = Annotated[bool, Field(strict=True)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
TimeConstant = Annotated[float, Field(strict=True, ge=1, le=1e6, allow_inf_nan=False)]
Natural = Annotated[int, Field(strict=True, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
# Limits of the sizes of a network. The compiled kernels take any size that is within them; together
# with the limits in `learner.network.subnets` they keep a network from taking all memory.
Units = Annotated[int, Field(strict=True, ge=1, le=4096)]
Maps = Annotated[int, Field(strict=True, ge=1, le=256)]
KernelWidth = Annotated[int, Field(strict=True, ge=1, le=IMAGE_WIDTH)]
KernelHeight = Annotated[int, Field(strict=True, ge=1, le=IMAGE_HEIGHT)]
Stride = Annotated[int, Field(strict=True, ge=1, le=IMAGE_WIDTH)]
# The outputs of all values together must fit into an episode, which holds at most 4096 of them.
SoftmaxUnits = Annotated[int, Field(strict=True, ge=2, le=256)]
CodeMargin = Annotated[float, Field(strict=True, ge=0, le=100, allow_inf_nan=False)]
CodeWidth = Annotated[float, Field(strict=True, ge=1e-3, le=100, allow_inf_nan=False)]


def _check_repeats(repeats: int) -> int:
    if repeats > SEEDS_PER_CASE:
        raise ValueError(
            f"must not exceed {SEEDS_PER_CASE}: each repeat needs one of the"
            f" {SEEDS_PER_CASE} seeds of its case"
        )
    return repeats


Repeats = Annotated[Count, AfterValidator(_check_repeats)]


def _expand_home(folder: Path) -> Path:
    try:
        return folder.expanduser()
    except RuntimeError as error:
        raise ValueError(f"~ cannot be expanded: {error}") from error


class _Section(BaseModel):
    """A section of the configuration; an empty section in YAML means all defaults."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _keep_texts_as_written(cls, values: Any) -> Any:
        """Accept an empty section; keep a number for a text field, `name: 007`, as written."""
        if values is None:
            return {}
        if not isinstance(values, dict):
            return values
        texts = {
            name for name, field in cls.model_fields.items() if field.annotation in (str, Path)
        }
        return {
            name: value.text
            if name in texts and isinstance(value, WrittenInt | WrittenFloat)
            else value
            for name, value in values.items()
        }


LOG = logging.getLogger(__name__)

_PROBLEMS_TOLD: Final = 20
_LONGEST_PROBLEM: Final = 1000
_REPR: Final = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 100
_RETIRED_KEYS: Final = (
    "network.image",
    "learner.pretraining.labels",
    "learner.pretraining.answer_part",
)
"""Keys that had an effect once: the size of images is fixed, and the task asks the questions."""


class RunConfig(_Section):
    """Name and folder of the run, and the seed of all random numbers in its training.

    Attributes:
        name: name of the run, of its folder and in the keys of its messages.
        folder: folder that holds the folders of runs.
        seed: seed of the weights and of all other random numbers in training.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)] = (
        "experiment1"
    )
    folder: Annotated[Path, AfterValidator(_expand_home)] = Path("runs")
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**32)] = 1


ActorName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,39}$")]


class HubConfig(_Section):
    """The hub that all processes connect to, and how the links to it are protected.

    `proto.security` checks that the values fit each other when a process connects or listens, so
    that a saved configuration can be read on any machine.

    Attributes:
        endpoint: where the hub listens and all others connect, as protocol/HOST:PORT.
        shared_memory: pass large messages between processes of one machine in shared memory.
        security: `mutual-tls`: both ends of every link show a certificate, and the hub lets each
            role do only what `proto.permissions` allows; needs an endpoint `tls/HOST:PORT`.
            `none`: only processes of this machine can connect.
        certificates: folder of the certificates; `~` is the home folder of each process.
        actors: names of actors with certificates of their own, `actor-NAME`.
        insecure: without security, allow an endpoint that other machines can reach.
    """

    endpoint: Annotated[str, Field(pattern=r"^(tcp|tls|udp|quic|ws)/.+:\d+$")] = (
        "tcp/127.0.0.1:7447"
    )
    shared_memory: Switch = False
    security: Literal["none", "mutual-tls"] = "none"
    certificates: Path = Path("~/.config/vmdnn/certificates")
    actors: tuple[ActorName, ...] = ()
    insecure: Switch = False


TaskName = Annotated[str, Field(min_length=1, max_length=200)]
"""Name of a built-in task, or a user's task class as `package.module:Class`."""


Attention = Literal["active", "fixed"]
"""active: the policy controls neck and focus; fixed: both stay as at the start."""


class TaskConfig(_Section):
    """The task that is tutored and tested.

    Attributes:
        name: a task of `actors.tasks.registry`, or a user's class as `package.module:Class`.
        attention: whether the policy controls neck and focus (`active`) or both stay as at the
            start (`fixed`).

    Other keys are options of the task, which checks them itself; see `options`.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    name: TaskName = "experiment1"
    attention: Attention = "active"

    @property
    def options(self) -> dict[str, Any]:
        """The task's options: all keys of the section except name and attention."""
        return dict(self.model_extra or {})


class SimulatorConfig(_Section):
    """The simulator and its time steps.

    Attributes:
        backend: name of the simulator.
        control_period_s: time of a control step.
        physics_period_s: time of a physics step; a control step is a whole number of them.
        render: render the eye image; without it the policy sees no picture.
    """

    backend: str = "sapien"
    control_period_s: Positive = 0.1
    physics_period_s: Positive = 0.005
    render: Switch = True

    @property
    def substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.control_period_s / self.physics_period_s)

    @model_validator(mode="after")
    def _periods_fit(self) -> Self:
        if abs(self.substeps * self.physics_period_s - self.control_period_s) > 1e-9:
            raise ValueError("control_period_s must be a whole multiple of physics_period_s")
        return self


class ActorConfig(_Section):
    """What actors do besides tutoring and trials.

    Attributes:
        practice: play random situations when learner and evaluator request nothing.
        live: publish each control step while there is a subscriber.
    """

    practice: Switch = True
    live: Switch = True


class TutorConfig(_Section):
    """How the tutor repeats a case with noise, and how it guides a policy.

    Attributes:
        repeats: executions of each case; the first has no noise.
        noise_deg: standard deviation of the execution noise (degrees).
        noise_correlation_steps: correlation time of the execution noise (control steps).
        guidance_deg: largest difference between the actions of neck and arm and the tutor's plan
            in a correction (degrees).
        backends: names of the simulators whose actors show cases; None for `simulator.backend`.
    """

    repeats: Repeats = 4
    noise_deg: NotNegative = 1.0
    noise_correlation_steps: Positive = 20.0
    guidance_deg: NotNegative = 5.0
    backends: Annotated[tuple[str, ...], Field(min_length=1)] | None = None


class SubnetConfig(_Section):
    """A fully connected subnet of leaky integrators (PFC, M_S, M_F).

    Attributes:
        units: number of units.
        tau: time constant (control steps).
    """

    units: Units
    tau: TimeConstant


class MapsConfig(_Section):
    """A convolutional subnet (V_F, V_S).

    Attributes:
        maps: number of feature maps.
        kernel: width and height of the kernel over its input.
        stride: step of the kernel in both directions.
        tau: time constant (control steps).
    """

    maps: Maps
    kernel: tuple[KernelWidth, KernelHeight]
    stride: Stride
    tau: TimeConstant


class NetworkConfig(_Section):
    """VMDNN (paper, section 4.1).

    Attributes:
        mstnn_fast: V_F, the first convolutional subnet.
        mstnn_slow: V_S, the second convolutional subnet.
        pfc: PFC, which connects vision and action.
        mtrnn_slow: M_S, the slow subnet of the action.
        mtrnn_fast: M_F, the fast subnet of the action.
        softmax_units: output units of each action value.
        code_margin: how far the output units reach beyond the range of a value, as a fraction of
            the range.
        code_width: width of the response of an output unit, in distances between two of them.
        update_order: `bottom_up`: a subnet gets the activity of this step from those that were
            computed before it; `literal`: all input is that of the step before, as eq. (1) is
            printed.
    """

    mstnn_fast: MapsConfig = MapsConfig(maps=3, kernel=(22, 14), stride=2, tau=2)
    mstnn_slow: MapsConfig = MapsConfig(maps=6, kernel=(8, 6), stride=2, tau=30)
    pfc: SubnetConfig = SubnetConfig(units=20, tau=150)
    mtrnn_slow: SubnetConfig = SubnetConfig(units=30, tau=10)
    mtrnn_fast: SubnetConfig = SubnetConfig(units=50, tau=2)
    softmax_units: SoftmaxUnits = 10
    code_margin: CodeMargin = 0.2
    code_width: CodeWidth = 0.6
    update_order: Literal["bottom_up", "literal"] = "bottom_up"

    @model_validator(mode="before")
    @classmethod
    def _complete_subnets(cls, values: Any) -> Any:
        """Complete a subnet that is given in part, such as `pfc: {tau: 30}`, with its defaults."""
        if not isinstance(values, dict):
            return values
        given = {n: value or {} for n, value in values.items() if isinstance(value, dict | None)}
        defaults = {
            name: field.default.model_dump()
            for name, field in cls.model_fields.items()
            if name in given and isinstance(field.default, BaseModel)
        }
        return values | {name: known | given[name] for name, known in defaults.items()}


class PretrainingConfig(_Section):
    """Pre-training of the MSTNN as a delayed-response classifier (section 3.3).

    If `task` is set, the learner on the bus first requests sequences of that task from the actors:
    each of `cases` (indices of its tutored cases, None for all) `repeats` times. Pre-training
    starts with `start_sequences` of them, or with all if there are fewer. If `task` is None, and in
    `vmdnn train` without --pretraining-data, pre-training uses the sequences of coupled training.
    The task defines the questions that the network learns to answer.

    Attributes:
        task: task whose sequences pre-training learns from; None for those of coupled training.
        cases: indices of its tutored cases; None for all.
        repeats: executions of each case; the first has no noise.
        start_sequences: number of sequences with which pre-training starts.
        epochs: epochs of pre-training; 0 for none.
        rate: learning rate of Adam.
        batch: sequences in a minibatch.
        image_shift: largest shift of the pictures, drawn anew for each sequence and epoch (pixels).
        image_gain: standard deviation of changes of contrast and brightness; pixels are -1..1.
        image_noise: standard deviation of noise added to the pixels, which are -1..1.
        threads: threads of pre-training, while actors wait for the first policy; None for
            `learner.threads`.
    """

    task: TaskName | None = None
    cases: tuple[Natural, ...] | None = None
    repeats: Repeats = 4
    start_sequences: Count = 60
    epochs: Natural = 30
    rate: Positive = 2e-3
    batch: Count = 15
    image_shift: Natural = 3
    image_gain: NotNegative = 0.05
    image_noise: NotNegative = 0.03
    threads: Count | None = None


class CorrectionsConfig(_Section):
    """Rounds of corrections after coupled training; on the bus only.

    In each round the tutor guides the newest policy in some situations (see
    `TutorConfig.guidance_deg`). Then training continues with all sequences for `epochs`, with a new
    warm-up and learning-rate schedule, and publishes a policy.

    Attributes:
        rounds: number of rounds.
        choose: how situations are chosen. `failures`: situations of practice in which the newest
            policy was not precise; `random`: random situations; `tutored`: the tutored cases in
            their order.
        sequences: corrections in a round; fewer if `tutored` is chosen and there are fewer cases.
        tries: episodes of practice that are judged in a round to find failures.
        epochs: epochs of training in a round.
        suites: names of the suites that are practised, and whose failures are chosen: `unlearned`
            or suites of `evaluator.suites`. Each has seeds for practice besides those of its
            trials.
    """

    rounds: Natural = 0
    choose: Literal["failures", "random", "tutored"] = "failures"
    suites: Annotated[tuple[str, ...], Field(min_length=1)] = (UNLEARNED,)
    sequences: Count = 45
    tries: Count = 200
    epochs: Count = 200


class LearnerConfig(_Section):
    """Coupled training of PFC, M_S and M_F, and when policies are published.

    On the bus the learner requests sequences from the actors: each of `cases` (indices of the
    task's tutored cases, None for all) `tutor.repeats` times. If the sequence of a case does not
    arrive within `lease_s`, the case is assigned again. Training starts with `start_sequences`, or
    with all sequences if there are fewer. It publishes a policy every `publish_every_epochs` and
    after the last of its `epochs`. The rounds of `corrections` follow.

    Attributes:
        cases: indices of the task's tutored cases; None for all.
        lease_s: a case whose sequence does not arrive after this time is assigned again (s).
        start_sequences: number of sequences with which coupled training starts.
        epochs: epochs of coupled training before any corrections.
        rate: learning rate of Adam.
        schedule: how the learning rate changes after the warm-up.
        warmup_epochs: epochs in which the learning rate rises from 0.
        batch: sequences in a minibatch.
        clip_norm: largest norm of the gradient; None for no limit.
        vision_noise: noise added to each unit of V_S, drawn anew for each sequence and epoch, in
            standard deviations of the unit's activity.
        interpolation: fraction of the sequences that is replaced by sequences interpolated between
            neighbouring tutored situations.
        initial_range: the first weights are drawn from -initial_range..initial_range.
        initial_range_pfc_input: the same for the weights from V_S to the PFC.
        checkpoint_every_epochs: how often a checkpoint is written.
        publish_every_epochs: how often a policy version is published.
        threads: threads of coupled training.
    """

    cases: tuple[Natural, ...] | None = None
    lease_s: Positive = 60.0
    start_sequences: Count = 45
    epochs: Count = 400
    rate: Positive = 3e-3
    schedule: Literal["constant", "cosine"] = "cosine"
    warmup_epochs: Natural = 12
    batch: Count = 30
    clip_norm: Positive | None = 1.0
    vision_noise: NotNegative = 0.3
    interpolation: Annotated[float, Field(strict=True, ge=0, le=1)] = 0.7
    initial_range: Positive = 0.1
    initial_range_pfc_input: Positive = 0.2
    checkpoint_every_epochs: Count = 50
    publish_every_epochs: Count = 50
    threads: Count = 1
    pretraining: PretrainingConfig = PretrainingConfig()
    corrections: CorrectionsConfig = CorrectionsConfig()


RivalKind = Literal["cnn-lstm", "feed-forward"]
"""Kinds of networks that VMDNN is compared with."""


class RivalConfig(_Section):
    """A network that VMDNN is compared with. Like VMDNN it is trained in two stages.

    In the first stage all weights are trained. In the second stage the weights of the vision are
    fixed, and the others are trained further, also with sequences interpolated between neighbouring
    situations. Schedule, warm-up, minibatches, clipping and the noise added to the vision's output
    in the second stage are those of coupled training.

    Attributes:
        units: number of units of its LSTM or of its hidden layer.
        together_epochs: epochs of the first stage.
        epochs: epochs of the second stage.
        rate: learning rate of Adam in both stages.
        image_shift, image_gain, image_noise: augmentation of the pictures in the first stage, as in
            pre-training.
    """

    units: Units
    together_epochs: Count = 60
    epochs: Count = 600
    rate: Positive = 3e-3
    image_shift: Natural = 2
    image_gain: NotNegative = 0.05
    image_noise: NotNegative = 0.03


class CnnLstmConfig(RivalConfig):
    """A small CNN with an LSTM."""

    units: Units = 44


class FeedForwardConfig(RivalConfig):
    """A small CNN with a hidden layer, which uses the current picture only."""

    units: Units = 128


class ComparisonConfig(_Section):
    """The networks that `vmdnn compare` trains; by default about as many weights as VMDNN."""

    cnn_lstm: CnnLstmConfig = CnnLstmConfig()
    feed_forward: FeedForwardConfig = FeedForwardConfig()


def _strengths(values: Any) -> Any:
    """Complete strengths by name: None is the usual range, a number is both ends of a range."""
    if not isinstance(values, Mapping):
        raise ValueError("expected disturbances by name, such as {pushed: [10, 30]}")
    return {str(name): _strength(str(name), value) for name, value in values.items()}


def _strength(name: str, value: Any) -> tuple[float, float]:
    if name not in DISTURBANCES:
        raise ValueError(f"there is no disturbance {name!r}; there are {', '.join(DISTURBANCES)}")
    disturbance = DISTURBANCES[name]
    ends = disturbance.usual if value is None else value
    ends = ends if isinstance(ends, list | tuple) else (ends, ends)
    numbers = [end for end in ends if isinstance(end, int | float) and not isinstance(end, bool)]
    if len(numbers) != 2 or len(ends) != 2:
        raise ValueError(f"{name}: expected a strength or a range of two, such as [10, 30]")
    weakest, strongest = (float(number) for number in numbers)
    if problem := disturbance.problem(weakest) or disturbance.problem(strongest):
        raise ValueError(f"{name}: {problem}")
    if weakest > strongest:
        raise ValueError(f"{name}: the range {weakest:g} .. {strongest:g} is upside down")
    return weakest, strongest


Strengths = Annotated[dict[str, tuple[float, float]], BeforeValidator(_strengths)]


class SuiteConfig(_Section):
    """A suite: situations and conditions on which every policy version is tried.

    In YAML a name alone is a suite, too. What is not given has the value of the built-in suite of
    this name (`proto.suites.BUILT_IN`), if there is one.

    Attributes:
        name: its name.
        trials: number of trials of each policy version; None for `trials_per_policy`.
        seed: seed of the first trial; None for `evaluator.seed` in the suite `unlearned`, and for
            seeds that the name selects in the others.
        practice_seed: first seed of its practice; None for `proto.seeds.PRACTICE` in the suite
            `unlearned`, and for seeds that the name selects in the others.
        stretch: factor by which the ranges of the task's variables are stretched; with more than 1
            all situations lie outside the tutored ranges.
        disturbances: strength by name, a number or a range [weakest, strongest], or nothing for the
            usual range; see `proto.disturbances`. In each trial one of them acts.
        backend: name of the simulator in which it is played; None for `simulator.backend`.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    trials: Annotated[int, Field(strict=True, ge=1, le=2**28)] | None = None
    seed: Annotated[int, Field(strict=True, ge=0, lt=TRIALS_BELOW)] | None = None
    practice_seed: (
        Annotated[
            int,
            Field(
                strict=True,
                ge=PRACTICE_SEEDS.start,
                le=PRACTICE_SEEDS.stop - PRACTICE_OF_SUITE,
            ),
        ]
        | None
    ) = None
    stretch: Annotated[float, Field(strict=True, ge=1, le=MOST_STRETCH)] = 1.0
    disturbances: Strengths = Field(default_factory=dict)
    backend: Annotated[str, Field(min_length=1, max_length=200)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, values: Any) -> Any:
        """Accept a name alone, and complete a suite with the values of the built-in one."""
        if isinstance(values, str):
            values = {"name": values}
        if not isinstance(values, dict) or not isinstance(values.get("name"), str):
            return values
        given = {name: value for name, value in values.items() if value is not None}
        return {**BUILT_IN.get(values["name"], {}), **given}


def _check_suites(suites: tuple[SuiteConfig, ...]) -> tuple[SuiteConfig, ...]:
    if not 1 <= len(suites) <= MOST_SUITES:
        raise ValueError(f"expected 1 to {MOST_SUITES} suites; leave the key out for `unlearned`")
    return suites


class EvaluatorConfig(_Section):
    """Trials of each policy version in situations that were not tutored.

    Attributes:
        trials_per_policy: number of trials of each policy version.
        seed: seed of the first trial; trial i has the seed `seed + i`.
        lease_s: a trial that is not finished after this time is assigned again (s).
        first_trials: number of trials of each policy version in each suite that actors finish
            before they take a newer version. With 0 they take the newest version at once, so that
            versions that follow each other quickly get few trials or none.
        suites: the suites, the most important first; None for `unlearned` alone.
    """

    trials_per_policy: Annotated[int, Field(strict=True, ge=1, le=2**28)] = 52
    # The bound keeps the seeds of all trials below those of corrections and practice.
    seed: Annotated[int, Field(strict=True, ge=0, le=TRIALS_BELOW - 2**28)] = 1000
    lease_s: Positive = 60.0
    first_trials: Natural = 0
    suites: Annotated[tuple[SuiteConfig, ...], AfterValidator(_check_suites)] | None = None


class KeepConfig(_Section):
    """How many recordings are kept. Trials are never deleted; of practice the oldest go first.

    Attributes:
        gib: size of all recordings (GiB); when it is reached, practice is deleted.
        practice: number of recordings of practice.
    """

    gib: Positive = 20.0
    practice: Natural = 1000


class RecorderConfig(_Section):
    """Which rollouts are recorded, and how many are kept.

    Attributes:
        required: actors keep a rollout until the recorder has it too. False for a run without a
            recorder.
        practice: record episodes of practice too, not only trials.
        share: share of the precise episodes that are recorded; all others always are.
        keep: how many recordings are kept.
    """

    required: Switch = True
    practice: Switch = True
    share: Annotated[float, Field(strict=True, ge=0, le=1)] = 1.0
    keep: KeepConfig = KeepConfig()

    def records(self, episode: str, *, practice: bool, precise: bool) -> bool:
        """Whether a trial or an episode of practice goes to recorders.

        Which of the precise ones do so follows from the id: `share` of them.

        Args:
            episode: id of the episode.
            practice: whether it was played for practice.
            precise: whether its outcome is precise.
        """
        if practice and not self.practice:
            return False
        return not precise or crc32(episode.encode()) < self.share * 2**32


class DashboardConfig(_Section):
    """The page that shows a run in the browser.

    Attributes:
        enabled: whether deploy/run_local.sh starts it.
        host: address at which it can be opened; 127.0.0.1 is for this machine only, 0.0.0.0 for
            others too.
        port: port of the page. If it is taken, the next free one is used; 0 for any free one.
    """

    enabled: Switch = True
    host: Annotated[str, Field(min_length=1, max_length=255)] = "127.0.0.1"
    port: Annotated[int, Field(strict=True, ge=0, lt=2**16)] = 8080


class DoneConfig(_Section):
    """When a run started by deploy/run_local.sh is finished; without conditions it does not end.

    Attributes:
        policy_versions: number of policy versions to publish.
        trials: number of trials of the newest policy version to count in each suite, or all trials
            of a suite that has fewer. Suites that no actor can play are left out. With
            `policy_versions`, the newest version must be that one or a later one.
    """

    policy_versions: Count | None = None
    trials: Count | None = None

    @property
    def ever(self) -> bool:
        """Whether there is a condition, so that the run can be done."""
        return self.policy_versions is not None or self.trials is not None


class Config(_Section):
    """The configuration of a run."""

    run: RunConfig = RunConfig()
    hub: HubConfig = HubConfig()
    task: TaskConfig = TaskConfig()
    simulator: SimulatorConfig = SimulatorConfig()
    actor: ActorConfig = ActorConfig()
    tutor: TutorConfig = TutorConfig()
    network: NetworkConfig = NetworkConfig()
    learner: LearnerConfig = LearnerConfig()
    comparison: ComparisonConfig = ComparisonConfig()
    evaluator: EvaluatorConfig = EvaluatorConfig()
    recorder: RecorderConfig = RecorderConfig()
    dashboard: DashboardConfig = DashboardConfig()
    done: DoneConfig = DoneConfig()

    @property
    def run_folder(self) -> Path:
        """Folder of the run."""
        return self.run.folder / self.run.name

    @property
    def pretraining_task(self) -> str | None:
        """Task of the pre-training sequences; None if those of coupled training are used."""
        first = self.learner.pretraining
        return None if first.epochs == 0 or first.task == self.task.name else first.task

    @property
    def policy_versions(self) -> int:
        """Number of policy versions that the learner of a run publishes in all."""
        learner = self.learner
        initial = -(-learner.epochs // learner.publish_every_epochs)  # the last epoch counts too
        return initial + learner.corrections.rounds

    def task_called(self, name: str) -> TaskConfig:
        """Return the section `task` for a task; another task has no options, the same attention."""
        if name == self.task.name:
            return self.task
        return TaskConfig(name=name, attention=self.task.attention)

    @property
    def suites(self) -> tuple[Suite, ...]:
        """What every policy version is tried on, the most important suite first."""
        given = self.evaluator.suites or (SuiteConfig(name=UNLEARNED),)
        return tuple(map(self._suite, given))

    def suite(self, name: str) -> Suite:
        """The suite with a name: one of `suites`, or a built-in one.

        Raises:
            UserError: there is no such suite.
        """
        found = {suite.name: suite for suite in self.suites}
        if name in found:
            return found[name]
        if name not in BUILT_IN:
            known = ", ".join(dict.fromkeys([*found, *BUILT_IN]))
            raise UserError(f"there is no suite {name!r}; there are: {known}")
        return self._suite(SuiteConfig(name=name))

    def practised_suites(self) -> tuple[Suite, ...]:
        """The suites from whose practice seeds actors draw situations."""
        return tuple(map(self.suite, self.learner.corrections.suites))

    @property
    def tutoring_backends(self) -> tuple[str, ...]:
        """Names of the simulators whose actors show cases."""
        return self.tutor.backends or (self.simulator.backend,)

    def _suite(self, given: SuiteConfig) -> Suite:
        evaluator, plain = self.evaluator, given.name == UNLEARNED
        seed = evaluator.seed if plain else first_test_seed(given.name)
        first = seed if given.seed is None else given.seed
        practice = given.practice_seed or (None if plain else first_practice_seed(given.name))
        return Suite(
            name=given.name,
            backend=given.backend or self.simulator.backend,
            test_seeds=range(first, first + (given.trials or evaluator.trials_per_policy)),
            practice_seeds=(
                PRACTICE if practice is None else range(practice, practice + PRACTICE_OF_SUITE)
            ),
            stretch=given.stretch,
            disturbances=given.disturbances,
        )

    @model_validator(mode="after")
    def _can_find_failures(self) -> Self:
        corrections = self.learner.corrections
        if corrections.rounds and corrections.choose == "failures" and not self.actor.practice:
            raise ValueError("learner.corrections.choose: failures needs actor.practice")
        names = {UNLEARNED, *(suite.name for suite in self.suites)}
        if unknown := set(corrections.suites) - names:
            raise ValueError(
                f"learner.corrections.suites: there is no {min(unknown)!r} in evaluator.suites,"
                f" which has {', '.join(sorted(names))}"
            )
        if corrections.suites != (UNLEARNED,) and corrections.choose != "failures":
            raise ValueError(
                "learner.corrections.suites needs learner.corrections.choose: failures"
            )
        return self

    @model_validator(mode="after")
    def _suites_are_apart(self) -> Self:
        suites = self.suites
        for number, suite in enumerate(suites):
            if suite.test_seeds.stop > TRIALS_BELOW:
                raise ValueError(
                    f"evaluator.suites: {suite.name} has test seeds up to"
                    f" {suite.test_seeds.stop - 1}; they must be below {TRIALS_BELOW}"
                )
            for other in suites[:number]:
                if suite.name == other.name:
                    raise ValueError(f"evaluator.suites: there are two suites {suite.name!r}")
                if _overlap(suite.test_seeds, other.test_seeds):
                    raise ValueError(_overlap_words("test seeds", "seed", suite, other))
                if _overlap(suite.practice_seeds, other.practice_seeds):
                    words = ("practice seeds", "practice_seed")
                    raise ValueError(_overlap_words(*words, suite, other))
        return self

    @model_validator(mode="after")
    def _can_be_done(self) -> Self:
        most = max(len(suite.test_seeds) for suite in self.suites)
        if (self.done.trials or 0) > most:
            raise ValueError(
                "done.trials must not exceed evaluator.trials_per_policy"
                if self.evaluator.suites is None
                else f"done.trials must not exceed the {most} trials of the largest suite"
            )
        return self

    def digest(self) -> str:
        """Hash all values that a result may depend on; twelve hexadecimal digits.

        These are all but the sections `hub` and `dashboard`, and `run.folder`.
        """
        values = self.model_dump(
            mode="json", exclude={"hub": True, "dashboard": True, "run": {"folder"}}
        )
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def as_json(self) -> str:
        """Return all values as JSON in one line."""
        return json.dumps(self.model_dump(mode="json"))

    def save(self, path: Path) -> None:
        """Write the effective configuration as YAML.

        Raises:
            UserError: the file cannot be written.
        """
        with written_whole(path) as stream:
            stream.write(dump_yaml(self.model_dump(mode="json")).encode())


def _overlap(one: range, other: range) -> bool:
    return one.start < other.stop and other.start < one.stop


def _overlap_words(seeds: str, key: str, suite: Suite, other: Suite) -> str:
    ranges = {
        each.name: each.test_seeds if key == "seed" else each.practice_seeds
        for each in (other, suite)
    }
    listed = " and ".join(f"{name} {r.start} .. {r.stop - 1}" for name, r in ranges.items())
    return f"evaluator.suites: the {seeds} of two suites overlap: {listed}; give one another {key}"


def read_config(text: str, overrides: Sequence[str], where: str) -> Config:
    """Read the configuration of a run as another process sent it, and apply overrides.

    Its sections `hub` and `run.folder` are left out: they are about the machine of the other.

    Args:
        text: the configuration as JSON.
        overrides: `key.path=value` overrides.
        where: where the text comes from, for messages.

    Raises:
        UserError: it is not valid; this version of vmdnn may have other keys.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where} cannot be read: {error}") from error
    if not isinstance(values, dict) or not isinstance(values.get("run"), dict):
        raise UserError(f"{where} has no section `run`")
    values.pop("hub", None)
    values["run"].pop("folder", None)
    return _checked(values, overrides, where)


def load_config(path: Path | None, overrides: Sequence[str] = ()) -> Config:
    """Read a YAML file (None: all defaults) and apply `key.path=value` overrides.

    Raises:
        UserError: missing file, broken YAML, unknown key, wrong type or value out of range.
    """
    values = {} if path is None else _read(path)
    return _checked(values, overrides, f"config file {path}" if path else "config")


def _checked(values: dict[str, Any], overrides: Sequence[str], where: str) -> Config:
    for override in overrides:
        _apply(values, override)
    if _count_values(values) > MOST_VALUES:
        raise UserError(f"the config has more than {MOST_VALUES} values; no config needs so many")
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        found = error.errors(include_url=False)
        problems = "".join(
            f"\n  {plain(_key_of(problem), 200)}: {plain(_what_is_wrong(problem), 500)}"
            for problem in found[:_PROBLEMS_TOLD]
        )
        more = f"\n  and {len(found) - _PROBLEMS_TOLD} more" if len(found) > _PROBLEMS_TOLD else ""
        raise UserError(f"{where} is not valid:{problems}{more}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        values = load_yaml(read_limited(path, LONGEST).decode())
    except FileNotFoundError as error:
        raise UserError(f"config file {path} does not exist") from error
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise UserError(
            f"config file {path} cannot be read: {plain_lines(error)[:_LONGEST_PROBLEM]}"
        ) from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise UserError(f"config file {path}: expected `section: ...` lines at the top level")
    _drop_retired_keys(values, path)
    return values


def _drop_retired_keys(values: dict[str, Any], path: Path) -> None:
    """Drop keys that runs of vmdnn 0.1 saved in their configuration, and say so in the log."""
    for key in _RETIRED_KEYS:
        *sections, last = key.split(".")
        section: Any = values
        for name in sections:
            section = section.get(name) if isinstance(section, dict) else None
        if isinstance(section, dict) and section.pop(last, None) is not None:
            LOG.warning("%s: %s has no effect any more and is ignored", path, key)


def _key_of(problem: ErrorDetails) -> str:
    return ".".join(str(part) for part in problem["loc"])


def _what_is_wrong(problem: ErrorDetails) -> str:
    if problem["type"] == "extra_forbidden":
        similar = _similar_key(_key_of(problem))
        advice = f"did you mean {similar}?" if similar else "`vmdnn config` lists all keys"
        return f"there is no such key; {advice}"
    what = plain(problem["msg"].removeprefix("Value error, "), 300)
    return f"{what} (got {_shown(problem['input'])})"


def _shown(value: Any) -> str:
    """A value from outside, cut off where it is long."""
    return plain(_REPR.repr(value), 100)


def _count_values(value: Any) -> int:
    """Number of values in a value from YAML, itself included."""
    if isinstance(value, dict):
        return 1 + sum(map(_count_values, value.values()))
    if isinstance(value, list):
        return 1 + sum(map(_count_values, value))
    return 1


def _similar_key(key: str) -> str:
    """The key that is meant most likely, such as learner.epochs for `epochs`; empty if none is."""
    keys = _keys_of(Config)
    if whole := get_close_matches(key, keys, n=1, cutoff=0.8):
        return whole[0]
    last_parts = {each.rpartition(".")[2]: each for each in reversed(keys)}
    if last := get_close_matches(key.rpartition(".")[2], last_parts, n=1, cutoff=0.8):
        return last_parts[last[0]]
    return next(iter(get_close_matches(key, keys, n=1)), "")


def _keys_of(section: type[BaseModel], prefix: str = "") -> list[str]:
    """All keys of a section, such as `learner` and `learner.rate`."""
    keys = []
    for name, field in section.model_fields.items():
        keys.append(f"{prefix}{name}")
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            keys += _keys_of(kind, f"{prefix}{name}.")
    return keys


def _apply(values: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    where = f"--set {plain(repr(override), 200)}"
    if not separator or not key:
        raise UserError(f"{where}: expected key=value, such as learner.rate=1e-3")
    *sections, last = key.split(".")
    if len(sections) > DEEPEST:
        raise UserError(f"{where}: no key has more than {DEEPEST} parts")
    for section in sections:
        if values.get(section) is None:
            values[section] = {}
        if not isinstance(values[section], dict):
            raise UserError(f"{where}: {plain(section, 100)} is a value, not a section")
        values = values[section]
    try:
        values[last] = load_yaml(text)
    except yaml.YAMLError as error:
        problem = plain_lines(error)[:_LONGEST_PROBLEM]
        raise UserError(
            f"{where}: {plain(repr(text), 200)} is not a YAML value: {problem}"
        ) from error
