"""`vmdnn recover`: save what is whole of a damaged or truncated MCAP file."""

from __future__ import annotations

import argparse
from pathlib import Path

from proto.recordings.recovery import recover


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    parser.add_argument(
        "file", type=Path, help="MCAP file, or the .part file that a killed process left"
    )
    parser.add_argument(
        "--out", type=Path, help="file to write; without it, the file itself is repaired"
    )


def run(arguments: argparse.Namespace) -> int:
    """Recover the file and print how much of it was intact."""
    found = recover(arguments.file, arguments.out)
    target = arguments.out or arguments.file
    kept = f"{found.messages} messages"
    if found.steps_played is not None:
        kept += f", {found.steps} of {found.steps_played} steps"
    if found.intact:
        copied = "" if arguments.out is None else f"; copied to {target}"
        print(f"{arguments.file} is whole ({kept}){copied}")
    else:
        print(f"{target}: kept {kept}")
    return 0
