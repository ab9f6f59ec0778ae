"""The forward pass: on arrays and on tensors, against rollouts."""

import dataclasses

import pytest
import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled.operations import Frame
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import partition
from sagemp_cli.sets.zonotope import Zonotope

from ..propagator_cases import DISTURBANCE, START, AffineLoop, EveryOperation, line, rollouts, unicycle_loop


class Quotients:
    horizon, state_dim = 4, 2

    def step(self, k, x, w):
        a, b = x[..., 0], x[..., 1]
        return torch.stack([a / (2.0 + torch.cos(b)), b / (3.0 + a)], dim=-1) + 1.0 / (4.0 + w)


class Weighted:
    horizon, state_dim = 4, 2

    def __init__(self, weight):
        self.weight = weight

    def step(self, k, x, w):
        return torch.tanh(torch.nn.functional.linear(x, self.weight))


class Angles:
    horizon, state_dim = 4, 2

    def step(self, k, x, w):
        return 0.5 * torch.atan2(x, 2.0 + w) + 0.1 * torch.atan2(x[..., :1], x - 3.0)


NOISE = Box.around([0.05, 0.0, 0.0], [0.1] * 3)
LOOPS = {
    "unicycle": (unicycle_loop(line(0.1)), START, DISTURBANCE),
    "two references": (unicycle_loop(line(0.1), line(-0.2)), partition(START, [2, 2, 1, 1]), DISTURBANCE),
    "every operation": (EveryOperation(), Box.around([0.2, -0.1, 0.4], [0.3] * 3), NOISE),
    "every operation, wide": (EveryOperation(), Box.around([0.1, -0.05, 0.03], [1.2] * 3), NOISE),
    "angles": (Angles(), Box.around([0.5, 0.2], [0.1, 0.2]), Box.around([0.0] * 2, [0.1] * 2)),
    "quotients": (Quotients(), Box.around([0.2, 0.1], [0.3, 0.5]), Box.around([0.0] * 2, [0.1] * 2)),
    "numbers": (AffineLoop(), Box.around([0.0, 1.0], [0.1, 0.2]), Box.around([0.1, 0.0], [0.05, 0.02])),
}


@pytest.mark.parametrize("symbols", [None, 25])
@pytest.mark.parametrize("name", LOOPS)
def test_tensors_give_the_tube_that_arrays_give(name, symbols):
    loop, start, disturbance = LOOPS[name]
    if name == "two references":
        start = Box(start.lower.expand(2, -1, -1), start.upper.expand(2, -1, -1))
    arrays = Affine(symbols=symbols).run(loop, start, disturbance, intervals=False)
    wanted = Box(start.lower.clone().requires_grad_(True), start.upper)
    tensors = Affine(symbols=symbols).run(loop, wanted, disturbance)
    assert tensors.tube.lower.requires_grad and not arrays.tube.lower.requires_grad
    width = float(arrays.tube.width.max())
    for found, expected in ((tensors.tube.lower, arrays.tube.lower), (tensors.tube.upper, arrays.tube.upper)):
        torch.testing.assert_close(found.detach(), expected, rtol=1e-8, atol=1e-8 * width)
    for mine, other in zip(arrays.bands, tensors.bands, strict=True):
        assert [name for name, _ in mine] == [name for name, _ in other]


@pytest.mark.parametrize("propagator", [Affine(), Affine(symbols=25), Crown(), Best()], ids=str)
@pytest.mark.parametrize("name", LOOPS)
def test_the_tube_holds_the_rollouts(name, propagator):
    loop, start, disturbance = LOOPS[name]
    if name == "two references":
        return
    tube, states = propagator.propagate(loop, start, disturbance), rollouts(loop, start, disturbance)
    assert bool(((tube.lower <= states) & (states <= tube.upper)).all())


def test_a_recorded_loop_of_any_batch_is_propagated_with_cells_of_any():
    references, cells = (line(0.1), line(-0.2)), partition(START, [2, 1, 1, 1])
    tube = Affine().propagate(unicycle_loop(*references), cells, DISTURBANCE)
    assert tube.lower.shape[:2] == (2, 2)
    alone = Affine().propagate(unicycle_loop(references[1]), cells, DISTURBANCE)
    torch.testing.assert_close(tube.lower[1], alone.lower, rtol=1e-9, atol=1e-11)


def test_what_is_recorded_is_what_was_done_and_controls_are_bounded():
    loop, start, disturbance = LOOPS["unicycle"]
    cells = partition(start, [2, 1, 1, 2])
    found = Affine().reach(loop, cells, disturbance, watch=True)
    lower, upper, record = found.control_lower, found.control_upper, found.recording
    assert record.operations == ("leaky_relu", "leaky_relu", "cos", "sin", "product") and record.widths == (
        6,
        6,
        1,
        1,
        2,
    )
    assert record.slope.shape == (4, loop.horizon, 16) and record.kept.shape[:2] == (4, loop.horizon)
    assert bool((record.radius >= 0).all())
    for c in range(4):
        states = rollouts(loop, Box(cells.lower[c], cells.upper[c]), disturbance)
        for k in range(loop.horizon):
            u = loop.control(k, states[:, k])
            assert bool(((lower[c, k] <= u) & (u <= upper[c, k])).all())


@pytest.mark.parametrize(
    ("name", "shrunk"),
    [(name, "affine_map") for name in ("unicycle", "quotients", "numbers")]
    + [(name, "radius") for name in ("unicycle", "quotients")],
)
def test_a_smaller_radius_than_a_relaxation_has_is_found_out(name, shrunk, monkeypatch):
    loop, start, disturbance = LOOPS[name]
    states = rollouts(loop, start, disturbance)

    def escapes():
        tube = Affine().propagate(loop, start, disturbance)
        return bool(((states < tube.lower - 1e-12) | (states > tube.upper + 1e-12)).any())

    assert not escapes()
    owner = {"affine_map": Zonotope, "radius": Frame}[shrunk]
    honest = getattr(owner, shrunk)

    def smaller(*args, **options):
        found = honest(*args, **options)
        return dataclasses.replace(found, generators=0.3 * found.generators) if owner is Zonotope else 0.3 * found

    monkeypatch.setattr(owner, shrunk, smaller)
    assert escapes()


def test_where_a_gradient_is_wanted_the_pass_is_on_tensors():
    loop, start, disturbance = LOOPS["unicycle"]
    radius = start.radius.clone().requires_grad_(True)
    with torch.enable_grad():
        tube = Affine().run(loop, Box(start.center - radius, start.center + radius), disturbance).tube
        tube.width[-1].sum().backward()
    assert bool((radius.grad > 0).all())


def test_a_program_is_compiled_once_and_again_if_somebody_writes_into_its_constants():
    loop, start, disturbance = LOOPS["quotients"]
    weight = torch.tensor([[0.5, 0.1], [0.0, 0.5]], dtype=torch.float64)
    known = recorded(Weighted(weight), start, disturbance)
    with torch.no_grad():
        before, again = (Affine().run(known, start, disturbance).tube for _ in range(2))
        held = [c for p in known.programs for i in p.instructions for c in i.constants if c.shape == weight.shape]
        for constant in held:
            constant.mul_(0.5)
        after = Affine().run(known, start, disturbance).tube
    assert held and torch.equal(before.upper, again.upper)
    assert float((after.width[-1] / before.width[-1]).amax()) < 0.5
