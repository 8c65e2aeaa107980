"""A person who tutors Experiment I through the page: by its keys, buttons and pictures only.

The person reads on the page where hand, object and obstacle are.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Final

from playwright.sync_api import Page

PATIENCE_S: Final = 600.0
COARSE_CM, FINE_CM = 2.0, 0.4
COARSE_DEG, FINE_DEG = 10.0, 2.0
KEYS: Final = (("d", "a"), ("w", "s"), ("r", "f"))
"""Keys that move the hand to and fro: to the right, forward, up."""

# The middle of the pixels of a colour in a picture of the page, as shares of its width and height.
_MIDDLE: Final = """([id, colour]) => {
  const image = document.getElementById(id);
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
  let [x, y, count] = [0, 0, 0];
  for (let at = 0; at < data.length; at += 4) {
    const [red, green, blue] = [data[at], data[at + 1], data[at + 2]];
    const hue = colour === "red" ? green < 0.55 * red : green > 0.75 * red;
    if (red > 120 && blue < 0.55 * red && hue) {
      x += (at / 4) % canvas.width; y += Math.floor(at / 4 / canvas.width); count += 1;
    }
  }
  return count < 20 ? null : [x / count / canvas.width, y / count / canvas.height];
}"""


class Person:
    """Sits before the page."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def tutor(self) -> str:
        """Show Experiment I in the situation of the page; what the page says of it at the end."""
        self.next_phase()  # observe
        self.click("eye", "yellow")
        self.next_phase()  # attend obstacle
        self.bring(up=26, tolerance=0.6)
        self.bring(forward=30, tolerance=1.2)
        self.bring(right=self.thing("obstacle")[0] - 8, tolerance=1.2)
        self.next_phase()  # move over obstacle
        self.click("eye", "red")
        self.next_phase()  # attend object
        right, forward, _, yaw = self.thing("object")
        self.bring(right=11, forward=29, up=18, tolerance=1.2)
        self.bring(yaw=yaw)  # while there is room
        self.bring(*_behind(right, forward, yaw, 3), up=11, yaw=yaw, tolerance=0.6)
        self.bring(*_behind(right, forward, yaw, 2), up=10, yaw=yaw, tolerance=0.4)
        self.next_phase()  # reach above object
        self.hold("+", until="document.getElementById('focus').textContent === '20.0'")
        self.bring(*_behind(right, forward, yaw, 1), up=8.5, yaw=yaw)
        for height in (6.5, 3.7):
            self.bring(right, forward, height, yaw)
        self.next_phase()  # descend
        self.hold("g", until="document.getElementById('grasp').textContent === '10.0'")
        self.next_phase()  # grasp
        self.bring(up=15, tolerance=0.6)
        self.press("Enter")
        return self.text("state")

    def next_phase(self) -> None:
        self.press("n")

    def press(self, key: str) -> None:
        """Press a key and wait until the robot has done what it stands for."""
        self.page.keyboard.press(key)
        self.wait()

    def hold(self, key: str, *, until: str) -> None:
        """Hold a key until the page shows something."""
        self.page.keyboard.down(key)
        self.wait_until(until)
        self.page.keyboard.up(key)
        self.wait()

    def wait(self) -> None:
        """Wait until the robot is not busy."""
        self.wait_until("document.body.dataset.busy === 'false'")

    def wait_until(self, condition: str) -> None:
        """Wait for a condition in JavaScript, looking often; `expect` looks less often."""
        over_s = time.monotonic() + PATIENCE_S
        while not self.page.evaluate(condition):
            assert time.monotonic() < over_s, f"never happened: {condition}"
            self.page.wait_for_timeout(10)

    def click(self, picture: str, colour: str) -> None:
        """Click the middle of what has a colour, as soon as the picture shows the present."""
        self.wait_until("document.body.dataset.pictured === document.body.dataset.done")
        self.wait_until(f"document.getElementById('{picture}').complete")
        middle = self.page.evaluate(_MIDDLE, [picture, colour])
        if middle is None:
            return  # it is not in the picture: the person does without
        box = self.page.locator(f"#{picture}").bounding_box()
        assert box is not None
        self.page.mouse.click(
            box["x"] + middle[0] * box["width"], box["y"] + middle[1] * box["height"]
        )
        self.wait()

    def text(self, name: str) -> str:
        return self.page.locator(f"#{name}").text_content() or ""

    def thing(self, name: str) -> Sequence[float]:
        """Where something is, as the page says: right, forward, up (cm), turned (degrees)."""
        cells = self.page.locator(f"#things tr[data-name={name}] td").all_text_contents()
        return [_number(cell) for cell in cells[1:]]

    def bring(
        self,
        right: float | None = None,
        forward: float | None = None,
        up: float | None = None,
        yaw: float | None = None,
        tolerance: float = 0.25,
    ) -> None:
        """Bring the hand to a place (cm, degrees) with keys, as well as it goes."""
        for _ in range(40):
            if not self._step((right, forward, up), yaw, tolerance):
                return
            if self.text("problem"):
                return

    def _step(self, wanted_cm: Sequence[float | None], yaw: float | None, tolerance: float) -> bool:
        """Press one key; False if the hand is there."""
        names = ("hand-right", "hand-forward", "hand-up")
        ways = [
            0.0 if wanted is None else wanted - _number(self.text(name))
            for name, wanted in zip(names, wanted_cm, strict=True)
        ]
        axis = max(range(3), key=lambda each: abs(ways[each]))
        if abs(ways[axis]) > tolerance:
            key = KEYS[axis][ways[axis] < 0]
            self.press(key if abs(ways[axis]) > 0.8 * COARSE_CM else f"Shift+{key.upper()}")
            return True
        turn = 0.0 if yaw is None else yaw - _number(self.text("hand-turned"))
        if abs(turn) > 1.25 * FINE_DEG:
            key = "q" if turn > 0 else "e"
            self.press(key if abs(turn) > 0.8 * COARSE_DEG else f"Shift+{key.upper()}")
            return True
        return False


def _behind(right: float, forward: float, yaw: float, distance: float) -> tuple[float, float]:
    """A place beside the end of the object that is far from the body, along its long side (cm)."""
    turned = math.radians(yaw)
    return right - distance * math.sin(turned), forward + distance * math.cos(turned)


def _number(text: str) -> float:
    return float(text.removesuffix("°").removesuffix(" cm"))
