"""`vmdnn doctor`: check this machine and say what to do."""

from __future__ import annotations

import argparse
import json
import textwrap
from dataclasses import asdict

from services.arguments.common import add_config, config_of
from services.machine.doctor import examine


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_config(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the findings; the exit status is 1 if there is a problem."""
    findings = list(examine(config_of(arguments)))
    if arguments.json:
        print(json.dumps([asdict(finding) | {"ok": finding.ok} for finding in findings], indent=2))
    else:
        for finding in findings:
            print(f"{'ok     ' if finding.ok else 'PROBLEM'} {finding.check}: {finding.found}")
            if not finding.ok:
                print(textwrap.indent(finding.advice, " " * 8))
    return 0 if all(finding.ok for finding in findings) else 1
