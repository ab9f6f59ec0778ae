"""Best: inside both of its parts, better with rounds, and honest about what it is given."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch

from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled.hints import Hint
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown, taken_back
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, EveryOperation, line, unicycle_loop

WIDE = Box.around([0.0, 0.0, 0.1, 1.0], [0.3, 0.3, 0.5, 0.4])


@pytest.mark.parametrize("start", [START, WIDE], ids=["narrow", "wide"])
def test_the_tube_lies_inside_those_of_affine_and_crown_exactly(start):
    loop = unicycle_loop(line(0.3))
    best = Best().propagate(loop, start, DISTURBANCE)
    for part in (Affine(), Crown()):
        tube = part.propagate(loop, start, DISTURBANCE)
        assert bool((best.lower >= tube.lower).all()) and bool((best.upper <= tube.upper).all())


def test_more_rounds_never_widen_and_pay_where_the_set_is_wide():
    loop = unicycle_loop(line(0.3), gain=0.8)
    widths = [Best(rounds=n).propagate(loop, WIDE, DISTURBANCE).width for n in (1, 2, 4)]
    assert bool((widths[1] <= widths[0]).all()) and bool((widths[2] <= widths[1]).all())
    assert float(widths[1][-1].mean()) < 0.97 * float(widths[0][-1].mean())


def test_one_round_is_the_intersection_of_affine_and_crown():
    loop, start = EveryOperation(), Box.around([0.1, -0.05, 0.2], [0.2] * 3)
    w = Box.around([0.0] * 3, [0.01] * 3)
    best, affine, crown = (p.propagate(loop, start, w) for p in (Best(rounds=1), Affine(), Crown()))
    torch.testing.assert_close(best.lower, torch.maximum(affine.lower, crown.lower), rtol=0, atol=0)
    torch.testing.assert_close(best.upper, torch.minimum(affine.upper, crown.upper), rtol=0, atol=0)


def test_hints_that_are_too_tight_break_the_tube():
    # That sharper bounds of the inputs are used at all, and are trusted.
    loop = unicycle_loop(line(0.3), gain=0.8)
    run = Affine().run(loop, WIDE, DISTURBANCE, keep_steps=True)
    point = [
        [
            Hint(
                r.name, r.radius.shape[-1], *(() if r.lower is None else (torch.from_numpy(r.lower + r.upper) / 2,) * 2)
            )
            for r in step.relaxed
        ]
        for step in run.steps
    ]
    assert float(Affine().run(loop, WIDE, DISTURBANCE, hints=point).tube.width[-1].mean()) < float(
        run.tube.width[-1].mean()
    )


def test_wrong_options_are_refused_in_one_line():
    with pytest.raises(ConfigError, match="propagator.rounds must be a positive integer, found 0"):
        Best(rounds=0)
    with pytest.raises(ConfigError, match="propagator.rows must be a positive integer, found -1"):
        Best(rows=-1)


class Angle:
    """One step whose angle is written best as y / x over the first pass's bounds and as x / y over the second's."""

    horizon, state_dim = 1, 1

    def step(self, k, x, w):
        return torch.atan2(1.5 + 0 * x, 1.2 + torch.log(x * x + 0.5)) + 0 * w


def test_what_was_found_for_an_angle_is_used_for_that_angle_only():
    start, w = Box.around([2.485], [1.165]), Box.around([0.0], [0.0])
    tubes = [Best(rounds=n).propagate(Angle(), start, w) for n in (2, 3)]
    values = Angle().step(0, torch.linspace(1.32, 3.65, 2001, dtype=torch.float64)[:, None], w.center)
    for tube in tubes:
        assert float(tube.lower[-1]) <= float(values.min()) and float(values.max()) <= float(tube.upper[-1])
        assert float(tube.width[-1]) < 2.0 * float(values.max() - values.min())


def test_bounds_of_another_operation_are_refused():
    @dataclass(frozen=True)
    class Step:
        function: Callable
        horizon: int = 1
        state_dim: int = 1

        def step(self, k, x, w):
            return self.function(x) + w

    start, w = Box.around([0.5], [0.3]), Box.around([0.0], [0.1])
    _, hints = taken_back(Affine().run(Step(torch.sin), start, w, keep_steps=True), start, rows=64, inputs=True)
    with pytest.raises(UsageError, match="does not always do the same operations: exp of 1, where it did sin of 1"):
        Affine().run(Step(torch.exp), start, w, hints=hints)


@torch.no_grad()
def test_bounds_across_a_direction_are_used_across_that_direction():
    start, w = Box.around([2.485], [1.165]), Box.around([0.0], [0.0])
    first = Affine().run(Angle(), start, w, keep_steps=True, intervals=False)
    _, hints = taken_back(first, start, rows=64, inputs=True)
    kept, anew = (
        Affine().run(Angle(), start, w, keep_steps=True, hints=[h], intervals=False).steps[0].relaxed[-1]
        for h in (hints[0], [h._replace(turn=None) for h in hints[0]])
    )
    assert hints[0][-1].name == kept.name == "atan2"
    assert torch.equal(torch.from_numpy(kept.turn.angle), hints[0][-1].turn.angle)
    assert bool((torch.from_numpy(kept.lower) >= hints[0][-1].lower).all())
    assert abs(anew.turn.angle - kept.turn.angle).max() > 0.1  # what it would have been
