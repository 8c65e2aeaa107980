"""`vmdnn check`: look for what is damaged, missing or left over in the folder of a run."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from proto.plain_text import plain
from services.run_check import Report, check_run, recordings_of
from services.terminal.progress import progress_bar


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of the run")
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")


def run(arguments: argparse.Namespace) -> int:
    """Check the run; 0 if all is well, 1 if something was found. Nothing is changed."""
    folder: Path = arguments.folder
    with progress_bar("recordings", len(recordings_of(folder))) as advance:
        report = check_run(folder, advance)
    if arguments.json:
        print(json.dumps({"run": str(folder), **asdict(report)}, indent=2))
    else:
        _print(folder, report)
    return 1 if report.findings else 0


def _print(folder: Path, report: Report) -> None:
    for finding in report.findings:
        print(f"{plain(finding.place, 300)}: {plain(finding.problem, 500)}")
        print(f"    {plain(finding.advice, 500)}")
    for note in report.notes:
        print(f"note: {note}")
    looked_at = ", ".join(f"{count} {what}" for what, count in report.counts.items())
    found = len(report.findings)
    verdict = "nothing is wrong" if not found else f"{found} finding{'s' if found > 1 else ''}"
    print(f"{folder}: {verdict} ({looked_at})")
