"""`vmdnn control`: pause, resume, checkpoint or stop the processes of a role."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from typing import Final

from proto.codec import encode
from proto.keys import Role
from proto.messages import Command, Control, ControlReply
from proto.permissions import Holder
from proto.plain_text import plain
from services.arguments.common import add_connection, config_of
from services.arguments.watching import add_wait, open_bus_within

ROLES: Final = tuple(role for role in Role if role is not Role.WATCH)
"""Roles whose processes reply to control messages."""
REPLY_WITHIN_S: Final = 60.0
"""Longest time to wait for replies: the learner writes a checkpoint after its current epoch."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "role", choices=[role.value for role in ROLES], help="role of the processes"
    )
    parser.add_argument("do", choices=[command.value for command in Command], help="the command")
    add_connection(parser)
    add_wait(parser)
    parser.add_argument("--json", action="store_true", help="print the replies as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Send the command and print the replies; without replies the exit status is 1."""
    config = config_of(arguments)
    role, control = Role(arguments.role), Control(Command(arguments.do))
    name = f"control-{os.getpid()}"
    with open_bus_within(config, name, arguments.wait, holder=Holder.OPERATOR) as bus:
        replies = bus.ask(bus.keys.control(role), control, ControlReply, timeout_s=REPLY_WITHIN_S)
    if not replies:
        print(
            f"no {role} of run {config.run.name!r} replies; `vmdnn watch --once` shows the "
            "processes of a run. Choose another run with --set run.name=NAME or "
            "--config RUN/config.yaml",
            file=sys.stderr,
        )
        return 1
    _show(sorted(replies, key=lambda reply: reply.id), as_json=arguments.json)
    return 0


def _show(replies: Sequence[ControlReply], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps([json.loads(encode(reply).payload) for reply in replies], indent=2))
        return
    for reply in replies:
        print(plain(f"{reply.role} {reply.id}: {reply.note}"))
