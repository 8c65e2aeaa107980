"""The page in a real browser: it loads, its numbers move, and nothing is loaded from elsewhere."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from pages import PHONE, WIDE, fits, needs_chromium, opened, started_browser
from playwright.sync_api import Browser, Page, expect
from processes import eventually, stop, vmdnn
from run_metrics import ACTOR
from staged_run import StagedRun, Told, dashboard

from actors.tasks.registry import make_task
from proto.config import Config
from proto.episode import NO_FAILURE, Episode, Kind
from proto.periodic import every
from proto.recordings.episodes import write_episode
from services.playing.workers import Job, play_all

PATIENCE_MS = 60_000
JPEG = re.compile("^data:image/jpeg;base64,.{100}")

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with started_browser() as started:
        yield started


def brightness(page: Page) -> float:
    colour = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
    red, green, blue = (int(part) for part in colour[4:-1].split(","))
    return (red + green + blue) / 3


def test_the_page_shows_what_happens(
    browser: Browser, staged: StagedRun, episodes: list[Episode]
) -> None:
    told = Told(staged, episodes[1])
    with (
        dashboard(staged.config, control=True) as address,
        opened(browser, address, PATIENCE_MS) as page,
        every(0.3, told.once),
    ):
        expect(page.locator("#run-name")).to_have_text("staged")
        expect(page.locator("#success circle")).to_have_count(2, timeout=PATIENCE_MS)
        expect(page.locator("#success-readout")).to_contain_text("strict 85 % (72 to 92) of 52")
        expect(page.locator("#success")).to_contain_text("lookup 79")
        expect(page.locator("#loss polyline")).to_have_count(1, timeout=PATIENCE_MS)
        phase = page.locator(".actor .phase")
        expect(phase).to_contain_text("observe", timeout=PATIENCE_MS)
        before = phase.text_content()
        expect(phase).not_to_have_text(before or "")
        figures = page.locator("#figures").text_content() or ""
        expect(page.locator("#figures")).not_to_have_text(figures)
        page.get_by_role("button", name="outside view").click()
        expect(page.locator(".outside")).to_have_attribute("src", JPEG, timeout=PATIENCE_MS)

        expect(page.locator("#rollouts tbody tr")).to_have_count(2)
        page.select_option("#filter-outcome", "failed")
        page.locator("#rollouts tbody tr").click()
        expect(page.locator("#player-title")).to_have_text("trial of policy 3: not lifted")
        expect(page.locator("#phases span")).to_have_count(8)
        expect(page.locator("#step")).not_to_have_text("1/40")
        page.locator("#scrub").fill("20")
        expect(page.locator("#step")).to_have_text("21/40")
        page.get_by_role("button", name="close").click()

        staged.tell(replace(ACTOR, waiting_for="<b>bold</b>"))
        page.locator("[data-order='learner pause']").click()
        expect(page.locator("#told")).to_have_text("learner l: done")
        assert fits(page)
    assert staged.commands


@pytest.mark.slow
def test_the_page_fits_a_phone_and_the_night(
    browser: Browser, staged: StagedRun, episodes: list[Episode]
) -> None:
    told = Told(staged, episodes[1])
    hostile = "<img src=x onerror=alert(1)>"
    with (
        dashboard(staged.config) as address,
        opened(browser, address, PATIENCE_MS, size=PHONE, scheme="dark") as page,
        every(0.5, told.once),
        every(0.5, lambda: staged.tell(replace(ACTOR, waiting_for=hostile, backend=hostile))),
    ):
        expect(page.locator(".process", has_text=hostile)).to_be_visible(timeout=PATIENCE_MS)
        expect(page.locator(".actor .phase")).to_contain_text("observe", timeout=PATIENCE_MS)
        assert page.locator("img[src='x']").count() == 0
        assert brightness(page) < 60
        assert fits(page)
        page.locator("#rollouts tbody tr").first.click()
        expect(page.locator("#step")).to_contain_text("/40")
        assert fits(page)
        page.get_by_role("button", name="close").click()
        staged.leave("a-1")
        expect(page.locator(".actor.gone")).to_be_visible(timeout=PATIENCE_MS)
        expect(page.locator(".actor")).to_have_count(0, timeout=PATIENCE_MS)


def test_a_lost_connection_is_told_and_made_again(browser: Browser, staged: StagedRun) -> None:
    context = browser.new_context(viewport=WIDE)  # type: ignore[arg-type]
    page = context.new_page()
    with dashboard(staged.config) as address:
        page.goto(address)
        expect(page.locator("#rollouts tbody tr")).to_have_count(2, timeout=PATIENCE_MS)
        expect(page.locator("#banner")).to_be_hidden()
    expect(page.locator("#banner")).to_contain_text("is lost", timeout=PATIENCE_MS)
    with dashboard(staged.config, port=urlsplit(address).port or 0):
        expect(page.locator("#banner")).to_be_hidden(timeout=PATIENCE_MS)
        expect(page.locator("#rollouts tbody tr")).to_have_count(2, timeout=PATIENCE_MS)
    context.close()


def test_a_browser_without_websocket_is_told(browser: Browser, staged: StagedRun) -> None:
    with (
        dashboard(staged.config) as address,
        opened(browser, address, PATIENCE_MS, script="delete window.WebSocket") as page,
    ):
        expect(page.locator("#banner")).to_contain_text("no WebSocket")


@pytest.fixture(scope="module")
def failure(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of a real failure: the object lies across, and the policy does not know."""
    config = Config()
    situation = {**make_task(config.task).tutored()[0], "object_yaw_deg": 44.0}
    file = tmp_path_factory.mktemp("failure") / "failure.mcap"
    job = Job(situation, 1, Kind.PRACTICE, record_to=file)
    ((_, episode),) = play_all(config, "yaw-blind", [job], workers=1)
    assert episode.outcome.reason != NO_FAILURE
    names = ("images", "actions", "targets", "joints_deg", "phases", "body_poses")
    kept = {name: getattr(episode, name)[:20] for name in names}
    view = episode.view and replace(episode.view, focal_px=episode.view.focal_px[:20])
    write_episode(file, replace(episode, view=view, **kept))
    return file


@pytest.mark.slow  # renders with SAPIEN
def test_the_video_of_a_failure_plays(browser: Browser, staged: StagedRun, failure: Path) -> None:
    rollouts = staged.config.run_folder / "rollouts"
    for recording in rollouts.iterdir():
        recording.unlink()
    shutil.copy(failure, rollouts)
    with dashboard(staged.config) as address, opened(browser, address, PATIENCE_MS) as page:
        page.select_option("#filter-outcome", "failed")
        page.locator("#rollouts tbody tr").click()
        video = page.locator("#video")
        expect(video).to_be_visible(timeout=4 * PATIENCE_MS)
        assert video.evaluate("video => [video.videoWidth, video.videoHeight]") == [1280, 588]
        page.locator("#scrub").fill("0")
        page.locator("#play").click()
        expect(page.locator("#step")).to_have_text("20/20", timeout=PATIENCE_MS)
        assert video.evaluate("video => video.currentTime") > 1.5
        page.locator("#scrub").fill("4")
        expect(page.locator("#step")).to_have_text("5/20")
        assert video.evaluate("video => video.currentTime") == pytest.approx(0.45, abs=0.01)


@pytest.mark.slow  # renders with SAPIEN
def test_replay_shows_one_recording(browser: Browser, tmp_path: Path, failure: Path) -> None:
    log = tmp_path / "replay.log"
    with vmdnn("replay", failure, "--open", "--set", "dashboard.port=0", log=log) as process:
        eventually(lambda: "(Ctrl-C ends)" in log.read_text(), "its address")
        (address,) = re.findall(r"http://\S+", log.read_text())
        with opened(browser, address, PATIENCE_MS) as page:
            expect(page.locator("#player-title")).to_contain_text("practice of yaw-blind")
            expect(page.locator("#live")).to_be_hidden()
            expect(page.locator("#video")).to_be_visible(timeout=4 * PATIENCE_MS)
        assert stop(process) == 0
