"""`vmdnn import`: make tutoring sequences of what others have recorded."""

from __future__ import annotations

import argparse
from pathlib import Path

from learner.tutoring.store import TutoringStore
from proto.errors import UserError
from services.exchange.eipl import import_eipl
from services.exchange.joint_map import read_joint_map
from services.exchange.lerobot import import_lerobot


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommand's arguments."""
    parser.add_argument("folder", type=Path, help="folder of the data")
    parser.add_argument(
        "--format", required=True, choices=("lerobot", "eipl"), help="what the folder holds"
    )
    parser.add_argument("--task", required=True, help="name of the task that the sequences show")
    parser.add_argument(
        "--joints",
        type=Path,
        help="YAML file that maps their joints to ours; without it, the data must be vmdnn's own",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the sequences")


def run(arguments: argparse.Namespace) -> int:
    """Import all sequences, or none if one of them does not fit."""
    if not arguments.folder.is_dir():
        raise UserError(f"{arguments.folder}: there is no such folder")
    joint_map = None if arguments.joints is None else read_joint_map(arguments.joints)
    read = {"lerobot": import_lerobot, "eipl": import_eipl}[arguments.format]
    for _ in read(arguments.folder, joint_map, arguments.task):
        pass  # the data are checked as a whole before the first sequence is written
    store = TutoringStore(arguments.out)
    added = [store.add(each) for each in read(arguments.folder, joint_map, arguments.task)]
    known = len(added) - sum(added)
    print(
        f"{arguments.out}: {sum(added)} sequences imported"
        + (f", {known} were there already" if known else "")
    )
    print(
        "their situations are not known, so pre-training cannot ask for them: train with"
        " --set learner.pretraining.epochs=0, or with --pretraining-data"
    )
    return 0
