"""The view of a run in a real terminal: a pseudo terminal whose output pyte interprets."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios

import pytest

pyte = pytest.importorskip("pyte")

PROGRAM = """
from dataclasses import replace
from run_metrics import ACTOR, EVALUATOR, LEARNER, RECORDER, view_of
from proto.keys import Role
from proto.metrics import Stage
from services.terminal.console import make_console
from services.terminal.display import display
from services.terminal.run_progress import ProgressMeter

started = {Role.LEARNER: 1, Role.EVALUATOR: 1, Role.RECORDER: 1, Role.ACTOR: 2}
times = iter(float(10 * number) for number in range(100))
waiting = replace(
    ACTOR, policy_version=0, steps_per_s=0.0, episodes=0, waiting_for="the first policy"
)
begun = replace(
    LEARNER, stage=Stage.WAITING, epoch=0, sequences=13, loss=None, epochs_per_s=0.0,
    policy_version=0,
)
meter = ProgressMeter(started_s=0.0, clock=lambda: next(times))
with display(make_console(), meter, started) as show:
    show(view_of())
    input()
    show(view_of(begun, waiting))
    input()
    for number in range(8):
        actors = [replace(ACTOR, id=f"machine-{n}", episodes=number) for n in range(16)]
        show(view_of(replace(LEARNER, epoch=100 * number), EVALUATOR, RECORDER, *actors))
    input()
"""


class Terminal:
    """A program in a pseudo terminal."""

    def __init__(self, program: str, columns: int, rows: int, **variables: str) -> None:
        self.screen = pyte.Screen(columns, rows)
        self._stream = pyte.ByteStream(self.screen)
        self.bytes = b""
        self._master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        settings = termios.tcgetattr(slave)
        settings[3] &= ~termios.ECHO  # a line break that is typed would move the screen
        termios.tcsetattr(slave, termios.TCSANOW, settings)
        environment = {k: v for k, v in os.environ.items() if k not in {"COLUMNS", "LINES"}}
        here = os.path.abspath("tests")  # noqa: PTH100
        environment |= {"TERM": "xterm-256color", "PYTHONPATH": f"{here}{os.pathsep}{os.getcwd()}"}  # noqa: PTH109
        self.process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=slave, stdout=slave, stderr=slave, env=environment | variables,
        )  # fmt: skip
        os.close(slave)

    def read_until(self, text: str) -> list[str]:
        """Read until a text is on the screen; return its lines."""
        while not any(text in line for line in self.screen.display):
            part = os.read(self._master, 65536)
            self.bytes += part
            self._stream.feed(part)
        return [line.rstrip() for line in self.screen.display]

    def press_return(self) -> None:
        os.write(self._master, b"\r")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)


@pytest.mark.parametrize(("columns", "rows"), [(80, 24), (200, 50)])
def test_the_view_fits_the_terminal_from_the_first_second_on(columns: int, rows: int) -> None:
    terminal = Terminal(PROGRAM, columns, rows)
    try:
        text = " ".join(" ".join(terminal.read_until("simulator)")).split())
        assert "starting learner, evaluator, recorder and 2 actors" in text
        terminal.press_return()
        lines = terminal.read_until("1 actor, waiting for the first policy")
        text = " ".join(" ".join(lines).split())
        assert "waiting for sequences: 13 of 45 sequences" in text
        assert "policy 0 of 13" in text
        terminal.press_return()
        terminal.read_until("epoch 700 of 2500")
        lines = terminal.read_until("imprecise 2")  # the last line is drawn last
        text = "\n".join(lines)
        assert "policy 3 of 13" in text
        assert "so far" in text
        assert "left" in text
        assert lines[0].startswith("run watched"), "the first line has not scrolled away"
        assert "machine-0" in text
        assert "not precise: moved object 4, imprecise 2" in text, "the last line is there"
        assert ("machine-9" in text) == (rows == 50)
        assert "…" not in text
    finally:
        terminal.close()


def test_no_color_is_obeyed() -> None:
    terminal = Terminal(PROGRAM, 80, 24, NO_COLOR="1")
    try:
        terminal.read_until("simulator)")
        terminal.press_return()
        terminal.read_until("waiting for sequences")
        colours = {c.fg for line in terminal.screen.buffer.values() for c in line.values()}
        assert colours <= {"default"}
    finally:
        terminal.close()
