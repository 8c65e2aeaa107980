"""The recurrent scan in Triton; `learner.kernels.gpu` calls it.

One program runs one sequence through all steps. It holds the weights and the state in registers; of
each step it only reads the drive and writes the activity. Units of up to three levels are stacked,
the second level from unit SECOND on and the third from THIRD. Within a step each acts on the next,
so that they are computed one after the other.
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
def _matrix(matrix, unit, units, COLUMNS: tl.constexpr):
    """Weights (units, COLUMNS), filled up with zeros."""
    at = unit[:, None] * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    return tl.load(matrix + at, mask=(unit < units)[:, None], other=0.0)


@triton.jit
def _of_level(x, START: tl.constexpr, COUNT: tl.constexpr):
    """COUNT numbers of x from START on; beyond its end, any."""
    size: tl.constexpr = x.shape[0]
    return tl.gather(x, tl.minimum(START + tl.arange(0, COUNT), size - 1), axis=0)


@triton.jit
def run(
    drive,  # (B, T, N)
    initial,  # (B, N)
    keep,  # (N,)
    delayed,  # (N, PADDED), to x from
    immediate,  # (N, WIDTH), to x from the level before
    hidden,  # (B, T, N), written
    steps,
    units,
    LEVELS: tl.constexpr,
    SECOND: tl.constexpr,
    THIRD: tl.constexpr,
    PADDED: tl.constexpr,
    WIDTH: tl.constexpr,
):
    """Activity h = tanh(v), v[t] = keep v[t-1] + drive[t] + delayed h[t-1] + immediate h[t]."""
    sequence = tl.program_id(0)
    unit = tl.arange(0, PADDED)
    real = unit < units
    second = (unit >= SECOND) & (unit < THIRD)
    third = unit >= THIRD
    by_delayed = _matrix(delayed, unit, units, PADDED)
    by_immediate = _matrix(immediate, unit, units, WIDTH)
    kept = tl.load(keep + unit, mask=real, other=0.0)
    potential = tl.load(initial + sequence * units + unit, mask=real, other=0.0)
    activity = _tanh(potential)
    at = sequence * steps * units + unit
    end = (sequence + 1) * steps * units
    now = tl.load(drive + at, mask=real, other=0.0)
    for _step in range(steps):
        following = tl.load(drive + at + units, mask=real & (at + units < end), other=0.0)
        potential = kept * potential + now + _product(by_delayed, activity)
        activity = _tanh(potential)
        if LEVELS > 1:
            within = _product(by_immediate, _of_level(activity, 0, WIDTH))
            potential += tl.where(second, within, 0.0)
            activity = _tanh(potential)
        if LEVELS > 2:
            within = _product(by_immediate, _of_level(activity, SECOND, WIDTH))
            potential += tl.where(third, within, 0.0)
            activity = _tanh(potential)
        tl.store(hidden + at, activity, mask=real)
        now = following
        at += units


@triton.jit
def run_back(
    by_hidden,  # (B, T, N)
    hidden,  # (B, T, N)
    keep,  # (N,)
    delayed_back,  # (N, PADDED), from x to
    immediate_back,  # (N, WIDTH), from x to the level after
    deltas,  # (B, T, N), written
    steps,
    units,
    LEVELS: tl.constexpr,
    SECOND: tl.constexpr,
    THIRD: tl.constexpr,
    PADDED: tl.constexpr,
    WIDTH: tl.constexpr,
):
    """What h changes, by v: deltas[t] = keep deltas[t+1] + (1 - h[t]^2) dE/dh[t]."""
    sequence = tl.program_id(0)
    unit = tl.arange(0, PADDED)
    real = unit < units
    first = unit < SECOND
    second = (unit >= SECOND) & (unit < THIRD)
    by_delayed = _matrix(delayed_back, unit, units, PADDED)
    by_immediate = _matrix(immediate_back, unit, units, WIDTH)
    kept = tl.load(keep + unit, mask=real, other=0.0)
    delta = tl.zeros_like(kept)
    begin = sequence * steps * units
    at = begin + (steps - 1) * units + unit
    wanted = tl.load(by_hidden + at, mask=real, other=0.0)
    activity = tl.load(hidden + at, mask=real, other=0.0)
    for _step in range(steps):
        earlier = real & (at - units >= begin)
        wanted_before = tl.load(by_hidden + at - units, mask=earlier, other=0.0)
        activity_before = tl.load(hidden + at - units, mask=earlier, other=0.0)
        slope = 1.0 - activity * activity
        delta = kept * delta + slope * (wanted + _product(by_delayed, delta))
        if LEVELS > 2:
            within = slope * _product(by_immediate, _of_level(delta, THIRD, WIDTH))
            delta += tl.where(second, within, 0.0)
        if LEVELS > 1:
            within = slope * _product(by_immediate, _of_level(delta, SECOND, WIDTH))
            delta += tl.where(first, within, 0.0)
        tl.store(deltas + at, delta, mask=real)
        wanted = wanted_before
        activity = activity_before
        at -= units
