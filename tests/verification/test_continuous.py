"""Verdicts in continuous time: at all times, under every signal, refuted only by a rigorous solution."""

import dataclasses

import pytest
import torch

from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ConfigError, UnsupportedOperationError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.flow import AskedDivision
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.scenes.scene import Block, Scene
from sagemp_cli.sets import Between, Box
from sagemp_cli.verification.attack.falsifier import replay
from sagemp_cli.verification.cells import CellProver, CellTubes, Chunk
from sagemp_cli.verification.verdict import Outcome, assess
from sagemp_cli.verification.verification import verify_references

LIMITS = {
    "control_lower": [-1.5, -2.0],
    "control_upper": [1.5, 2.0],
    "state_lower": [-9.0] * 4,
    "state_upper": [9.0] * 4,
}
STEPS = 8


def numbers(*values):
    return torch.tensor(values, dtype=torch.float64)


def tracker():
    made = Tracker(state_dim=4, control_dim=2, lookahead=1, hidden=[4], saturate=True)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, dtype=torch.float64, generator=generator))
    return made


def reference():
    steps = torch.arange(STEPS + 1, dtype=torch.float64)[:, None]
    return steps * numbers(0.1, 0.0, 0.0, 0.0) + numbers(0.0, 0.0, 0.0, 1.0)


def problem(*obstacles, **options):
    everywhere = Box(numbers(*[-torch.inf] * 4), numbers(*[torch.inf] * 4))
    scene = Scene(Box(numbers(-5.0, -5.0), numbers(5.0, 5.0)), obstacles, everywhere)
    robot = Unicycle(dt=0.1, time="continuous", **LIMITS, **options)
    start, w = Box.around([0.0, 0.0, 0.0, 1.0], [0.005] * 4), Box.around([0.0] * 4, [0.01] * 4)
    return Problem(robot, scene, start, w, STEPS, Between.CONTINUOUS)


def verified(asked, **options):
    prover = CellProver(Affine(), asked, tracker(), **options)
    return verify_references(prover, reference()[None], counts=[1, 1, 1, 2])


def test_what_keeps_clear_at_all_times_is_safe():
    found = verified(problem(Block((0.0, 0.3), (0.8, 0.4), "beside")))
    assert found.verdicts[0].outcome is Outcome.SAFE
    assert found.flow is not None and found.between is Between.CONTINUOUS


@pytest.mark.parametrize("x", torch.linspace(0.06, 0.7, 9).tolist())
def test_a_thin_wall_between_the_instants_is_never_driven_through(x):
    verdict = verified(problem(Block((x, -1.0), (x + 0.001, 1.0), "wall"))).verdicts[0]
    assert verdict.outcome is Outcome.MAY_COLLIDE
    assert verdict.constraint == "wall" and abs((verdict.step + verdict.fraction) * 0.1 - x) < 0.06


def test_a_solution_that_goes_through_a_wall_refutes_the_claim_in_rigorous_arithmetic():
    asked = problem(Block((0.34, -1.0), (0.36, 1.0), "wall"))
    loop = ClosedLoop(asked.dynamics, tracker(), reference())
    example = replay(loop, numbers(0.0, 0.0, 0.0, 1.0), torch.zeros(STEPS, 4, dtype=torch.float64), asked)
    assert example is not None and example.proved and example.name == "wall"
    assert 0.3 < (example.step + example.fraction) * 0.1 < 0.4


def test_a_solution_that_only_may_touch_a_wall_refutes_nothing():
    asked = problem(Block((0.34, -1.0), (0.34 + 1e-13, 1.0), "sheet"))
    loop = ClosedLoop(asked.dynamics, tracker(), reference())
    example = replay(loop, numbers(0.0, 0.0, 0.0, 1.0), torch.zeros(STEPS, 4, dtype=torch.float64), asked)
    assert example is None or not example.proved


def test_cells_are_sent_and_kept_with_what_was_proved_between_the_instants():
    asked = problem()
    chunk = Chunk(
        0,
        torch.zeros(1, dtype=torch.int64),
        reference()[None],
        Box(*(s[None] for s in (asked.start.lower, asked.start.upper))),
        2,
    )
    again = Chunk.of(0, chunk.arrays())
    assert again.substeps == 2
    proved = CellProver(Affine(), asked, tracker()).prove(again)
    back = CellTubes.of(proved.arrays())
    assert back.flow is not None and proved.flow is not None
    assert back.flow.division == proved.flow.division and torch.equal(back.flow.drift, proved.flow.drift)


def test_substeps_and_order_are_as_asked_for():
    found = verified(problem(), division=AskedDivision(4, 3))
    assert found.flow is not None and (found.flow.division.substeps, found.flow.division.order) == (4, 3)
    assert found.flow.lower.shape == (2, STEPS, 4, 4)


def test_a_claim_about_all_times_is_not_judged_by_straight_lines_alone():
    asked = problem()
    found = verified(asked)
    with pytest.raises(UsageError, match="all times"):
        assess(
            found.tube,
            asked.scene,
            cell_reference=found.cell_reference,
            position=(0, 1),
            state_names=Unicycle.state_names,
            between=Between.CONTINUOUS,
        )


def test_a_simulated_step_is_never_taken_for_a_proof():
    asked = problem()
    with pytest.raises(UsageError, match="simulated solution"):
        recorded(ClosedLoop(asked.dynamics, tracker(), reference()), asked.start, asked.disturbance)


def test_other_propagators_and_readings_of_w_are_refused():
    with pytest.raises(UnsupportedOperationError, match="instants only"):
        verify_references(CellProver(Crown(), problem(), tracker()), reference()[None], counts=[1] * 4)
    with pytest.raises(ConfigError, match="w is added to the derivative"):
        problem(disturbance="state")


def test_a_rollout_is_a_solution_and_its_path_goes_through_it():
    asked = problem()
    loop = ClosedLoop(asked.dynamics, tracker(), reference())
    w = torch.zeros(STEPS, 4, dtype=torch.float64)
    with torch.no_grad():
        states, controls = loop.rollout(numbers(0.0, 0.0, 0.3, 1.0), w)
        path = asked.dynamics.path(states, controls, w)
    assert torch.equal(path[::4], states)
    u, x, h = controls[0], states[0], 0.1 / 4000
    for _ in range(4000):
        x = x + h * asked.dynamics.derivative(x, u)
    torch.testing.assert_close(states[1], x, rtol=0, atol=1e-4)
    discrete = dataclasses.replace(asked, dynamics=Unicycle(dt=0.1, **LIMITS))
    assert discrete.dynamics.path(states, controls, w) is states


def test_a_control_that_lags_is_proved_with_cells_that_are_cut_where_it_pays():
    asked = problem(Block((0.0, 0.3), (0.8, 0.4), "beside"), delay=0.03, jitter=0.01)
    prover = CellProver(Affine(), asked, tracker())
    found = verify_references(prover, reference()[None], counts=None, budget=4)
    assert found.verdicts[0].outcome is Outcome.SAFE
    near = problem(Block((0.0, 0.0162), (0.8, 0.4), "beside"), delay=0.03, jitter=0.01)
    found = verify_references(CellProver(Affine(), near, tracker()), reference()[None], counts=None, budget=4)
    assert len(found.cells.lower) > 1
