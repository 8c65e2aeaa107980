"""Runs the conformance suite on all installed built-in backends, or on that of `--backend`."""

from __future__ import annotations

import pytest

from actors.simulator import installed_backends

OPTION = "--backend"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        OPTION,
        metavar="package.module:Class",
        help="run the conformance suite on this backend, and nothing else",
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "backend" in metafunc.fixturenames:
        chosen = _chosen(metafunc.config)
        names = installed_backends() if chosen is None else [chosen]
        metafunc.parametrize("backend", names, scope="session")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With `--backend`, leave out what tests a particular built-in backend."""
    if _chosen(config) is not None:
        others = [item for item in items if "backend" not in getattr(item, "fixturenames", ())]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if item not in others]


def _chosen(config: pytest.Config) -> str | None:
    # pytest has the option only if this folder is named on its command line.
    chosen: str | None = config.getoption(OPTION, default=None)
    return chosen
