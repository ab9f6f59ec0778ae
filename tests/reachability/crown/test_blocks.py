"""Memory of the backward pass: few cells at once, few steps ready at once, and the tube is the same."""

import json
import subprocess
import sys

import pytest
import torch

from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.crown import crown as crown_module
from sagemp_cli.reachability.crown import steps as steps_module
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.sets.partition import partition

from ..propagator_cases import DISTURBANCE, START, line, unicycle_loop


def loops():
    loop = unicycle_loop(line(0.3)[:6])
    both = torch.stack([line(0.3)[:6], line(0.1)[:6]])[:, None]
    batched = ClosedLoop(loop.dynamics, loop.tracker, both)
    return {"one reference": loop, "two references": batched, "recorded": recorded(batched, START, DISTURBANCE)}


@pytest.mark.parametrize("name", ["one reference", "two references", "recorded"])
@pytest.mark.parametrize("propagator", [Crown(), Crown(rows=30), Best()])
def test_a_few_cells_and_steps_at_a_time_give_the_same_tube(propagator, name, monkeypatch):
    loop, cells = loops()[name], partition(START, [2, 1, 1, 1])
    whole = propagator.propagate(loop, cells, DISTURBANCE)
    calls, ready = [], steps_module.ready
    monkeypatch.setattr(steps_module, "ready", lambda some: calls.append(len(some)) or ready(some))
    monkeypatch.setattr(crown_module, "AT_ONCE", 1)
    monkeypatch.setattr(steps_module, "BLOCK", 1)
    monkeypatch.setattr(steps_module, "KEPT", 0)
    parts = propagator.propagate(loop, cells, DISTURBANCE)
    assert set(calls) == {1} and len(calls) > len(cells.lower) * loop.horizon
    assert parts.lower.shape == whole.lower.shape
    slack = 1e-7 * float(whole.width.max())
    torch.testing.assert_close(parts.lower, whole.lower, rtol=0, atol=slack)
    torch.testing.assert_close(parts.upper, whole.upper, rtol=0, atol=slack)


MEASURE = """
import json
import sys
import torch
torch.set_num_threads(1)
from sagemp_cli.reachability.any_loop import reach
from sagemp_cli.reachability.crown import crown, steps
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import partition

crown.AT_ONCE = 2**25
steps.KEPT = steps.BLOCK = 2**23
torch.manual_seed(0)
net = torch.nn.Sequential(
    torch.nn.Linear(2, 96), torch.nn.Tanh(), torch.nn.Linear(96, 96), torch.nn.Tanh(), torch.nn.Linear(96, 1)
).double()

class Loop:
    horizon, state_dim = 6, 2
    def step(self, k, x, w):
        u = net(x)
        return torch.cat([x[..., :1] + 0.1 * x[..., 1:], 0.9 * x[..., 1:] - 0.1 * x[..., :1] + 0.1 * u + w], dim=-1)

def peak():
    lines = open("/proc/self/status").read().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

start = partition(Box.around([0.0, 0.0], [0.3, 0.3]), [4, 3])
before = peak()
tube = crown.Crown().propagate(Loop(), start, Box.around([0.0], [0.01]))
print(json.dumps({"grew": (peak() - before) / 2**20, "bounded": bool(tube.bounded.all())}))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the peak is read from /proc")
def test_many_cells_of_a_wide_network_take_the_memory_of_a_few():
    done = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, timeout=120, check=True)
    found = json.loads(done.stdout)
    assert found["bounded"] and found["grew"] < 30, found
