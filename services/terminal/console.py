"""The console on which all commands show things to people."""

from __future__ import annotations

from rich.console import Console


def make_console(*, stderr: bool = False) -> Console:
    """Return a console that shows every text as it is, without markup or emoji codes.

    Texts from outside, such as `[/]` as the name of a simulator, would otherwise change the style
    of what follows, or raise an error.

    Args:
        stderr: write to standard error.
    """
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)
