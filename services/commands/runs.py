"""`vmdnn runs`: the runs in a folder, with their best policy."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from proto.errors import UserError
from proto.plain_text import plain
from services.terminal.console import make_console
from services.terminal.rates import rate_text
from services.trials.run_folder import RunFolder
from services.trials.success import Tally


@dataclass(frozen=True)
class _Found:
    """A run, and its best policy version in its first suite.

    Attributes:
        run: the run.
        newest: its newest version; 0 for none.
        best: the best version; None if no trial was counted.
        tally: the counted trials of the best version.
        changed_s: when a policy or a counted trial was written last (Unix time); 0.0 for never.
    """

    run: RunFolder
    newest: int
    best: int | None
    tally: Tally
    changed_s: float

    @classmethod
    def of(cls, run: RunFolder) -> _Found:
        """Find the best version of a run."""
        suite = run.config.suites[0]
        best = run.best_version(suite)
        tally = Tally() if best is None else run.tally(best, suite)
        return cls(run, max(run.versions, default=0), best, tally, run.changed_s)

    def as_json(self) -> dict[str, Any]:
        """Return it for `json.dumps`."""
        return {
            "run": self.run.config.run.name,
            "folder": str(self.run.folder),
            "task": self.run.config.task.name,
            "newest_version": self.newest,
            "best_version": self.best,
            **self.tally.as_json(),
            "changed_s": self.changed_s,
        }


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "folder", type=Path, nargs="?", default=Path("runs"), help="folder that holds runs"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(arguments: argparse.Namespace) -> int:
    """List the runs, the one that changed last first."""
    files = sorted(arguments.folder.glob("*/config.yaml"))
    if not files:
        raise UserError(
            f"{arguments.folder} holds no run (*/config.yaml); deploy/run_local.sh plays one"
        )
    console = make_console(stderr=True)
    found = []
    for file in files:
        try:
            found.append(_Found.of(RunFolder.open(file.parent)))
        except UserError as error:
            console.print(plain(f"{file.parent} is left out: {error}"), soft_wrap=True)
    found.sort(key=lambda each: -each.changed_s)
    if arguments.json:
        print(json.dumps([each.as_json() for each in found], indent=2))
    else:
        make_console().print(_table(found))
    return 0


def _table(found: list[_Found]) -> Table:
    table = Table(
        box=None,
        padding=(0, 1, 0, 0),
        caption="best: the version with the most reliable success in the first suite",
    )
    for heading in ("run", "versions", "best", "trials", "strict", "precise", "last change"):
        table.add_column(heading, justify="left" if heading == "run" else "right")
    for each in found:
        best, tally = each.best, each.tally
        rates = [rate_text(tally.rate(reading), digits=0) for reading in ("strict", "precise")]
        changed = time.strftime("%m-%d %H:%M", time.localtime(each.changed_s))
        table.add_row(
            plain(each.run.config.run.name),
            str(each.newest),
            *(("", "", "", "") if best is None else (str(best), str(tally.trials), *rates)),
            changed if each.changed_s else "",
        )
    return table
