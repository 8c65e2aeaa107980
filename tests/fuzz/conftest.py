"""Shows the seed of the fuzzing tests."""

from __future__ import annotations

from inputs import SEED


def pytest_report_header() -> str:
    return f"fuzz: seed {SEED} (VMDNN_FUZZ_SEED)"
