import dataclasses

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.order_reduction import NOTHING
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verdict import Outcome
from sagemp_cli.verification.verification import require_references, verify_references

K = 6
SCENE = Scene(Box([-2.0, -2.0], [4.0, 2.0]), (Ball((1.0, 1.5), 0.2, "disc"),), Box([-9.0] * 4, [9.0] * 4))
START, W = Box.around([0.0, 0.0, 0.0, 1.0], [0.1, 0.2, 0.0, 0.0]), Box.around([0.0] * 4, [0.05, 0.05, 0.0, 0.02])


@dataclasses.dataclass(frozen=True)
class Bare(Propagator):
    """A propagator without control bounds, which counts its calls."""

    calls: list
    symbols: int | None = None
    name = "bare"
    rigorous = False

    def reach(self, loop, start, disturbance, *, watch=False):
        self.calls.append(len(start.lower))
        return Reach(Affine(symbols=self.symbols).propagate(loop, start, disturbance))


@pytest.fixture
def unicycle():
    limits = {"control_lower": [-1.5, -2.0], "control_upper": [1.5, 2.0]}
    return Unicycle(dt=0.1, state_lower=[-3.0, -4.0, -1.6, 0.0], state_upper=[9.0, 4.0, 1.6, 3.0], **limits)


@pytest.fixture
def tracker():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[8, 8])


def references(count):
    x = torch.zeros(count, K + 1, 4, dtype=torch.float64)
    x[..., 0] = 0.1 * torch.arange(K + 1)
    x[..., 1] = 0.05 * torch.arange(count)[:, None]
    x[..., 3] = 1.0
    return x


def prove(propagator, unicycle, tracker, refs, *, start=START, **options):
    return verify_references(
        CellProver(propagator, Problem(unicycle, SCENE, start, W, K), tracker),
        refs,
        counts=[2, 3],
        **options,
    )


def test_every_cell_of_every_reference_encloses_its_own_rollouts(unicycle, tracker):
    found = prove(Affine(), unicycle, tracker, references(3))
    assert found.cells.lower.shape == (18, 4) and found.tube.lower.shape == (18, K + 1, 4)
    generator = torch.Generator().manual_seed(0)
    for r in range(3):
        loop = ClosedLoop(unicycle, tracker, found.references[r])
        cells, tubes = found.cells_of(r)
        for c in range(6):
            x = Box(cells.lower[c], cells.upper[c]).sample(200, generator)
            w = torch.where(torch.rand(200, K, 4, generator=generator) < 0.5, W.lower, W.upper)
            states, controls = loop.rollout(x, w)
            assert bool(Tube(tubes.lower[c], tubes.upper[c]).contains(states).all())
            assert bool((controls >= found.control_lower[r]).all() & (controls <= found.control_upper[r]).all())
    assert [v.outcome for v in found.verdicts] == [Outcome.SAFE] * 3
    assert found.rigorous and found.propagator == "affine" and bool((found.seconds > 0).all())


def test_the_number_of_cells_at_once_changes_nothing_but_the_number_of_calls(unicycle, tracker):
    all_calls, few_calls = [], []
    together = prove(Bare(all_calls, symbols=10_000), unicycle, tracker, references(2))
    apart = prove(Bare(few_calls, symbols=10_000), unicycle, tracker, references(2), cells_at_once=5)
    assert all_calls == [12] and few_calls == [5, 5, 2]
    torch.testing.assert_close(apart.tube.lower, together.tube.lower, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(apart.tube.upper, together.tube.upper, rtol=1e-12, atol=1e-12)
    assert apart.verdicts == together.verdicts


def test_what_is_boxed_because_it_costs_nothing_hangs_on_the_cells_at_once_by_no_more_than_that(unicycle, tracker):
    together = prove(Bare([]), unicycle, tracker, references(2))
    apart = prove(Bare([]), unicycle, tracker, references(2), cells_at_once=5)
    most = K * NOTHING * together.tube.width
    assert bool(((apart.tube.lower - together.tube.lower).abs() <= most).all())
    assert bool(((apart.tube.upper - together.tube.upper).abs() <= most).all())
    assert apart.verdicts == together.verdicts


def test_a_propagator_without_control_bounds_leaves_them_infinite(unicycle, tracker):
    found = prove(Bare([]), unicycle, tracker, references(1))
    assert bool((found.control_lower == -torch.inf).all() & (found.control_upper == torch.inf).all())
    assert found.control_lower.shape == (1, K, 2)
    assert not found.rigorous


def test_each_reference_may_have_a_start_box_of_its_own(unicycle, tracker):
    shift = torch.tensor([[0.0] * 4, [0.0, 1.9, 0.0, 0.0]])
    found = prove(Affine(), unicycle, tracker, references(2), start=Box(START.lower + shift, START.upper + shift))
    assert found.verdicts[0].outcome is Outcome.SAFE
    assert found.verdicts[1].outcome is Outcome.MAY_COLLIDE
    assert torch.equal(found.start.lower, (START.lower + shift).double())


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_reference_that_is_not_finite_is_named_with_step_and_state(unicycle, tracker, value):
    refs = references(3)
    refs[1, 4, 2] = value
    with pytest.raises(NonFiniteError, match=f"reference 1 is {value} at step 4 in state 'theta'; references must be"):
        prove(Affine(), unicycle, tracker, refs)


def test_references_of_another_robot_are_refused(unicycle, tracker):
    with pytest.raises(UsageError, match=r"references must have shape \(count, K\+1, 4\), found \(2, 7, 3\)"):
        prove(Affine(), unicycle, tracker, references(2)[..., :3])


def test_references_have_two_points_at_least(unicycle):
    require_references(references(1)[:, :2], unicycle)
    with pytest.raises(UsageError, match=r"references must have shape \(count, K\+1, 4\), found \(1, 1, 4\)"):
        require_references(references(1)[:, :1], unicycle)
