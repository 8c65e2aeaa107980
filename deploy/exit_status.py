"""Turns what ends a command of this folder into a message and an exit status."""

from __future__ import annotations

import sys
from collections.abc import Callable

from deploy.processes import BAD_INPUT
from deploy.supervision import ProcessFailedError, SupervisorEndedError
from proto.errors import UserError
from proto.plain_text import plain_lines


def exit_status(command: str, work: Callable[[], None], *, again: str = "") -> int:
    """Do the work of a command, and return its exit status.

    Args:
        command: name of the command, for messages on standard error.
        work: what the command does.
        again: what the user may do after supervisord was killed; empty if the command starts none.

    Returns:
        0 if the work is done, 1 after supervisord was killed, 2 after bad input, 130 after Ctrl-C.
    """
    try:
        work()
    except (UserError, ProcessFailedError) as error:
        print(f"{command}: {plain_lines(error)}", file=sys.stderr)
        return BAD_INPUT
    except SupervisorEndedError as error:
        print(f"{command}: {error}; {again}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # before signals were handled: nothing was started
        return 130
    return 0
