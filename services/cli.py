"""The `vmdnn` command: one subcommand for each process and tool."""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from collections.abc import Collection, Sequence
from difflib import get_close_matches
from importlib.metadata import version
from typing import Final, NoReturn, Protocol, cast

from proto.errors import UserError
from proto.plain_text import plain_lines


class Subcommand(Protocol):
    """A module that is a subcommand."""

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the subcommand's arguments."""

    def run(self, arguments: argparse.Namespace) -> int:
        """Run the subcommand and return the exit status."""


# A module is imported only when its subcommand is used: `vmdnn hub` does not import torch.
COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "hub": ("services.commands.hub", "the router that all processes connect to"),
    "learner": ("services.commands.learner", "store tutoring, train, publish policies"),
    "actor": ("services.commands.actor", "play scenes with the newest policy"),
    "evaluator": ("services.commands.evaluator", "assign trials and count successes"),
    "recorder": ("services.commands.recorder", "record every episode as MCAP"),
    "watch": ("services.commands.watch", "show what all processes are doing"),
    "metrics": ("services.commands.metrics", "tell the metrics of a run to Prometheus"),
    "live": ("services.commands.live", "show the actors of a run in Foxglove, as they act"),
    "dashboard": ("services.commands.dashboard", "show a run in the browser, live"),
    "control": ("services.commands.control", "pause, resume or stop processes of a run"),
    "tutor": ("services.commands.tutor", "record tutoring sequences, without the bus"),
    "train": ("services.commands.train", "train a network on recorded sequences"),
    "evaluate": ("services.commands.evaluate", "test a policy in situations not tutored"),
    "compare": ("services.commands.compare", "train and test VMDNN and other networks"),
    "compare-trials": (
        "services.commands.compare_trials",
        "compare two policies in the same situations",
    ),
    "figure": ("services.commands.figure", "draw a figure of the paper, or of failures"),
    "replay": ("services.commands.replay", "make a video of a recorded episode"),
    "export": ("services.commands.export", "write recordings in a format of others"),
    "import": ("services.commands.import_sequences", "learn from what others have recorded"),
    "recover": ("services.commands.recover", "save what is whole of a damaged MCAP file"),
    "check": ("services.commands.check", "look for damage in the folder of a run"),
    "runs": ("services.commands.runs", "list runs with their best policy"),
    "rollouts": ("services.commands.rollouts", "list the recorded rollouts of a run"),
    "compare-runs": ("services.commands.compare_runs", "compare two runs side by side"),
    "config": ("services.commands.config", "show all keys of the configuration"),
    "inspect": ("services.commands.inspect", "show a network, a checkpoint, a task or its vision"),
    "bench": ("services.commands.bench", "measure speed on this machine"),
    "completion": ("services.commands.completion", "print a script that completes commands"),
    "doctor": ("services.commands.doctor", "check this machine and say what to do"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand.

    Args:
        argv: the arguments; None for those of the process.

    Returns:
        The exit status: 2 after a message about bad input.
    """
    _use_one_thread()
    words = list(sys.argv[1:] if argv is None else argv)
    chosen = next((word for word in words if not word.startswith("-")), None)
    arguments = _parser([] if chosen is None else [chosen]).parse_args(words)
    try:
        return int(arguments.run(arguments))
    except UserError as error:
        print(f"vmdnn {arguments.command}: {plain_lines(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of the output, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def whole_parser() -> argparse.ArgumentParser:
    """Return a parser that knows the arguments of all subcommands; it imports all modules."""
    return _parser(COMMANDS)


class _Parser(argparse.ArgumentParser):
    """A parser that names a similar word, and tells the usage of the subcommand that was meant."""

    def parse_known_args(  # type: ignore[override]  # argparse has overloads for the namespace
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse; refuse here what is not known, not in the parser of the whole command."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Print the usage and what is wrong, and exit with the status 2."""
        if found := re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)$", message):
            word, choices = found.groups()
            similar = get_close_matches(word, re.findall(r"[\w-]+", choices), n=1)
            if similar:
                message = f"{message[: found.start()]}{word!r}: did you mean {similar[0]}?"
        super().error(message)


def _parser(configured: Collection[str]) -> argparse.ArgumentParser:
    """Return a parser that knows all subcommands, and the arguments of those in `configured`."""
    parser = _Parser(
        prog="vmdnn",
        description="Tutor simulated iCub humanoids with VMDNN, from one laptop to a cluster.",
        epilog="`vmdnn COMMAND --help` explains a command.",
    )
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('vmdnn')}")
    for name, (module, summary) in COMMANDS.items():
        subparser = subparsers.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        if name in configured:
            command = cast("Subcommand", importlib.import_module(module))
            command.configure(subparser)
            subparser.set_defaults(run=command.run)
    return parser


def _use_one_thread() -> None:
    """Keep numpy from starting a thread for each core; must run before numpy is imported.

    The matrix products here are small. With many processes on a few cores, such threads would make
    them more than ten times slower. The learner sets the number of its threads itself.
    """
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")


if __name__ == "__main__":
    sys.exit(main())
