"""Texts that came from outside, such as ids and reasons, made safe to show, log and put in names.

A text that is shown as it came can forge lines of a log, clear a terminal or be taken for markup.
Everything that is shown passes through `plain`. Consoles also need `services.terminal.console`,
which takes no text for markup.
"""

from __future__ import annotations

from typing import Final

LONGEST: Final = 2000
"""Characters of a text that are shown; the rest is cut off."""


def plain(text: object, longest: int = LONGEST) -> str:
    r"""Return a text in one line without control codes.

    Characters that are not printable, line breaks among them, are written as escapes such as `\n`.

    Args:
        text: the text, or an object such as an exception whose text is meant.
        longest: number of characters to keep; `...` stands for the rest.
    """
    try:
        whole = str(text)
    except ValueError:  # an integer of more than 4,300 digits
        whole = f"a {type(text).__name__}"
    kept = whole if len(whole) <= longest else f"{whole[:longest]}..."
    if kept.isprintable():
        return kept
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in kept)


def plain_lines(text: object) -> str:
    """Return a text of several lines without control codes; its line breaks stay."""
    return "\n".join(plain(line) for line in str(text).split("\n"))
