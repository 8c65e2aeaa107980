"""The compiled recurrent core: what it refuses, and that threads and padding change nothing.

`tests/learner/training/test_divergence.py` compares its numbers with PyTorch's.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from learner.kernels import core
from learner.kernels.core import CoreGradients, CoreInputs, CoreSizes

SIZES = CoreSizes(
    inputs=21, units=(8, 11, 16), taus=(20.0, 5.0, 2.0), values=3, softmax_units=5, literal=False
)


def draw(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape)))


def inputs_of(sequences: int = 40, steps: int = 37) -> CoreInputs:
    pfc, slow, fast = SIZES.units
    outputs = SIZES.values * SIZES.softmax_units
    shapes = [
        *[(pfc, SIZES.inputs), (pfc, pfc), (pfc, slow), (pfc,)],
        *[(slow, pfc), (slow, slow), (slow, fast), (slow,)],
        *[(fast, slow), (fast, fast), (fast,)],
        *[(outputs, fast), (outputs,)],
    ]
    codes = draw(sequences, steps, SIZES.values, SIZES.softmax_units).softmax(-1)
    return CoreInputs(
        parameters=[0.3 * draw(*shape) for shape in shapes],
        seen=draw(sequences, steps, SIZES.inputs),
        codes=codes,
        code_entropies=torch.xlogy(codes, codes).sum((-1, -2)),
        mask=torch.ones(sequences, steps),
        chosen=torch.arange(sequences).flip(0),
    )


def compute(inputs: CoreInputs) -> list[Tensor]:
    """The loss and all gradients."""
    count, steps, units = len(inputs.chosen), inputs.seen.shape[1], SIZES.units
    gradients = CoreGradients(
        [torch.zeros_like(each) for each in inputs.parameters],
        by_drive=torch.empty(count, steps, units[0]),
        by_initial=torch.empty(count, sum(units)),
        by_shift=torch.empty(count, units[0]),
    )
    loss = core.divergence(SIZES, inputs, gradients)
    by = (gradients.by_drive, gradients.by_initial, gradients.by_shift)
    return [
        torch.tensor(loss),
        *gradients.by_parameters,
        *(each for each in by if each is not None),
    ]


def equal(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(compute(inputs_of()))
    finally:
        torch.set_num_threads(before)
    assert equal(results[0], results[1])
    assert equal(results[0], results[2])


def test_padding_has_no_effect() -> None:
    inputs = inputs_of(sequences=2)
    inputs.mask[0, 9:] = 0
    expected = compute(inputs)
    inputs.seen[0, 9:] = 7
    inputs.codes[0, 9:] = 0.1
    assert equal(compute(inputs), expected)


def test_arrays_need_not_be_contiguous() -> None:
    inputs = inputs_of(sequences=3)
    strided = {
        name: getattr(inputs, name).transpose(0, 1).contiguous().transpose(0, 1)
        for name in ("seen", "codes", "code_entropies", "mask")
    }
    assert equal(compute(replace(inputs, **strided)), compute(inputs))


def test_gradients_are_added() -> None:
    inputs = inputs_of(sequences=3)
    once = compute(inputs)[1:14]
    twice = [each.clone() for each in once]
    core.divergence(SIZES, inputs, CoreGradients(twice))
    for two, one in zip(twice, once, strict=True):
        torch.testing.assert_close(two, 2 * one)


@pytest.mark.parametrize("chosen", [[-1], [40], []])
def test_indices_outside_are_refused(chosen: list[int]) -> None:
    inputs = replace(inputs_of(), chosen=torch.tensor(chosen, dtype=torch.int64))
    with pytest.raises((IndexError, ValueError), match="chosen"):
        core.divergence(SIZES, inputs, CoreGradients())


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("seen", draw(40, 37, 20)),
        ("codes", draw(40, 37, 5, 3)),
        ("mask", torch.ones(40, 36)),
        ("initial", draw(39, 35)),
        ("shift", draw(40, 20)),
        ("seen", draw(40, 37, 21).double()),
    ],
)
def test_arrays_that_do_not_fit_are_refused(name: str, wrong: Tensor) -> None:
    with pytest.raises(ValueError, match="the network needs"):
        core.divergence(SIZES, replace(inputs_of(), **{name: wrong}), CoreGradients())


def test_parameters_that_do_not_fit_are_refused() -> None:
    inputs = inputs_of()
    parameters = [*inputs.parameters[:-1], draw(14)]
    with pytest.raises(ValueError, match=r"a parameter is \(14,\)"):
        core.divergence(SIZES, replace(inputs, parameters=parameters), CoreGradients())
