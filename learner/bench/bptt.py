"""Speed of training on this machine, beside other ways to compute the same."""

from __future__ import annotations

import functools
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from statistics import median
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from learner.bench.reference import Step, step_levels, stepwise_divergence, stepwise_outputs
from learner.kernels.library import peak_flops
from learner.network.mstnn import activation
from learner.network.vmdnn import VMDNN
from learner.training.adam import Adam
from learner.training.divergence import add_gradients, reference_divergence
from learner.training.sequences import Minibatch, Sequences
from proto.body import IMAGE_HEIGHT, IMAGE_WIDTH
from proto.config import Config, NetworkConfig
from proto.machine import machine_name

Epoch = Callable[[], object]

MEASURING_S: Final = 12.0
"""How long all contenders together are measured."""
TURN_S: Final = 0.1
"""How long a contender is measured before it is the next one's turn."""
LONG_S: Final = 2.0
"""A first epoch that takes longer is counted: what is done only once then matters little."""
RATE: Final = 1e-4
COMPILING_S: Final = 20.0
"""How long `torch.compile` may take, measuring included."""


@dataclass(frozen=True)
class VisionSpeed:
    """Forward and backward through V_F and V_S.

    Attributes:
        batch: sequences at once.
        step_by_step_ms: time when the steps are computed one after the other.
        batched_ms: time when all steps are convolved at once, as in pre-training.
        ratio: step_by_step_ms over batched_ms.
    """

    batch: int
    step_by_step_ms: float
    batched_ms: float
    ratio: float


@dataclass(frozen=True)
class BpttSpeed:
    """Result of `bench_bptt`; times are medians.

    One epoch is the loss of all sequences in one minibatch, its gradients, and a step of Adam. The
    activity of V_S is given, as in coupled training.

    Attributes:
        machine: processor and number of cores.
        threads: threads of every contender.
        batch: number of sequences.
        steps: their length.
        eager_ms: one epoch with PyTorch's autograd through a loop over the steps.
        fused_ms: one epoch as in training.
        ratio: eager_ms over fused_ms.
        peers: one epoch of each other way (ms): `torch.compile` of the step of that loop (None if
            it does not compile in time), gradients written by hand in PyTorch (used where nothing
            can be compiled), and two other networks with as many weights: `nn.LSTM`, and an MTRNN
            whose steps are a loop in Python.
        gflops: floating point operations that the epoch needs, in 10^9 per second.
        peak_gflops: the same for multiply-adds on registers alone, with all threads.
        fraction: gflops over peak_gflops.
        vision: speed of the vision, which only pre-training trains.
    """

    machine: str
    threads: int
    batch: int
    steps: int
    eager_ms: float
    fused_ms: float
    ratio: float
    peers: Mapping[str, float | None]
    gflops: float
    peak_gflops: float
    fraction: float
    vision: VisionSpeed


def bench_bptt(config: Config, *, batch: int, steps: int, threads: int) -> BpttSpeed:
    """Measure training in less than 50 seconds."""
    torch.set_num_threads(threads)
    compiled_ms = _in_time(_compiled_ms, config.network, batch, steps, threads)
    network = _network(config.network)
    sequences = _sequences(network, batch, steps)
    minibatch = Minibatch.of_all(sequences)
    by_loop = functools.partial(stepwise_divergence, network, minibatch)
    by_hand = functools.partial(reference_divergence, network, minibatch)
    contenders = {
        "eager": _epoch(by_loop, network.core_parameters()),
        "fused": _fused_epoch(_network(config.network), minibatch),
        "autograd by hand": _epoch(by_hand, network.core_parameters()),
        "nn.LSTM": _peer_epoch(_Lstm, network, minibatch),
        "MTRNN cell": _peer_epoch(_Mtrnn, network, minibatch),
    }
    peaks = [_peak_flops(threads)]
    times = _medians_ms(contenders, MEASURING_S)
    peaks.append(_peak_flops(threads))
    eager_ms, fused_ms = times.pop("eager"), times.pop("fused")
    gflops = operations(network) * batch * steps / fused_ms / 1e6
    return BpttSpeed(
        machine=machine_name(),
        threads=threads,
        batch=batch,
        steps=steps,
        eager_ms=eager_ms,
        fused_ms=fused_ms,
        ratio=eager_ms / fused_ms,
        peers={"torch.compile": compiled_ms, **times},
        gflops=gflops,
        peak_gflops=max(peaks) / 1e9,
        fraction=1e9 * gflops / max(peaks),
        vision=_bench_vision(config, steps),
    )


def operations(network: VMDNN) -> int:
    """Floating point operations that one step of one sequence needs, forward and backward.

    Each weight costs a multiply-add for the activity, one for its own gradient, and one for the
    gradient of the activity below unless that is fixed (V_S). Operations on single units, such as
    tanh, are not counted.
    """
    weights = sum(each.numel() for each in network.core_parameters() if each.dim() > 1)
    return 2 * (3 * weights - network.pfc.input.numel())


def _network(config: NetworkConfig) -> VMDNN:
    network = VMDNN(config)
    network.initialize(torch.Generator().manual_seed(1), initial_range=0.1, pfc_input_range=0.2)
    return network


def _sequences(network: VMDNN, batch: int, steps: int) -> Sequences:
    """Random sequences; their content makes no difference to the time."""
    generator = torch.Generator().manual_seed(2)
    seen = torch.randn(batch, steps, network.pfc.input.shape[1], generator=generator)
    codes = torch.randn(batch, steps, *network.outputs.shape, generator=generator).softmax(-1)
    return Sequences.stacked(list(seen), list(codes))


def _fused_epoch(network: VMDNN, minibatch: Minibatch) -> Epoch:
    """An epoch as in training."""
    adam = Adam(network.core_parameters())

    def epoch() -> float:
        loss = add_gradients(network, minibatch)
        adam.step(RATE)
        return loss

    return epoch


def _epoch(loss: Callable[[], Tensor], parameters: Sequence[nn.Parameter]) -> Epoch:
    """An epoch with autograd and PyTorch's fused Adam."""
    adam = torch.optim.Adam(parameters, RATE, fused=True)

    def epoch() -> float:
        adam.zero_grad()
        value = loss()
        value.backward()  # type: ignore[no-untyped-call]
        with _one_thread():
            adam.step()
        return value.item()

    return epoch


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let PyTorch compute in one thread.

    A step of Adam on so few weights takes less time than starting and joining threads. Where other
    processes use the cores too, threads would make it a thousand times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _medians_ms(contenders: Mapping[str, Epoch], limit_s: float) -> dict[str, float]:
    """Median time of each contender; they take turns, so that all run under the same load."""
    times = {name: _warm_up(epoch) for name, epoch in contenders.items()}
    end = time.perf_counter() + limit_s
    while time.perf_counter() < end or not all(times.values()):
        for name, epoch in contenders.items():
            times[name] += _turn(epoch)
    return {name: 1e3 * median(durations) for name, durations in times.items()}


def _warm_up(epoch: Epoch) -> list[float]:
    """Run a first epoch; its time if it is a long one, else nothing."""
    start = time.perf_counter()
    epoch()
    taken = time.perf_counter() - start
    return [taken] if taken > LONG_S else []


def _turn(epoch: Epoch) -> list[float]:
    durations: list[float] = []
    while not durations or sum(durations) < TURN_S:
        start = time.perf_counter()
        epoch()
        durations.append(time.perf_counter() - start)
    return durations


def _peak_flops(threads: int) -> float:
    """The highest rate of some short measurements."""
    return max(peak_flops(threads) for _ in range(20))


# --- torch.compile ---


def _in_time(measure: Callable[..., float], *arguments: Any) -> float | None:
    """Result of `measure` in a process of its own, or None if it fails or takes too long."""
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sending, measure, arguments), daemon=True)
    process.start()
    sending.close()
    try:
        return receiving.recv() if receiving.poll(COMPILING_S) else None
    except EOFError:
        return None
    finally:
        process.kill()
        process.join()


def _send(sending: Connection, measure: Callable[..., float], arguments: Sequence[Any]) -> None:
    os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"  # start no further processes
    sending.send(measure(*arguments))


def _compiled_ms(config: NetworkConfig, batch: int, steps: int, threads: int) -> float:
    """One epoch of the loop of "eager" with its step compiled.

    The whole loop takes minutes to compile.
    """
    torch.set_num_threads(threads)
    network = _network(config)
    minibatch = Minibatch.of_all(_sequences(network, batch, steps))
    step: Step = torch.compile(step_levels, dynamic=False)

    def loss() -> Tensor:
        return minibatch.divergence(stepwise_outputs(network, minibatch.seen(), step=step))

    epoch = _epoch(loss, network.core_parameters())
    return _medians_ms({"compiled": epoch}, limit_s=1.0)["compiled"]


# --- other networks ---


class _Lstm(nn.Module):
    """V_S > LSTM > M_O."""

    def __init__(self, inputs: int, units: int, outputs: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(inputs, units, batch_first=True)
        self.outputs = nn.Linear(units, outputs)

    def forward(self, seen: Tensor) -> Tensor:
        """Potentials of M_O (B, T, outputs)."""
        potentials: Tensor = self.outputs(self.lstm(seen)[0])
        return potentials


class _Mtrnn(nn.Module):
    """V_S > fast context <> slow context, fast context > M_O, as in robot learning libraries.

    A continuous-time recurrent network with two time constants (Yamashita and Tani 2008). The fast
    units get the input, their own activity and that of the slow units; the slow units get their own
    activity and that of the fast units. A cell of linear layers computes a step, and a loop in
    Python calls it.
    """

    fast_tau, slow_tau, slow_units = 5.0, 50.0, 20

    def __init__(self, inputs: int, units: int, outputs: int) -> None:
        super().__init__()
        self.units = units
        self.input_to_fast = nn.Linear(inputs, units)
        self.fast_to_fast = nn.Linear(units, units, bias=False)
        self.slow_to_fast = nn.Linear(self.slow_units, units, bias=False)
        self.fast_to_slow = nn.Linear(units, self.slow_units)
        self.slow_to_slow = nn.Linear(self.slow_units, self.slow_units, bias=False)
        self.outputs = nn.Linear(units, outputs)

    def cell(self, now: Tensor, state: tuple[Tensor, Tensor, Tensor, Tensor]) -> Any:
        """Activities and potentials of fast and slow context, one step later."""
        fast, slow, u_fast, u_slow = state
        to_fast = self.input_to_fast(now) + self.fast_to_fast(fast) + self.slow_to_fast(slow)
        to_slow = self.fast_to_slow(fast) + self.slow_to_slow(slow)
        u_fast = (1 - 1 / self.fast_tau) * u_fast + to_fast / self.fast_tau
        u_slow = (1 - 1 / self.slow_tau) * u_slow + to_slow / self.slow_tau
        return torch.tanh(u_fast), torch.tanh(u_slow), u_fast, u_slow

    def forward(self, seen: Tensor) -> Tensor:
        """Potentials of M_O (B, T, outputs)."""
        fast = seen.new_zeros(len(seen), self.units)
        slow = seen.new_zeros(len(seen), self.slow_units)
        state = (fast, slow, fast, slow)
        outputs = []
        for now in seen.unbind(1):
            state = self.cell(now, state)
            outputs.append(self.outputs(state[0]))
        return torch.stack(outputs, dim=1)


def _peer_epoch(
    kind: Callable[[int, int, int], nn.Module], network: VMDNN, minibatch: Minibatch
) -> Epoch:
    """An epoch of another network with the fewest units that give at least as many parameters."""
    inputs, outputs = network.pfc.input.shape[1], len(network.outputs.bias)
    wanted = sum(each.numel() for each in network.core_parameters())
    units = 1
    while sum(each.numel() for each in kind(inputs, units, outputs).parameters()) < wanted:
        units += 1
    peer = kind(inputs, units, outputs)

    def loss() -> Tensor:
        potentials = peer(minibatch.seen()).unflatten(-1, network.outputs.shape)
        return minibatch.divergence(functional.log_softmax(potentials, -1))

    return _epoch(loss, list(peer.parameters()))


# --- vision ---


def _bench_vision(config: Config, steps: int) -> VisionSpeed:
    network = _network(config.network)
    batch = config.learner.pretraining.batch
    generator = torch.Generator().manual_seed(3)
    images = 2 * torch.rand(batch, steps, IMAGE_HEIGHT, IMAGE_WIDTH, generator=generator) - 1
    wanted = torch.randn(network.see(images[:1, :1]).shape[-1], generator=generator)

    def epoch_of(see: Callable[[Tensor], Tensor]) -> Epoch:
        def forward_and_backward() -> None:
            network.zero_grad()
            (see(images) @ wanted).mean().backward()  # type: ignore[no-untyped-call]

        return forward_and_backward

    times = _medians_ms(
        {
            "steps": epoch_of(functools.partial(_see_step_by_step, network)),
            "batched": epoch_of(network.see),
        },
        MEASURING_S / 2,
    )
    return VisionSpeed(
        batch=batch,
        step_by_step_ms=times["steps"],
        batched_ms=times["batched"],
        ratio=times["steps"] / times["batched"],
    )


def _see_step_by_step(network: VMDNN, images: Tensor) -> Tensor:
    """`VMDNN.see`, step by step, as eq. (3) and (4) are printed."""
    potentials: list[Tensor | float] = [0.0, 0.0]
    seen = []
    for now in images.unbind(1):
        activity = now.unsqueeze(1)
        for index, maps in enumerate(network.vision()):
            drive = functional.conv2d(activity, maps.kernel, maps.bias, maps.stride)
            leak = 1 / maps.tau
            potential = (1 - leak) * potentials[index] + leak * drive
            potentials[index] = potential
            activity = activation(potential)
        seen.append(activity.flatten(1))
    return torch.stack(seen, dim=1)
