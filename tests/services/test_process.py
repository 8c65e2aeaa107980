"""Every process waits for the hub, however long it takes, and ends when it is asked to."""

from __future__ import annotations

from pathlib import Path

from ports import free_endpoint
from processes import eventually, listening_hub, stop, vmdnn


def test_it_waits_for_a_hub_that_is_away_and_for_one_that_is_lost(tmp_path: Path) -> None:
    endpoint, log = free_endpoint(), tmp_path / "log"
    words = ("--connect", endpoint, "--set", f"run.folder={tmp_path}")

    def says(text: str, times: int = 1) -> None:
        eventually(lambda: log.read_text().count(text) == times, f"the log says: {text}")

    with vmdnn("recorder", *words, log=log) as process:
        says(f"no hub answers at {endpoint}: start one with `vmdnn hub`")
        says(f"waiting for the hub at {endpoint}")
        with listening_hub(endpoint):
            says(f"connected to the hub at {endpoint}")
        says(f"lost the hub at {endpoint}; waiting for it")
        with listening_hub(endpoint):
            says(f"the hub at {endpoint} is back")
            assert stop(process) == 0
    assert "Traceback" not in log.read_text()


def test_it_can_be_stopped_while_it_waits_for_the_hub(tmp_path: Path) -> None:
    log = tmp_path / "log"
    words = ("--connect", free_endpoint(), "--set", f"run.folder={tmp_path}")
    with vmdnn("evaluator", *words, log=log) as process:
        eventually(lambda: "no hub answers" in log.read_text(), "it waits")
        assert stop(process) == 0
