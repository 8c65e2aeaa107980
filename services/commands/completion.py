"""`vmdnn completion`: a script that completes commands and options in the shell."""

from __future__ import annotations

import argparse

import shtab

from services.cli import whole_parser


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.epilog = (
        "For bash: vmdnn completion bash > ~/.local/share/bash-completion/completions/vmdnn;"
        " for zsh: a file called _vmdnn in a folder of $fpath."
    )
    parser.add_argument("shell", choices=shtab.SUPPORTED_SHELLS, help="the shell")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    print(shtab.complete(whole_parser(), arguments.shell))
    return 0
