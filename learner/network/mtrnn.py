"""The recurrent levels PFC > M_S > M_F (paper, eq. (1) and (2)) and their scan through time.

A level is a continuous-time network of leaky integrators. Its input is the activity of the level
before it on the way from vision to movement (V_S for the PFC), its own activity, and feedback from
the next level.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx

from learner.network.subnets import ACTIVATION_GAIN, ACTIVATION_SLOPE, Subnet

UpdateOrder = Literal["bottom_up", "literal"]


class Level(nn.Module):
    """One recurrent subnet (PFC, M_S, M_F).

    Attributes:
        input: (units, units below).
        recurrent: (units, units).
        feedback: (units, units of the next level), or None for the last level.
        bias: (units,).
    """

    input: Tensor
    recurrent: Tensor
    feedback: Tensor | None
    bias: Tensor

    def __init__(self, subnet: Subnet) -> None:
        super().__init__()
        self.units = subnet.shape[0]
        self.tau = subnet.tau
        self.register_parameter("feedback", None)
        for name, shape in subnet.parameters.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(shape)))


def run_levels(
    levels: Sequence[Level], below: Tensor, order: UpdateOrder, initial: Tensor | None = None
) -> Tensor:
    """Activity (B, T, units) of the last level for the activity (B, T, F) below the first.

    Args:
        levels: the levels, from the PFC on.
        below: (B, T, F) activity of V_S.
        order: "bottom_up": a level gets the activity below it of the same step, and feedback and
            recurrence of the step before. "literal": all input is of the step before, as eq. (1) is
            printed.
        initial: (B, units of all levels) potentials before the first step, or None for zero.
    """
    first = levels[0]
    if order == "literal":
        below = one_step_later(below)
    drive = _drive(levels, below @ first.input.T)
    leaks = torch.cat([drive.new_full((level.units,), 1 / level.tau) for level in levels])
    delayed = _delayed_weights(levels, with_input=order == "literal")
    immediate = [level.input for level in levels[1:]] if order == "bottom_up" else []
    first_potentials = None if initial is None else initial.T
    activity = recurrent_scan(drive, leaks, delayed, immediate, first_potentials)
    return activity[:, -levels[-1].units :].permute(2, 0, 1)


def one_step_later(activity: Tensor, before: Tensor | None = None) -> Tensor:
    """Activity (B, T, F) delayed by one step; `before` (B, F) comes first, by default zero."""
    first = torch.zeros_like(activity[:, 0]) if before is None else before
    return torch.cat([first[:, None], activity[:, :-1]], dim=1)


def _drive(levels: Sequence[Level], seen: Tensor) -> Tensor:
    """(T, N, B) input of all N units from outside: weighted V_S (B, T, n), and biases."""
    seen = seen.permute(1, 2, 0)
    others = sum(level.units for level in levels[1:])
    biases = torch.cat([level.bias for level in levels])
    return nn.functional.pad(seen, (0, 0, 0, others)) + biases[:, None]


def _delayed_weights(levels: Sequence[Level], *, with_input: bool) -> Tensor:
    """(N, N) weights, to x from: recurrence, feedback and, with_input, those of the level below."""
    rows = []
    for to, level in enumerate(levels):
        row = [level.bias.new_zeros(level.units, source.units) for source in levels]
        row[to] = level.recurrent
        if level.feedback is not None and to + 1 < len(levels):
            row[to + 1] = level.feedback
        if with_input and to > 0:
            row[to - 1] = level.input
        rows.append(torch.cat(row, dim=1))
    return torch.cat(rows)


def recurrent_scan(
    drive: Tensor,
    leaks: Tensor,
    delayed: Tensor,
    immediate: Sequence[Tensor],
    initial: Tensor | None = None,
) -> Tensor:
    """Run leaky integrators through time.

    u[t] = (1 - leaks) u[t-1] + leaks (drive[t] + delayed y[t-1] + immediate y[t]), y[t] = f(u[t]).
    The units of all levels are numbered in the order of the levels.

    Args:
        drive: (T, N, B) input from outside.
        leaks: (N,) 1 / tau of each unit.
        delayed: (N, N) weights of the activity one step before, to x from.
        immediate: for each level but the first, weights of the activity of the level before it in
            the same step; empty if no connection acts within a step.
        initial: (N, B) potentials u before the first step, or None for zero.

    Returns:
        Activity (T, N, B), differentiable by drive, delayed, immediate and initial.
    """
    # With h = tanh(v) and v = slope u a step needs no factors: y = gain h.
    scale = (ACTIVATION_SLOPE * leaks)[:, None]
    _, *spans = _spans(delayed, immediate)
    scaled = [
        ACTIVATION_GAIN * scale[span] * block for span, block in zip(spans, immediate, strict=True)
    ]
    if initial is None:
        initial = torch.zeros_like(drive[0])
    hidden = cast(
        "Tensor",
        _Scan.apply(  # type: ignore[no-untyped-call]
            scale * drive,
            1 - leaks,
            ACTIVATION_SLOPE * initial,
            ACTIVATION_GAIN * scale * delayed,
            *scaled,
        ),
    )
    return ACTIVATION_GAIN * hidden


def _spans(delayed: Tensor, immediate: Sequence[Tensor]) -> list[slice]:
    """The units of each level; one span for all if no connection acts within a step."""
    sizes = [len(block) for block in immediate]
    bounds = accumulate(sizes, initial=len(delayed) - sum(sizes))
    return [slice(start, end) for start, end in pairwise((0, *bounds))]


class _Scan(torch.autograd.Function):
    """v[t] = keep v[t-1] + drive[t] + delayed h[t-1] + immediate h[t], h = tanh(v)."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        drive: Tensor,
        keep: Tensor,
        initial: Tensor,
        delayed: Tensor,
        *immediate: Tensor,
    ) -> Tensor:
        hidden = _run(drive, keep, initial, delayed, immediate)
        ctx.save_for_backward(hidden, initial, keep, delayed, *immediate)
        return hidden

    @staticmethod
    def backward(ctx: FunctionCtx, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (by_hidden,) = gradients
        hidden, initial, keep, delayed, *immediate = ctx.saved_tensors  # type: ignore[attr-defined]
        deltas = _run_back(by_hidden, hidden, keep, delayed, immediate)
        spans = _spans(delayed, immediate)
        rest = torch.tanh(initial)
        by_rest = delayed.T @ deltas[0]
        by_initial = deltas[0] * keep[:, None] + (1 - rest * rest) * by_rest
        by_delayed = torch.addmm(_sum_of_products(deltas[1:], hidden[:-1]), deltas[0], rest.T)
        by_immediate = [
            _sum_of_products(deltas[:, span], hidden[:, below]) for below, span in pairwise(spans)
        ]
        return deltas, None, by_initial, by_delayed, *by_immediate


def _run(
    drive: Tensor, keep: Tensor, initial: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """The activities h (T, N, B) of `_Scan`, computed forward."""
    steps, units, batch = drive.shape
    spans = _spans(delayed, immediate)
    keep = keep[:, None]
    hidden = drive.new_empty(steps, units, batch)
    potential = initial
    before = torch.tanh(initial)
    for t in range(steps):
        now = hidden[t]
        potential = torch.addcmul(drive[t], potential, keep).addmm_(delayed, before)
        torch.tanh(potential[spans[0]], out=now[spans[0]])
        for weights, (below, span) in zip(immediate, pairwise(spans), strict=True):
            part = potential[span].addmm_(weights, now[below])
            torch.tanh(part, out=now[span])
        before = now
    return hidden


def _run_back(
    by_hidden: Tensor, hidden: Tensor, keep: Tensor, delayed: Tensor, immediate: Sequence[Tensor]
) -> Tensor:
    """deltas[t] = dE/dv[t], (T, N, B): eq. (6), with the paths inside a step added."""
    spans = _spans(delayed, immediate)
    keep = keep[:, None]
    slopes = torch.addcmul(hidden.new_ones(()), hidden, hidden, value=-1)
    deltas = torch.empty_like(hidden)
    after = torch.zeros_like(hidden[0])
    delayed_back = delayed.T.contiguous()
    immediate_back = [weights.T.contiguous() for weights in immediate]
    for t in range(len(hidden) - 1, -1, -1):
        now = deltas[t]
        by_now = torch.addmm(by_hidden[t], delayed_back, after)
        kept = after * keep
        for level in range(len(spans) - 1, -1, -1):
            span = spans[level]
            if level < len(immediate):
                by_now[span].addmm_(immediate_back[level], now[spans[level + 1]])
            torch.addcmul(kept[span], slopes[t, span], by_now[span], out=now[span])
        after = now
    return deltas


def _sum_of_products(deltas: Tensor, sources: Tensor) -> Tensor:
    """Gradient (n, m) of weights from sources (T, m, B) to units with deltas (T, n, B)."""
    return torch.einsum("tnb,tmb->nm", deltas, sources)
