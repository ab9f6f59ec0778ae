"""The forward pass on arrays against the one on tensors, operation by operation, which knows nothing of it."""

from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch

from sagemp_cli.reachability.affine import affine
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled import operations as planned_operations
from sagemp_cli.reachability.affine.compiled import run as planned_run
from sagemp_cli.reachability.affine.compiled.foldable_loop import NotFoldable
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import partition

from ..propagator_cases import DISTURBANCE, START, AffineLoop, EveryOperation, line, rollouts, unicycle_loop


@dataclass(frozen=True)
class Given:
    """A loop whose steps differ by their number, told so."""

    loop: Any
    given_dim: ClassVar[int] = 1

    @property
    def horizon(self):
        return self.loop.horizon

    @property
    def state_dim(self):
        return self.loop.state_dim

    def given(self, k):
        return torch.tensor([float(k)], dtype=torch.float64)

    def step_given(self, given, x, w):
        return self.loop.step(given, x, w), None

    def step(self, k, x, w):
        return self.step_given(self.given(k), x, w)[0]


class Quotients:
    horizon, state_dim = 4, 2

    def step(self, k, x, w):
        a, b = x[..., 0], x[..., 1]
        return torch.stack([a / (2.0 + torch.cos(b)), b / (3.0 + a)], dim=-1) + 1.0 / (4.0 + w)


class Angles:
    horizon, state_dim = 4, 2

    def step(self, k, x, w):
        return 0.5 * torch.atan2(x, 2.0 + w) + 0.1 * torch.atan2(x[..., :1], x - 3.0)


class FromTheFront:
    horizon, state_dim = 4, 2

    def step(self, k, x, w):
        a, b = x.unbind(x.dim() - 1)  # counted from the front, where a batch may be
        return 0.5 * torch.sin(torch.stack([a + b, b], dim=-1)) + w


NOISE = Box.around([0.05, 0.0, 0.0], [0.1] * 3)
LOOPS = {
    "unicycle": (unicycle_loop(line(0.1)), START, DISTURBANCE),
    "unicycle, folded": (unicycle_loop(line(0.1)).folded(), START, DISTURBANCE),
    "two references": (unicycle_loop(line(0.1), line(-0.2)), partition(START, [2, 2, 1, 1]), DISTURBANCE),
    "every operation": (Given(EveryOperation()), Box.around([0.2, -0.1, 0.4], [0.3] * 3), NOISE),
    "every operation, wide": (Given(EveryOperation()), Box.around([0.1, -0.05, 0.03], [1.2] * 3), NOISE),
    "angles": (Given(Angles()), Box.around([0.5, 0.2], [0.1, 0.2]), Box.around([0.0] * 2, [0.1] * 2)),
    "quotients": (Given(Quotients()), Box.around([0.2, 0.1], [0.3, 0.5]), Box.around([0.0] * 2, [0.1] * 2)),
    "numbers": (Given(AffineLoop()), Box.around([0.0, 1.0], [0.1, 0.2]), Box.around([0.1, 0.0], [0.05, 0.02])),
}


@pytest.fixture
def one_by_one(monkeypatch):
    """Switches the forward pass on arrays off."""

    def refuse(*_, **__):
        raise NotFoldable

    return lambda: monkeypatch.setattr(affine, "planned_run", refuse)


@pytest.mark.parametrize("propagator", [Affine(), Affine(symbols=25), Crown(), Best()], ids=str)
@pytest.mark.parametrize("name", LOOPS)
def test_the_tube_is_that_of_the_pass_on_tensors(name, propagator, one_by_one, monkeypatch):
    loop, start, disturbance = LOOPS[name]
    start = Box(*torch.broadcast_tensors(start.lower, start.upper))
    if name == "two references":
        start = Box(start.lower.expand(2, -1, -1), start.upper.expand(2, -1, -1))
    calls = []
    honest = planned_run._Prepared
    monkeypatch.setattr(planned_run, "_Prepared", lambda *args: calls.append(0) or honest(*args))
    found = propagator.propagate(loop, start, disturbance)
    assert calls
    one_by_one()
    calls.clear()
    expected = propagator.propagate(loop, start, disturbance)
    assert not calls and found.lower.shape == expected.lower.shape
    width = expected.width.max()
    torch.testing.assert_close(found.lower, expected.lower, rtol=1e-8, atol=1e-8 * float(width))
    torch.testing.assert_close(found.upper, expected.upper, rtol=1e-8, atol=1e-8 * float(width))


def test_the_record_and_the_controls_are_those_of_the_pass_on_tensors(one_by_one):
    loop, start, disturbance = LOOPS["unicycle"]
    cells = partition(start, [2, 1, 1, 2])
    found = Affine().reach(loop, cells, disturbance, watch=True)
    one_by_one()
    expected = Affine().reach(loop, cells, disturbance, watch=True)
    record, other = found.recording, expected.recording
    for side in ("control_lower", "control_upper"):
        mine, theirs = getattr(found, side), getattr(expected, side)
        torch.testing.assert_close(mine, theirs, rtol=1e-8, atol=1e-8)
    assert (record.operations, record.widths) == (other.operations, other.widths)
    assert record.slope.shape == other.slope.shape and record.kept.shape[:2] == (4, loop.horizon)
    torch.testing.assert_close(record.radius, other.radius, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "shrunk"),
    [(name, "rows") for name in ("unicycle", "quotients", "numbers")]
    + [(name, "radius") for name in ("unicycle", "quotients")],
)
def test_a_smaller_radius_than_a_relaxation_has_is_found_out(name, shrunk, monkeypatch):
    loop, start, disturbance = LOOPS[name]
    states = rollouts(loop, start, disturbance)

    def escapes():
        tube = Affine().propagate(loop, start, disturbance)
        return bool(((states < tube.lower - 1e-12) | (states > tube.upper + 1e-12)).any())

    assert not escapes()
    honest = getattr(planned_operations.States, shrunk)
    monkeypatch.setattr(planned_operations.States, shrunk, lambda *a, **options: 0.3 * honest(*a, **options))
    assert escapes()


def test_what_cannot_be_folded_is_propagated_operation_by_operation():
    loop, start, disturbance = Given(FromTheFront()), *LOOPS["angles"][1:]
    tube = Affine().propagate(loop, start, disturbance)
    states = rollouts(loop, start, disturbance)
    assert bool(((tube.lower <= states) & (states <= tube.upper)).all())


def test_where_a_gradient_is_wanted_the_pass_is_on_tensors():
    loop, start, disturbance = LOOPS["unicycle"]
    radius = start.radius.clone().requires_grad_(True)
    with torch.enable_grad():
        tube = Affine().run(loop, Box(start.center - radius, start.center + radius), disturbance).tube
        tube.width[-1].sum().backward()
    assert bool((radius.grad > 0).all())
