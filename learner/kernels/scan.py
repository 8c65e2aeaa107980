"""The recurrent scan in Triton; `learner.kernels.gpu` calls it.

One program runs one sequence through all steps. It holds the weights, as two square matrices of all
units, and the state in registers; of each step it only reads the drive and writes the activity.
Within a step a level acts on the next one: after as many sweeps over all units as there are such
levels, all are right.
"""

import triton
import triton.language as tl


@triton.jit
def _tanh(x):
    """A minimax fit, to 4e-7 relative: small activities keep their digits."""
    x = tl.minimum(tl.maximum(x, -9.0), 9.0)
    square = x * x
    above = 1.335340532e-08
    above = above * square + 2.060817859e-05
    above = above * square + 3.495534134e-03
    above = above * square + 1.338098080e-01
    above = above * square + 9.999999796e-01
    below = 7.776043805e-07
    below = below * square + 3.285545684e-04
    below = below * square + 2.587677853e-02
    below = below * square + 4.671429646e-01
    below = below * square + 1.0
    return x * above / below


@triton.jit
def _product(weights, x):
    return tl.sum(weights * x[None, :], axis=1)


@triton.jit
def _square(matrix, unit, units):
    real = unit < units
    at = unit[:, None] * units + unit[None, :]
    return tl.load(matrix + at, mask=real[:, None] & real[None, :], other=0.0)


@triton.jit
def run(
    drive,  # (B, T, N)
    keep,  # (N,)
    initial,  # (B, N)
    delayed,  # (N, N), to x from
    immediate,  # (N, N)
    hidden,  # (B, T, N), written
    steps,
    units,
    SWEEPS: tl.constexpr,
    PADDED: tl.constexpr,
):
    """Activity h = tanh(v), v[t] = keep v[t-1] + drive[t] + delayed h[t-1] + immediate h[t]."""
    sequence = tl.program_id(0)
    unit = tl.arange(0, PADDED)
    real = unit < units
    by_delayed = _square(delayed, unit, units)
    by_immediate = _square(immediate, unit, units)
    kept = tl.load(keep + unit, mask=real, other=0.0)
    potential = tl.load(initial + sequence * units + unit, mask=real, other=0.0)
    activity = _tanh(potential)
    at = sequence * steps * units + unit
    end = (sequence + 1) * steps * units
    now = tl.load(drive + at, mask=real, other=0.0)
    for _step in range(steps):
        following = tl.load(drive + at + units, mask=real & (at + units < end), other=0.0)
        delivered = kept * potential + now + _product(by_delayed, activity)
        potential = delivered
        activity = _tanh(potential)
        for _ in tl.static_range(SWEEPS):
            potential = delivered + _product(by_immediate, activity)
            activity = _tanh(potential)
        tl.store(hidden + at, activity, mask=real)
        now = following
        at += units


@triton.jit
def run_back(
    by_hidden,  # (B, T, N)
    hidden,  # (B, T, N)
    keep,  # (N,)
    delayed_back,  # (N, N), from x to
    immediate_back,  # (N, N)
    deltas,  # (B, T, N), written
    steps,
    units,
    SWEEPS: tl.constexpr,
    PADDED: tl.constexpr,
):
    """What h changes, by v: deltas[t] = keep deltas[t+1] + (1 - h[t]^2) dE/dh[t]."""
    sequence = tl.program_id(0)
    unit = tl.arange(0, PADDED)
    real = unit < units
    by_delayed = _square(delayed_back, unit, units)
    by_immediate = _square(immediate_back, unit, units)
    kept = tl.load(keep + unit, mask=real, other=0.0)
    after = tl.zeros_like(kept)
    begin = sequence * steps * units
    at = begin + (steps - 1) * units + unit
    wanted = tl.load(by_hidden + at, mask=real, other=0.0)
    activity = tl.load(hidden + at, mask=real, other=0.0)
    for _step in range(steps):
        earlier = real & (at - units >= begin)
        wanted_before = tl.load(by_hidden + at - units, mask=earlier, other=0.0)
        activity_before = tl.load(hidden + at - units, mask=earlier, other=0.0)
        slope = 1.0 - activity * activity
        arriving = wanted + _product(by_delayed, after)
        delta = kept * after + slope * arriving
        for _ in tl.static_range(SWEEPS):
            delta = kept * after + slope * (arriving + _product(by_immediate, delta))
        tl.store(deltas + at, delta, mask=real)
        after = delta
        wanted = wanted_before
        activity = activity_before
        at -= units
