"""A person before a real browser: what the page says, and what a real run learns from it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from pages import PHONE, fits, needs_chromium, opened, started_browser
from person import PATIENCE_S, Person
from playwright.sync_api import Browser, expect
from ports import free_endpoint
from processes import eventually, listening_hub, stop, vmdnn

from learner.tutoring.store import TutoringStore
from proto.bus import open_bus
from proto.config import HubConfig
from proto.episode import Episode, Kind
from proto.keys import Role
from proto.lifecycle import Lifecycle
from proto.metrics import METRICS, EpochMetrics, LearnerMetrics, Metrics, Stage
from proto.periodic import every
from services.by_hand.robot import Robot
from services.by_hand.server import make_app
from services.dashboard.access import Access
from services.dashboard.ports import address_of, listening_socket
from services.dashboard.server import serving

PATIENCE_MS = 1e3 * PATIENCE_S
opened_page = partial(opened, patience_ms=PATIENCE_MS, may_be_away=True)

CASES = range(0, 40, 2)
"""Of the 45 tutored cases; corners and edges of the ranges are among them."""
LEAST = 18
SETTINGS = {
    "run.name": "shown",
    "simulator.backend": "mujoco",
    "actor.practice": "false",
    "tutor.repeats": 2,
    "learner.cases": list(CASES),
    "learner.start_sequences": 2 * len(CASES) - 1,
    "learner.lease_s": 7200.0,
    "learner.pretraining.epochs": 2,
    "learner.epochs": 10,
    "learner.warmup_epochs": 1,
    "learner.publish_every_epochs": 10,
    "learner.corrections": {"rounds": 1, "choose": "random", "sequences": 1, "epochs": 2},
}

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started_browser() as started:
        yield started


@contextmanager
def idle_page(port: int = 0) -> Iterator[str]:
    """Serve the page of a robot that has nothing to show; its address."""
    lifecycle = Lifecycle()
    robot = Robot(lifecycle)
    lifecycle.waits_for("something to play")
    listening = listening_socket("127.0.0.1", port)
    with (
        serving(make_app(robot, Access("127.0.0.1")), listening),
        every(0.1, robot.tell_waiting),
    ):
        yield address_of(listening)


def test_what_is_wrong_is_told(browser: Browser) -> None:
    with ExitStack() as served:
        address = served.enter_context(idle_page())
        with opened_page(browser, address, script="delete window.WebSocket") as page:
            expect(page.locator("#banner")).to_contain_text("no WebSocket")
        with opened_page(browser, address) as page:
            expect(page.locator("#banner")).to_contain_text("waits for something to play")
            with opened_page(browser, address) as second:
                expect(second.locator("#banner")).to_contain_text("One robot has one tutor")
                page.goto("about:blank")
                expect(second.locator("#banner")).to_contain_text("waits for something to play")
                served.close()
                expect(second.locator("#banner")).to_contain_text("what was shown so far is kept")
                with idle_page(urlsplit(address).port or 0):
                    expect(second.locator("#banner")).to_contain_text("waits for something")


def test_the_page_fits_a_phone(browser: Browser) -> None:
    with idle_page() as address, opened_page(browser, address, size=PHONE) as page:
        widths = page.locator(".panel").evaluate_all("all => all.map(each => each.offsetWidth)")
        assert min(widths) > 0.9 * PHONE["width"], "each panel has the whole width"
        assert fits(page)


class _Run:
    """A real run, and what its learner tells."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.tutored = folder / "shown" / "tutoring"
        self.newest: dict[str, LearnerMetrics] = {}
        self.epochs: dict[tuple[Stage, int], EpochMetrics] = {}
        self._stack, self._folder = stack, folder
        endpoint = free_endpoint()
        self._words = ["--connect", endpoint, "--set", f"run.folder={folder}"]
        for key, value in SETTINGS.items():
            self._words += ["--set", f"{key}={value}"]
        stack.enter_context(listening_hub(endpoint, "--set", "run.name=shown"))
        bus = stack.enter_context(open_bus(HubConfig(endpoint=endpoint), "shown", Role.WATCH, "w"))
        bus.subscribe(bus.keys.metrics(), self._on_metrics, *METRICS)

    def _on_metrics(self, metrics: Metrics) -> None:
        if isinstance(metrics, LearnerMetrics):
            self.newest["learner"] = metrics
            self.epochs |= {(epoch.stage, epoch.epoch): epoch for epoch in metrics.epochs}

    @contextmanager
    def process(self, *words: str) -> Iterator[str]:
        """Run a process of the run; the text of its log at the time when it was up."""
        log = self._folder / f"{'-'.join(words)}.log"
        with vmdnn(*words, *self._words, log=log) as process:
            if "--by-hand" in words:
                eventually(lambda: "(Ctrl-C ends)" in log.read_text(), "its address")
            yield log.read_text()
            assert stop(process) == 0, log.read_text()

    def eventually(self, reached: str, number: int) -> None:
        """Wait until a number that the learner tells is reached."""
        eventually(
            lambda: getattr(self.newest.get("learner"), reached, 0) >= number,
            f"{reached} {number}",
            patience_s=900.0,
        )

    def kept(self) -> list[Episode]:
        store = TutoringStore(self.tutored)
        episodes = [store.load(name) for name in store.ids]
        return [episode for episode in episodes if episode is not None]


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_a_person_teaches_a_run(browser: Browser, tmp_path: Path) -> None:
    """What a person grasps and corrects through the page is kept by the run's learner."""
    with ExitStack() as stack:
        run = _Run(stack, tmp_path)
        stack.enter_context(run.process("learner"))
        said = stack.enter_context(run.process("tutor", "--by-hand", "--port=0"))
        (address,) = re.findall(r"http://\S+", said)
        page = stack.enter_context(opened_page(browser, address))
        person = Person(page)
        person.wait()
        page.select_option("#pace", "0")
        for number in range(len(CASES)):
            print(number, person.text("situation"), person.tutor())
            person.press("k")
            expect(page.locator("#kept")).to_have_text(f"{number + 1} kept", timeout=PATIENCE_MS)
        run.eventually("sequences", len(CASES))
        shown = run.kept()
        assert {(each.kind, each.policy) for each in shown} == {(Kind.TUTORING, "by-hand")}
        assert sum(each.outcome.lenient for each in shown) >= LEAST
        print(sum(each.outcome.precise for each in shown), "are precise")

        with run.process("actor"):  # the tutor's own sequences beside the person's
            run.eventually("sequences", 2 * len(CASES) - 1)
        run.eventually("round", 1)
        losses = [
            run.epochs[Stage.COUPLED, epoch].loss
            for epoch in (1, int(str(SETTINGS["learner.epochs"])))
        ]
        assert losses[1] < losses[0]
        policies = {each.policy for each in run.kept()}
        assert policies == {"by-hand", "tutor"}

        page.locator("#discard").click()
        expect(page.locator("#kind")).to_contain_text("correction of", timeout=PATIENCE_MS)
        person.wait()
        page.keyboard.press("p")
        person.wait_until("document.querySelector('.steps .now').title === 'attend object'")
        page.keyboard.down("r")
        person.wait_until("document.body.dataset.acting === 'false'")
        page.keyboard.up("r")  # and the policy goes on
        expect(page.locator("#state")).to_contain_text("Corrected.", timeout=PATIENCE_MS)
        expect(page.locator("#act")).to_be_disabled()
        person.press("Enter")
        expect(page.locator("#state")).to_contain_text("Played at the task's pace")
        page.keyboard.press("k")  # and nothing more is asked of the person
        run.eventually("policy_version", 2)
        corrections = [each for each in run.kept() if each.kind is Kind.CORRECTION]
        assert [(each.policy, each.policy_version) for each in corrections] == [("by-hand", 1)]
