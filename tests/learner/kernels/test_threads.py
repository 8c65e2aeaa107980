"""If the system cannot start threads, the kernels compute in the calling thread."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, resource, sys, threading
import torch
from learner.kernels import maps
from learner.kernels.library import peak_flops
from learner.network.vmdnn import VMDNN
from learner.training.divergence import add_gradients
from learner.training.sequences import Minibatch, Sequences
from proto.config import NetworkConfig

network = VMDNN(NetworkConfig())
network.initialize(torch.Generator().manual_seed(1), initial_range=0.1, pfc_input_range=0.1)
seen = torch.randn(40, 9, network.pfc.input.shape[1], generator=torch.Generator().manual_seed(2))
codes = torch.full((40, 9, *network.outputs.shape), 0.1)
minibatch = Minibatch.of_all(Sequences.stacked(list(seen), list(codes)))
images = torch.rand(2, 20, 1, 20, 30, generator=torch.Generator().manual_seed(3))
kernel, bias = torch.ones(2, 1, 5, 5, requires_grad=True), torch.zeros(2)


def compute():
    network.zero_grad()
    kernel.grad = None
    loss = add_gradients(network, minibatch)
    activity = maps.maps(images, kernel, bias, 2, 3.0)
    activity.sum().backward()
    gradients = [each.grad for each in network.core_parameters()]
    return [torch.tensor(loss), activity.detach(), kernel.grad, *gradients]


torch.set_num_threads(1)
expected = compute()
if os.geteuid() == 0:
    os.setgid(65534)
    os.setuid(65534)  # limits do not apply to root
resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
try:
    threading.Thread(target=int).start()
except RuntimeError:
    pass
else:
    sys.exit(77)
torch.set_num_threads(4)
assert all(torch.equal(a, b) for a, b in zip(compute(), expected, strict=True))
assert peak_flops(4) > 0
print("computed")
"""


def test_without_threads_the_calling_thread_computes_the_same() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    if done.returncode == 77:
        pytest.skip("a limit on processes does not keep this system from starting threads")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "computed\n"
