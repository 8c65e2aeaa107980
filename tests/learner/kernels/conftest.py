"""Skips the tests of kernels on machines that cannot compile them."""

from __future__ import annotations

import pytest

from learner.kernels.build import NotCompiledError, find_or_compile


@pytest.fixture(autouse=True, scope="session")
def _compiled() -> None:
    try:
        find_or_compile()
    except NotCompiledError as error:
        pytest.skip(f"the C++ kernels are not compiled here: {error}")
