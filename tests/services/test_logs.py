"""The log of a process: as JSON, and more or less of it."""

from __future__ import annotations

import json
import logging
from argparse import Namespace
from collections.abc import Iterator

import pytest

from services.arguments.logs import ProcessLog


@pytest.fixture(autouse=True)
def kept_logging() -> Iterator[None]:
    names = (None, "proto", "learner", "actors", "services")
    loggers = [logging.getLogger(name) for name in names]
    before = [(logger.handlers[:], logger.level) for logger in loggers]
    yield
    for logger, (handlers, level) in zip(loggers, before, strict=True):
        logger.handlers[:] = handlers
        logger.setLevel(level)


def log(**options: object) -> ProcessLog:
    given = {"log_format": "text", "quiet": False, "verbose": False, **options}
    return ProcessLog("actor", Namespace(**given))


def test_json_records_name_run_role_and_id(capfd: pytest.CaptureFixture[str]) -> None:
    started = log(log_format="json")
    started.run, started.id = "smoke", "vm-1"
    logging.getLogger("actors.actor").info("acts with policy %d\n%s", 3, "\x1b[2J")
    try:
        raise ValueError("broken")
    except ValueError:
        logging.getLogger("actors.actor").exception("failed")
    first, second = map(json.loads, capfd.readouterr().err.splitlines())
    assert (first["level"], first["run"], first["role"], first["id"]) == (
        *("info", "smoke", "actor", "vm-1"),
    )
    assert first["message"] == "acts with policy 3\n\\x1b[2J"
    assert first["time"].endswith("+00:00")
    assert "ValueError: broken" in second["trace"]


@pytest.mark.parametrize(
    ("options", "levels"),
    [
        ({"quiet": True}, ["WARNING"]),
        ({}, ["INFO", "WARNING"]),
        ({"verbose": True}, ["DEBUG", "INFO", "WARNING"]),
    ],
)
def test_options_choose_how_much_is_logged(
    options: dict[str, object], levels: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    log(**options)
    ours, theirs = logging.getLogger("actors.actor"), logging.getLogger("zenoh")
    ours.debug("detail")
    ours.info("news")
    ours.warning("trouble")
    theirs.debug("detail of a library")
    assert [line.split()[3] for line in capfd.readouterr().err.splitlines()] == levels
