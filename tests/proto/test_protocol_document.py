"""docs/protocol.md agrees with the code."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import listening_hub

from proto import messages
from proto.codec import schema_of
from proto.keys import Keys, Role
from proto.messages import Command
from proto.metrics import METRICS, Metrics

TEXT = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
MESSAGES = (
    messages.PolicyVersion,
    messages.Sequence,
    messages.Rollout,
    messages.EpisodeOutcome,
    messages.EpisodeFailed,
    messages.Receipt,
    messages.TutoringRequest,
    messages.TutoringCase,
    messages.Correction,
    messages.Verdict,
    messages.TrialRequest,
    messages.Trial,
    messages.Live,
    messages.Pictures,
    messages.Control,
    messages.ControlReply,
    messages.Settings,
    messages.ConfigurationRequest,
    messages.RunConfiguration,
    messages.Identity,
    messages.Claim,
    *METRICS,
)


def section(title: str) -> str:
    """Text from a heading to the next."""
    return re.split(r"^#+ ", TEXT.partition(f"# {title}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]


def first_column(text: str) -> set[str]:
    return set(re.findall(r"^\| `([^`]+)` \|", text, flags=re.MULTILINE))


def test_the_example_prints_the_metrics_with_zenoh_alone(tmp_path: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    assert len(example.splitlines()) <= 15
    script = tmp_path / "listen.py"
    script.write_text(example)
    endpoint = free_endpoint()
    command = [sys.executable, "-I", script, endpoint, "documented"]
    with (
        listening_hub(endpoint, "--set", "run.name=documented"),
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process,
    ):
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("hub hub {'role': 'hub', 'id': 'hub', 'time_s': ")
            assert "'peers': 1" in line
        finally:
            process.kill()


@pytest.mark.parametrize("made", METRICS)
def test_every_metric_is_documented(made: type[Metrics]) -> None:
    role = schema_of(made).name.rpartition(".")[2]
    common = {field.name for field in dataclasses.fields(Metrics)}
    assert first_column(section("Metrics")) == common
    own = {field.name for field in dataclasses.fields(made)} - common
    assert first_column(section(role)) == own


def test_every_encoding_is_documented() -> None:
    documented = set(re.findall(r"`(application/[a-z]+;vmdnn\.[a-z_.]+\.\d+)`", TEXT))
    assert documented == {schema_of(made).encoding for made in MESSAGES}


def test_every_key_is_documented() -> None:
    keys = Keys("<run>")
    assert first_column(section("Keys")) == {
        keys.policy,
        keys.sequence("<actor>"),
        keys.rollout("<actor>"),
        keys.outcome("<actor>"),
        keys.failure("<actor>"),
        keys.receipt("<role>", "<actor>"),
        keys.verdict,
        keys.settings,
        keys.configuration,
        keys.identity("<actor>"),
        keys.claim("<role>"),
        keys.request_tutoring,
        keys.request_trial,
        keys.live("<actor>"),
        keys.pictures("<actor>"),
        keys.metrics("<role>", "<id>"),
        keys.alive("<role>", "<id>"),
        keys.control("<role>"),
    }


def test_every_role_and_command_is_documented() -> None:
    assert all(f"`{role}`" in section("Keys") for role in Role)
    assert first_column(section("Control")) == {command.value for command in Command}
