"""Steps told again on the tape of the first: one program where they are one, and never one where they are not."""

import threading

import pytest
import torch

from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.program import loops
from sagemp_cli.reachability.program.loops import recorded_steps
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, line, unicycle_loop

K = 6
TABLE = torch.linspace(-1.0, 1.0, 2 * K, dtype=torch.float64).reshape(K, 2)
ONE_ROW = torch.zeros(K, 2, dtype=torch.float64).index_fill_(0, torch.tensor([4]), 0.5)
MATRICES = torch.linspace(0.1, 0.9, 4 * K, dtype=torch.float64).reshape(K, 2, 2)
BUFFER = torch.zeros(2, dtype=torch.float64)


def swallowed(k, x, w):
    y = 0.9 * x
    try:
        y = y + (w if k < 3 else torch.sin(w))
    except Exception:  # as strangers do
        y = y + 1.0
    return y


def swallowed_at_the_end(k, x, w):
    y = 0.9 * x + w
    try:
        return y if k < 3 else y + torch.sin(x)
    except Exception:
        return y


def written(k, x, w):
    y = x.clone()
    y[k % 2] = w[0] + TABLE[k, 1]
    return y


def through_a_view(k, x, w):
    y = 1.0 * x
    part = y[:1] if k != 3 else y[:1].clone()
    part += 0.5
    return y + w


def in_a_buffer(k, x, w):
    BUFFER[:] = TABLE[k]
    y = x + BUFFER
    BUFFER[:] = 0.0
    return y - BUFFER + w


def view_of_a_constant(k, x, w):
    a, b = torch.broadcast_tensors(x, TABLE[k])
    return a * 0.5 + b + w


def list_or_tuple(k, x, w):
    rows = x[None].expand(2, 2)
    return torch.stack([rows[(0, 1) if k == 3 else [0, 1]].sum(), x[1]]) + w


def iterated(k, x, w):
    a, b = x
    return torch.stack([a + TABLE[k, 0], 0.9 * b]) + w


ONE = {
    "nothing": lambda k, x, w: 0.9 * torch.sin(x) + w,
    "a number": lambda k, x, w: 0.9 * x + 0.1 * k + w,
    "a row": lambda k, x, w: torch.tanh(TABLE[k] - x) + w,
    "a row, joined and multiplied": lambda k, x, w: 0.5 * torch.cat([TABLE[k] + 0 * x, x], dim=-1)[1:3] + w,
    "a factor that depends on the state": lambda k, x, w: (TABLE[k] + x) * x + w,
    "one step": lambda k, x, w: torch.relu(x + ONE_ROW[k]) + w,
    "a buffer": in_a_buffer,
    "iterated": iterated,
    "entries in float32": lambda k, x, w: x - TABLE[k].to(torch.float32) + w,
}
MANY = {
    "a factor": lambda k, x, w: 0.1 * k * x + w,
    "a matrix": lambda k, x, w: MATRICES[k] @ x + w,
    "a numbered factor": lambda k, x, w: torch.cat([TABLE[k], 0.5 * x])[:2] * x + w,
    "a numbered quotient": lambda k, x, w: x / (torch.cat([TABLE[k], x])[:2] + 3) + w,
    "a function of a number": lambda k, x, w: torch.sin(torch.cat([TABLE[k], x])[1:3]) + w,
    "an operation": lambda k, x, w: (torch.sin if k == 5 else torch.cos)(x) + w,
    "one more": lambda k, x, w: torch.sin(x) if k == 2 else x + w,
    "one less": lambda k, x, w: x + w if k == 2 else torch.sin(x + w),
    "other operands": lambda k, x, w: (x if k == 3 else w) + torch.sin(x),
    "other result": lambda k, x, w: (torch.sin(x) + w, torch.cos(x) + w)[k == 3],
    "an index": lambda k, x, w: 0.9 * x + w[k % 2],
    "a list for a tuple": list_or_tuple,
    "a type": lambda k, x, w: x * (2 if k else 2.5) + w,
    "a dimension": lambda k, x, w: torch.stack([x, w]).sum(0 if k < 4 else 1),
    "alpha": lambda k, x, w: torch.add(x, w, alpha=0.1 * (k + 1)),
    "swallowed": swallowed,
    "swallowed at the end": swallowed_at_the_end,
    "written": written,
    "a view": through_a_view,
    "a view of a constant": view_of_a_constant,
}


@pytest.fixture
def points():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 20, 2, dtype=torch.float64, generator=generator) + 0.1


@pytest.mark.parametrize("name", [*ONE, *MANY])
@pytest.mark.parametrize("numbers", [True, False])
def test_every_step_is_what_the_function_does_at_that_step(name, numbers, points):
    function = (ONE | MANY)[name]
    with torch.no_grad():
        found = recorded_steps(function, points[0, 0], points[1, :K], numbers=numbers)
    one = name == "nothing" or (name in ONE and numbers)
    assert len(found.programs) == (1 if one else K)
    assert (found.numbers.shape[-1] > 0) == (one and name != "nothing")
    for k in range(K):
        after = found.step(k, *points)
        expected = torch.stack([function(k, x, w) for x, w in zip(*points, strict=True)])
        torch.testing.assert_close(after, expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", ["a number", "a row", "one step", "a factor", "an operation"])
def test_a_tube_does_not_hang_on_how_the_steps_were_recorded(name):
    box, w, function = Box.around([0.3, 0.4], [0.1, 0.2]), Box.around([0.0, 0.0], [0.05, 0.05]), (ONE | MANY)[name]
    with torch.no_grad():
        each = recorded_steps(function, box.center, w.center.expand(K, -1), numbers=False)
    assert len(each.programs) == K
    tube, expected = reach(function, box, w, K), Affine().propagate(each, box, w)
    torch.testing.assert_close(tube.lower, expected.lower, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(tube.upper, expected.upper, rtol=1e-13, atol=1e-13)


def test_a_loop_object_is_recorded_twice_however_many_steps_it_has(monkeypatch):
    count, record = [0], loops.record

    def counted(*args, **kwargs):
        count[0] += 1
        return record(*args, **kwargs)

    monkeypatch.setattr(loops, "record", counted)
    loop = unicycle_loop(line(0.1))

    class Stranger:
        horizon, state_dim = loop.horizon, 4

        def step(self, k, x, w):
            return loop.step(k, x, w)

    tube = reach(Stranger(), START, DISTURBANCE)
    assert count[0] == 2
    own = Affine().propagate(ClosedLoop(loop.dynamics, loop.tracker, loop.references), START, DISTURBANCE)
    torch.testing.assert_close(tube.upper, own.upper, rtol=1e-12, atol=1e-12)


def test_recordings_in_several_threads_do_not_meet(points):
    found = {}

    def work(name):
        with torch.no_grad():
            found[name] = recorded_steps(ONE[name], points[0, 0], points[1, :K])

    names = ["a number", "a row", "iterated"]
    threads = [threading.Thread(target=work, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for name in names:
        expected = torch.stack([ONE[name](5, x, w) for x, w in zip(*points, strict=True)])
        torch.testing.assert_close(found[name].step(5, *points), expected, rtol=1e-14, atol=1e-14)
