"""run_local plays a whole run, refuses bad input, stops cleanly, and continues a run."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from ports import free_endpoint
from processes import eventually
from run_metrics import EVALUATOR, LEARNER, score, view_of

from deploy.processes import programs
from deploy.run_local import (
    DEFAULT_CONFIG,
    actors_of,
    check_actors,
    dashboard_place,
    dashboard_program,
    main,
    summary,
)
from proto.codec import Wire
from proto.config import Config, LearnerConfig, load_config
from proto.outbox import Outbox, messages_of_run
from proto.run_locks import owned_run

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "deploy" / "config" / "smoke.yaml"
PATIENCE_S = 600.0
"""For what takes a minute and a half, or a few seconds, on a machine with nothing else to do."""

pytestmark = pytest.mark.timeout(4 * PATIENCE_S)


def processes_that_name(text: str) -> list[str]:
    found = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = process.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has just ended
            continue
        if text in command:
            found.append(command)
    return found


@contextmanager
def started(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The smoke run in a folder, in a process group of its own as a terminal would give it."""
    command = (
        str(ROOT / "deploy" / "run_local.sh"), "--config", str(SMOKE), "--actors", "1",
        "--set", f"run.folder={folder}", "--set", f"hub.endpoint={free_endpoint()}",
        "--set", "dashboard.enabled=false", *arguments,
    )  # fmt: skip
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_stopped_run_is_continued_to_its_end(tmp_path: Path) -> None:
    run = tmp_path / "smoke"
    with started(tmp_path, "--set", "dashboard.enabled=true") as process:
        eventually(lambda: any(run.glob("tutoring/*.mcap")), "a sequence is kept", PATIENCE_S)
        os.killpg(process.pid, signal.SIGINT)  # Ctrl-C
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
        assert "starting run smoke with 1 actor" in output
        assert "watch it at http://127.0.0.1:" in output
        assert not processes_that_name(str(tmp_path))
    kept = {file.name: file.stat().st_mtime_ns for file in run.glob("tutoring/*.mcap")}

    with started(tmp_path) as process:
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
        assert "continuing run smoke" in output
        assert "4 policy versions" in output
        assert "policy 4, 10 of 10 trials counted" in output
        assert not processes_that_name(str(tmp_path))
    assert not messages_of_run(run), "the end of the run waits for what was played"

    sequences = {file.name: file.stat().st_mtime_ns for file in run.glob("tutoring/*.mcap")}
    assert kept.items() <= sequences.items(), "what was taught is not taught again"
    assert len(sequences) == 3 + 2, "what was tutored and what was corrected"
    assert len(list(run.glob("policies/*.safetensors"))) == 4
    assert len(list(run.glob("rollouts/*.mcap"))) >= 10
    config = load_config(run / "config.yaml")
    assert config.run.name == "smoke"

    # With another network the run cannot be continued, and its files are not changed.
    with started(tmp_path, "--set", "network.pfc.units=7") as process:
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 2, output
        assert "learner cannot work and is not started again" in errors
        assert not processes_that_name(str(tmp_path))
    assert load_config(run / "config.yaml") == config
    assert len(list(run.glob("policies/*.safetensors"))) == 4


def test_a_process_with_bad_input_ends_the_run_with_its_message(tmp_path: Path) -> None:
    with started(tmp_path, "--backend", "nosuchsimulator") as process:
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert "there is no 'nosuchsimulator'" in errors
    assert not processes_that_name(str(tmp_path))


def test_a_link_to_the_script_works(tmp_path: Path) -> None:
    link = tmp_path / "play"
    link.symlink_to(ROOT / "deploy" / "run_local.sh")
    ended = subprocess.run(
        (link, "--set", "learner.ratee=1"),
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=PATIENCE_S,
        check=False,
    )
    assert ended.returncode == 2
    assert "learner.ratee" in ended.stderr


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("learner.ratee=1", "learner.ratee"),
        ("learner.rate=fast", "learner.rate"),
        ("hub.endpoint=tcp/192.0.2.1:7447", "can be reached from other machines"),
        ("dashboard.host=192.0.2.1", "the dashboard cannot listen at 192.0.2.1"),
        ("dashboard.port=65536", "dashboard.port"),
    ],
)
def test_bad_input_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], setting: str, said: str
) -> None:
    settings = [f"run.folder={tmp_path}", f"hub.endpoint={free_endpoint()}", setting]
    assert main([word for given in settings for word in ("--set", given)]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_missing_config_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "none.yaml"
    assert main(["--config", str(missing), "--set", f"run.folder={tmp_path / 'runs'}"]) == 2
    assert str(missing) in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    settings = [f"run.folder={tmp_path / 'file'}", f"hub.endpoint={free_endpoint()}"]
    assert main([word for setting in settings for word in ("--set", setting)]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_port_in_use_starts_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        endpoint = f"hub.endpoint=tcp/127.0.0.1:{port}"
        assert main(["--set", f"run.folder={tmp_path}", "--set", endpoint]) == 2
    error = capsys.readouterr().err
    assert f"tcp/127.0.0.1:{port} is in use" in error
    assert "--set hub.endpoint=" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "config", sorted(DEFAULT_CONFIG.parent.glob("*.yaml")), ids=lambda p: p.stem
)
def test_every_config_is_valid_and_can_be_done(config: Path) -> None:
    assert load_config(config).done.ever


def test_threads_and_actors_follow_the_config() -> None:
    config = Config(learner=LearnerConfig(threads=3))
    actors = {"sapien": 5}
    by_name = {program.name: program for program in programs(config, Path("config.yaml"), actors)}
    assert next(iter(by_name)) == "hub", "all others need it"
    assert by_name["learner"].threads == 3
    assert by_name["actor"].threads == 1
    assert by_name["actor"].processes == 5
    assert "--backend" not in by_name["actor"].command
    none = programs(config, Path("config.yaml"), {"sapien": 0})
    assert "actor" not in {program.name for program in none}


def test_the_page_has_a_free_port_and_can_be_switched_off() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        place = dashboard_place(load_config(None, [f"dashboard.port={port}"]))
        assert place is not None
        assert place[1] not in (0, port)
        page = dashboard_program(Path("config.yaml"), *place)
        assert page.command[-4:] == ("--host", "127.0.0.1", "--port", str(place[1]))
    assert dashboard_place(load_config(None, ["dashboard.enabled=false"])) is None


def test_actors_of_several_simulators_are_programs_of_their_own() -> None:
    actors = {"sapien": 2, "my.own:Still": 1, "elsewhere": 0}
    started = {program.name: program for program in programs(Config(), Path("c.yaml"), actors)}
    assert [name for name in started if name.startswith("actor")] == [
        *("actor-sapien", "actor-my-own-Still"),
    ]
    assert started["actor-sapien"].processes == 2
    assert "--backend" not in started["actor-sapien"].command
    assert started["actor-my-own-Still"].command[-2:] == ("--backend", "my.own:Still")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["--set", "evaluator.suites=[unlearned, {name: m, backend: other}]"],
            "no actor has the simulator other of the suite m; start one with --actors"
            " sapien=1,other=1, or write 0",
        ),
        (
            ["--set", "tutor.backends=[other]", "--actors", "2"],
            "no actor has the simulator other of tutor.backends",
        ),
        (["--actors", "other=2"], "no actor has the simulator sapien of the suite unlearned"),
        (["--set", "evaluator.suites=[unlearned, {name: a, disturbances: {pusht: 1}}]"], "pusht"),
        (["--set", "evaluator.suites=[beyond, beyond]"], "two suites"),
    ],
)
def test_a_suite_that_no_actor_can_play_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["--set", f"run.folder={tmp_path}", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["sapien", "sapien=x", "sapien=1,sapien=2", "=3", "a=1,2", "-1"])
def test_wrong_numbers_of_actors_are_refused(text: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main([f"--actors={text}"])
    assert ended.value.code == 2


def test_actors_from_elsewhere_are_believed() -> None:
    config = load_config(None, ["evaluator.suites=[unlearned, {name: m, backend: other}]"])
    check_actors(actors_of({"sapien": 1, "other": 0}, config), config)
    check_actors(actors_of(0, config), config)
    assert actors_of(3, config) == {"sapien": 3}


def test_the_summary_says_what_to_expect_and_what_is_missing() -> None:
    suite = replace(EVALUATOR.suites[0], trials=10, policies=(score(1, 0, 2), score(4, 0, 10)))
    view = view_of(replace(LEARNER, policy_version=4), replace(EVALUATOR, suites=(suite,)))
    told = summary(view, load_config(SMOKE), 301.0)
    assert "4 policy versions in 5 min 1 s" in told
    assert "3 earlier versions have fewer than 10 trials" in told
    assert "  vmdnn evaluate --run runs/smoke --policy-version all\n" in told
    assert "no success is expected here: 3 tutored cases" in told
    assert "  vmdnn evaluate --policy pretrained:experiment1" in told
    prose = [line for line in told.splitlines() if not line.startswith(" ")]
    assert max(map(len, prose)) < 80
    whole = summary(view, load_config(DEFAULT_CONFIG), 301.0)
    assert "expected" not in whole


def test_a_run_that_is_being_played_is_not_touched_by_a_second_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    settings = [f"run.folder={tmp_path}", "run.name=mine", f"hub.endpoint={free_endpoint()}"]
    words = [word for setting in settings for word in ("--set", setting)]
    with owned_run(tmp_path / "mine"):
        (tmp_path / "mine" / "logs").mkdir()
        (tmp_path / "mine" / "logs" / "config.yaml").write_text("of the first start")
        before = files()
        assert main(words) == 2
        assert "is being played already" in capsys.readouterr().err
        assert files() == before


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("done.policy_versions=99",), "done.policy_versions: 99 can never be reached"),
        (("learner.epochs=10",), "gives 4 policy versions"),
        ((f"run.name={'n' * 300}",), "at most 100 characters"),
    ],
)
def test_what_can_never_work_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], settings: tuple[str, ...], said: str
) -> None:
    words = [word for setting in settings for word in ("--set", setting)]
    assert main(["--set", f"run.folder={tmp_path}", *words]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_run_goes_on_when_the_reader_of_its_output_ends() -> None:
    script = (
        "import sys\n"
        "from deploy.run_local import RunConsole\n"
        "sys.stdin.readline()\n"
        "console = RunConsole()\n"
        "for _ in range(3): console.print('nobody reads this')\n"
        "print('went on', file=sys.stderr)\n"
    )
    with subprocess.Popen(
        (sys.executable, "-c", script),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.stdin.write("the reader has ended\n")
        process.stdin.close()
        assert process.stderr.read() == "went on\n"


def pid_of(role: str, folder: Path) -> int:
    """Process id of a process of the smoke run in a folder; 0 if there is none."""
    words = [role, "--config", str(folder / "smoke" / "logs" / "config.yaml")]
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if process.read_bytes().decode(errors="replace").split("\0")[2:5] == words:
                return int(process.parent.name)
    return 0


def wait_for_another(role: str, folder: Path, than: int) -> None:
    eventually(lambda: pid_of(role, folder) not in (0, than), f"another {role} runs", 180)


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0])
def test_ctrl_c_at_any_moment_ends_everything(tmp_path: Path, after_s: float) -> None:
    """Early ones meet the set-up or the imports, later ones processes that start."""
    with started(tmp_path) as process:
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        os.killpg(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in (0, 130, -signal.SIGINT), errors
    assert "Traceback" not in output + errors
    assert "is there a network" not in errors
    assert not processes_that_name(str(tmp_path))


@pytest.mark.slow
def test_a_run_survives_a_frozen_hub_and_processes_that_end(tmp_path: Path) -> None:
    run = tmp_path / "smoke"
    outbox = Outbox(run / "outbox" / "gone" / "outcomes", lambda *_: None)
    outbox.add("1", "vmdnn/smoke/outcome/gone", Wire("of-another-version", b""))
    with started(tmp_path) as process:
        eventually(lambda: bool(pid_of("actor", tmp_path)), "an actor runs", 180)
        eventually(lambda: any(run.glob("tutoring/*.mcap")), "a sequence is kept", PATIENCE_S)
        hub, actor = pid_of("hub", tmp_path), pid_of("actor", tmp_path)
        os.kill(hub, signal.SIGSTOP)
        os.kill(actor, signal.SIGKILL)
        log = run / "logs" / "actor.log"
        eventually(lambda: "no hub answers" in log.read_text(), "the next actor waits", 180)
        os.kill(hub, signal.SIGCONT)
        for role in ("evaluator", "recorder", "learner"):
            before = pid_of(role, tmp_path)
            os.kill(before, signal.SIGTERM)
            wait_for_another(role, tmp_path, before)
        output, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, errors
    assert "actor was killed and is started again" in output
    assert "evaluator ended (0) and is started again" in output
    assert "policy 4, 10 of 10 trials counted" in output
    assert "done; waiting for the receipts of" in output
    assert "without a receipt stay one message in" in output
    assert len(messages_of_run(run)) == 1, "nothing else stays"
    assert not processes_that_name(str(tmp_path))
    counted = (run / "evaluation" / "trials.jsonl").read_text().splitlines()
    recorded = {path.stem.rpartition("_")[2] for path in (run / "rollouts").glob("*.mcap")}
    assert {json.loads(line)["episode"] for line in counted} <= recorded
