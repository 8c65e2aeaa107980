from __future__ import annotations

import json

import pytest
import torch

from learner.bench import bptt as bench
from learner.kernels.build import NotCompiledError, find_or_compile
from learner.network.vmdnn import VMDNN
from proto.config import NetworkConfig
from services.cli import main


@pytest.fixture
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """No time for medians that mean anything; `torch.compile` is given up at once."""
    try:
        find_or_compile()
    except NotCompiledError as error:
        pytest.skip(f"the C++ kernels are not compiled here: {error}")
    monkeypatch.setattr(bench, "MEASURING_S", 0.0)
    monkeypatch.setattr(bench, "TURN_S", 0.0)
    monkeypatch.setattr(bench, "COMPILING_S", 0.0)


@pytest.mark.usefixtures("_short")
def test_all_implementations_are_measured(capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    sizes = ["--batch", "3", "--steps", "5", "--threads", "1"]
    try:
        assert main(["bench", "bptt", "--json", *sizes]) == 0
    finally:
        torch.set_num_threads(threads)
    speed = json.loads(capsys.readouterr().out)
    assert (speed["batch"], speed["steps"], speed["threads"]) == (3, 5, 1)
    assert speed["ratio"] == pytest.approx(speed["eager_ms"] / speed["fused_ms"], rel=1e-2)
    assert speed["fraction"] == pytest.approx(speed["gflops"] / speed["peak_gflops"], abs=1e-3)
    assert set(speed["peers"]) == {"torch.compile", "autograd by hand", "nn.LSTM", "MTRNN cell"}
    assert speed["peers"]["torch.compile"] is None
    assert speed["vision"]["ratio"] > 0


def test_operations_of_the_papers_network() -> None:
    # 6,720 weights see V_S, whose gradient nobody wants; 13,500 are inside or lead to the outputs
    assert bench.operations(VMDNN(NetworkConfig())) == 2 * (2 * 6720 + 3 * 13500)


def test_steps_of_the_benchmark_have_the_networks_inputs() -> None:
    network = VMDNN(NetworkConfig())
    network.initialize(torch.Generator().manual_seed(1), initial_range=0.1, pfc_input_range=0.1)
    images = torch.rand(2, 4, 48, 64) * 2 - 1
    torch.testing.assert_close(bench._see_step_by_step(network, images), network.see(images))
