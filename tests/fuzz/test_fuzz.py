"""Whatever bytes a decoder gets, it raises its declared error or reads them.

The default run gives the decoders 20,000 inputs, `pytest -m fuzz tests/fuzz` a million, or
VMDNN_FUZZ_INPUTS. An input is made from VMDNN_FUZZ_SEED, the decoder's name and a number, which the
failure names; `VMDNN_FUZZ_REPLAY=NUMBER pytest -m fuzz tests/fuzz -k NAME` gives that input alone.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from decoders import DECODERS
from inputs import SEED, make_input

from proto.errors import UserError

SLOWEST_S = 1.0
"""Processor time of an input, at most; no input here is larger than 1 MiB."""
LONGEST_ERROR = 10_000
DEFAULT = 20_000
MANY = int(os.environ.get("VMDNN_FUZZ_INPUTS", "1000000"))
REPLAY = os.environ.get("VMDNN_FUZZ_REPLAY")

each_decoder = pytest.mark.parametrize("name", DECODERS)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """An empty folder, in memory where possible, because files are synced when written."""
    memory = Path("/dev/shm")
    if not os.access(memory, os.W_OK):
        yield tmp_path
        return
    with TemporaryDirectory(dir=memory) as made:
        yield Path(made)


def numbers(total: int, name: str) -> range:
    """Numbers of the inputs of a decoder."""
    if REPLAY is not None:
        return range(int(REPLAY), int(REPLAY) + 1)
    return range(round(total * DECODERS[name].share))


def give(name: str, inputs: range, folder: Path) -> None:
    decoder = DECODERS[name]
    valid = decoder.valid(folder)
    for number in inputs:
        content = make_input(SEED, name, number, valid)
        began_s, told = time.process_time(), ""
        try:
            decoder.read(content, folder)
        except decoder.errors as error:
            told = str(error)
        except BaseException as error:
            error.add_note(f"{name}: input {number} of seed {SEED}: {content[:200]!r}")
            raise
        assert len(told) < LONGEST_ERROR, f"input {number} of seed {SEED}: {told[:200]}"
        took_s = time.process_time() - began_s
        assert took_s < SLOWEST_S, f"input {number} of seed {SEED} took {took_s:.2f} s"


@each_decoder
def test_valid_inputs_are_read(name: str, folder: Path) -> None:
    decoder = DECODERS[name]
    for content in decoder.valid(folder):
        with (
            pytest.raises(UserError, match="no such key") if b"x: &a" in content else nullcontext()
        ):
            decoder.read(content, folder)


def test_the_shares_are_of_all_inputs() -> None:
    assert sum(decoder.share for decoder in DECODERS.values()) == pytest.approx(1.0)


def test_an_input_is_made_again_from_its_number() -> None:
    made = [make_input(1, "config", number, [b"a: 1", b"b: 2"]) for number in range(50)]
    again = [make_input(1, "config", number, [b"a: 1", b"b: 2"]) for number in range(50)]
    assert made == again
    assert len(set(made)) > 40


@each_decoder
def test_decoders_raise_their_declared_error(name: str, folder: Path) -> None:
    give(name, numbers(DEFAULT, name), folder)


@pytest.mark.fuzz
@pytest.mark.timeout(0)
@each_decoder
def test_decoders_raise_their_declared_error_for_many_inputs(name: str, folder: Path) -> None:
    give(name, numbers(MANY, name), folder)
