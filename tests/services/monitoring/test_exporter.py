"""Prometheus can read the metrics of a run, and no message makes ever more time series."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually, listening_hub, vmdnn
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from run_metrics import ACTOR, EVALUATOR, LEARNER, RUN, score, view_of

from proto.bus import open_bus
from proto.config import HubConfig
from proto.keys import Role
from proto.metrics import HubMetrics, RecorderMetrics, SuiteScore
from proto.periodic import every
from services.board import RunView
from services.cli import main
from services.monitoring.exporter import MOST_PROCESSES, RunCollector

MONITORING = Path(__file__).parents[3] / "deploy" / "monitoring"
ALERTS_TEST = Path(__file__).with_name("alerts_test.yml")
RECORDER = RecorderMetrics(
    id="r", time_s=1.0, refused=2, episodes=5, bytes=6000, dropped=1, deleted=0,
    waiting_for="the disk: it is full",
)  # fmt: skip
HUB = HubMetrics(id="hub", time_s=1.0, refused=0, peers=4)
EVERYTHING = view_of(ACTOR, LEARNER, EVALUATOR, RECORDER, HUB)

needs_promtool = pytest.mark.skipif(
    shutil.which("promtool") is None, reason="promtool is not installed (Debian: prometheus)"
)
Samples = dict[tuple[str, tuple[str, ...]], float]


def text_of(view: RunView | None, *, connected: bool = True) -> str:
    registry = CollectorRegistry(auto_describe=False)
    registry.register(RunCollector(RUN, lambda: view, lambda: connected))
    return generate_latest(registry).decode()


def samples(text: str) -> Samples:
    """Values by name and the values of all labels but the run, sorted by label."""
    found: Samples = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = dict(sample.labels)
            assert labels.pop("run") == RUN
            found[sample.name, tuple(value for _, value in sorted(labels.items()))] = sample.value
    return found


def names(text: str) -> set[str]:
    """Names of all metrics, also of those without samples."""
    return set(re.findall(r"^# TYPE (\S+) ", text, flags=re.MULTILINE))


def test_every_process_is_shown() -> None:
    found = samples(text_of(EVERYTHING))
    assert found["vmdnn_hub_connected", ()] == 1
    assert found["vmdnn_processes", ("actor",)] == 1
    assert found["vmdnn_process_up", ("r", "recorder")] == 1
    assert found["vmdnn_actor_steps_per_second", ("a-1",)] == 81.25
    assert found["vmdnn_actor_episodes_total", ("a-1",)] == 17
    assert found["vmdnn_learner_loss", ("l",)] == 0.4321
    assert found["vmdnn_learner_stage", ("l", "coupled")] == 1
    assert found["vmdnn_learner_stage", ("l", "waiting")] == 0
    assert found["vmdnn_recorder_written_bytes_total", ("r",)] == 6000
    assert found["vmdnn_process_messages_refused_total", ("r", "recorder")] == 2
    assert found["vmdnn_process_waiting_for_disk", ("r", "recorder")] == 1
    assert found["vmdnn_process_waiting", ("a-1", "actor")] == 0
    assert found["vmdnn_hub_sessions", ("hub",)] == 4
    assert found["vmdnn_suite_policy_version", ("unlearned",)] == 3
    assert found["vmdnn_suite_success_ratio", ("strict", "unlearned")] == 44 / 52
    low, high = EVALUATOR.policies[-1].strict.wilson95
    assert found["vmdnn_suite_success_low_ratio", ("strict", "unlearned")] == low
    assert found["vmdnn_suite_success_high_ratio", ("strict", "unlearned")] == high


def test_a_version_that_is_still_tried_does_not_hide_the_last_complete_one() -> None:
    suite = SuiteScore("unlearned", "sapien", 52, "", (score(3, 44, 52), score(4, 0, 1)))
    found = samples(text_of(view_of(replace(EVALUATOR, suites=(suite,)))))
    assert found["vmdnn_suite_policy_version", ("unlearned",)] == 3


def test_nothing_is_known_without_a_hub() -> None:
    text = text_of(None, connected=False)
    found = samples(text)
    assert found["vmdnn_hub_connected", ()] == 0
    assert found["vmdnn_processes", ("learner",)] == 0
    assert names(text) == names(text_of(EVERYTHING))


def test_a_vanished_process_is_down_for_a_while() -> None:
    key = (Role.ACTOR, "a-1")
    collector_view = view_of(ACTOR)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(RunCollector(RUN, lambda: collector_view, lambda: True))
    generate_latest(registry)
    collector_view = replace(collector_view, vanished_s={key: time.time()})
    found = samples(generate_latest(registry).decode())
    assert found["vmdnn_process_up", ("a-1", "actor")] == 0
    assert found["vmdnn_processes", ("actor",)] == 0
    assert ("vmdnn_actor_steps_per_second", ("a-1",)) not in found
    collector_view = replace(collector_view, vanished_s={key: time.time() - 700})
    assert ("vmdnn_process_up", ("a-1", "actor")) not in samples(generate_latest(registry).decode())


def test_ids_from_the_bus_are_limited_and_keep_their_place() -> None:
    views = []
    for first in (0, 300):
        many = [replace(ACTOR, id=f"a-{number}") for number in range(first, first + 2000)]
        views.append(view_of(LEARNER, *many))
    current = views[0]
    registry = CollectorRegistry(auto_describe=False)
    registry.register(RunCollector(RUN, lambda: current, lambda: True))
    shown = []
    for current in views:  # noqa: B007
        found = samples(generate_latest(registry).decode())
        shown.append({labels for name, labels in found if name == "vmdnn_process_up"})
        assert len(shown[-1]) == MOST_PROCESSES
        assert ("l", "learner") in shown[-1]
        assert found["vmdnn_processes", ("actor",)] == 2000
        assert found["vmdnn_processes_not_shown", ()] == 2001 - MOST_PROCESSES
    assert len(shown[0] & shown[1]) >= MOST_PROCESSES - 300


def test_dashboard_and_alerts_name_only_metrics_that_there_are() -> None:
    text = text_of(EVERYTHING)
    there = names(text)
    dashboard = json.loads((MONITORING / "grafana-dashboard.json").read_text())
    expressions = [
        target["expr"] for panel in dashboard["panels"] for target in panel["targets"]
    ] + [each["query"] for each in dashboard["templating"]["list"]]
    expressions.append((MONITORING / "alerts.yml").read_text())
    used = {name for each in expressions for name in re.findall(r"\bvmdnn_\w+", each)}
    assert len(used) > 20
    assert used - there == set()
    assert all(name.startswith("vmdnn_") for name in there)


def test_every_metric_is_documented() -> None:
    document = (MONITORING.parents[1] / "docs" / "monitoring.md").read_text()
    documented = set(re.findall(r"^\| `(vmdnn_\w+)`", document, flags=re.MULTILINE))
    assert documented == names(text_of(EVERYTHING))
    alerts = set(re.findall(r"alert: (\w+)", (MONITORING / "alerts.yml").read_text()))
    assert set(re.findall(r"^\| `(Vmdnn\w+)`", document, flags=re.MULTILINE)) == alerts


@needs_promtool
def test_promtool_accepts_metrics_rules_and_configuration() -> None:
    for words, stdin in (
        (["check", "metrics"], text_of(EVERYTHING)),
        (["check", "rules", str(MONITORING / "alerts.yml")], ""),
        (["check", "config", str(MONITORING / "prometheus.yml")], ""),
        (["test", "rules", str(ALERTS_TEST)], ""),
    ):
        ended = subprocess.run(
            ["promtool", *words], input=stdin, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, ended.stdout + ended.stderr
        assert not stdin or ended.stdout + ended.stderr == ""  # a remark on a metric


def test_the_command_serves_a_run_also_before_there_is_a_hub() -> None:
    endpoint, address = free_endpoint(), free_endpoint()
    port = address.rpartition(":")[2]

    def fetch() -> Samples:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
            return samples(answer.read().decode())

    def serves() -> bool:
        try:
            return fetch()["vmdnn_hub_connected", ()] == 0
        except OSError:
            return False

    words = ("--connect", endpoint, "--set", f"run.name={RUN}")
    with vmdnn("metrics", "--prometheus", port, *words):
        eventually(serves, "the exporter answers")
        with listening_hub(endpoint, "--set", f"run.name={RUN}"):
            hub = HubConfig(endpoint=endpoint)
            with open_bus(hub, RUN, Role.ACTOR, "a-1") as bus:
                bus.announce()
                key = bus.keys.metrics(Role.ACTOR, "a-1")
                with every(0.1, lambda: bus.publish(key, ACTOR)):
                    eventually(
                        lambda: fetch().get(("vmdnn_actor_episodes_total", ("a-1",))) == 17,
                        "the actor's metrics are there",
                    )
            assert fetch()["vmdnn_hub_connected", ()] == 1
        eventually(lambda: fetch()["vmdnn_hub_connected", ()] == 0, "the hub is away")


def test_a_port_that_cannot_be_used_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["metrics", "--prometheus", "everywhere"])
    assert "'everywhere' is no port" in capsys.readouterr().err
    assert main(["metrics", "--prometheus", "192.0.2.1:9464"]) == 2
    assert "nothing can listen at 192.0.2.1:9464" in capsys.readouterr().err
