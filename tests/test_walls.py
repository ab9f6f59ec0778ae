"""A hundred random walls, 1 mm thick, between and at the samples: no stage calls a robot safe that drives through one.

The robot is a unicycle that goes 0.08 m a step from X_I of +-5 mm, without disturbance: its tube is far narrower than
a step is long, so most walls stand between two samples of every rollout.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from sagemp_cli.checker.balls import BITS, ctx
from sagemp_cli.checker.between import Line, boxes_of
from sagemp_cli.checker.clearance import clearances
from sagemp_cli.checker.scene import SafeSet
from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.execution import execute_queries, try_references
from sagemp_cli.library.builder import REFERENCE_COLLIDES, reference_faults
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes import Block, Scene
from sagemp_cli.sets import Between, Box
from sagemp_cli.stages.prove import prove
from sagemp_cli.verification.attack.refutation import FalsifierOptions, attack
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verdict import Answer, Outcome, assess
from sagemp_cli.verification.verification import verify_references

K, WALLS = 12, 100
SIDES = {"lower": [-9.0] * 4, "upper": [9.0] * 4}
ROBOT = Unicycle(
    dt=0.1, control_lower=[-9.0] * 2, control_upper=[9.0] * 2, state_lower=SIDES["lower"], state_upper=SIDES["upper"]
)
ENDLESS = Box(torch.full((4,), -math.inf), torch.full((4,), math.inf))
START = Box.around([0.0, 0.0, 0.0, 0.8], [0.005, 0.005, 0.0, 0.0])
STILL = Box.around([0.0] * 4, [0.0] * 4)
WORKSPACE = Box([-5.0, -5.0], [5.0, 5.0])


def problem(*walls: Block) -> Problem:
    return Problem(ROBOT, Scene(WORKSPACE, walls, ENDLESS), START, STILL, K)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Tracker(state_dim=4, control_dim=2, lookahead=2, hidden=[4], control_scale=[0.1, 0.1])


@pytest.fixture(scope="module")
def reference() -> torch.Tensor:
    steps = torch.arange(K + 1, dtype=torch.float64)[:, None]
    return torch.tensor([[0.0, 0.0, 0.0, 0.8]], dtype=torch.float64) + steps * torch.tensor([[0.08, 0.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def walls() -> list[Block]:
    """Anywhere along the way; some do not reach it."""
    rng = np.random.default_rng(0)
    made = []
    for i in range(WALLS):
        x, low = float(rng.uniform(0.02, 0.9)), float(rng.uniform(-0.3, 0.02))
        made.append(Block((x, low), (x + 0.001, low + float(rng.uniform(0.05, 0.4))), f"wall {i}"))
    return made


@pytest.fixture(scope="module")
def rollouts(tracker, reference) -> np.ndarray:
    """From the middle, the corners and inner points of X_I, ``(B, K+1, 4)``."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.cartesian_prod(*[torch.stack([a, b]) for a, b in zip(START.lower[:2], START.upper[:2])])
    x = torch.cat([START.center[None], torch.cat([corners, START.center[2:].expand(4, 2)], -1)])
    x = torch.cat([x, START.sample(40, generator)])
    states, _ = ClosedLoop(ROBOT, tracker, reference).rollout(x, torch.zeros(len(x), K, 4, dtype=torch.float64))
    return states.detach().numpy()


def crosses(path: np.ndarray, wall: Block) -> bool:
    """Whether a straight piece of a path meets a wall, in rational arithmetic."""
    for a, b in zip(path[:-1, :2], path[1:, :2], strict=True):
        enter, leave = Fraction(0), Fraction(1)
        for p, q, low, high in zip(a, b, wall.lower, wall.upper, strict=True):
            p, q, low, high = (Fraction(float(v)) for v in (p, q, low, high))
            if p == q:
                if not low <= p <= high:
                    leave = Fraction(-1)
                continue
            ends = sorted([(low - p) / (q - p), (high - p) / (q - p)])
            enter, leave = max(enter, ends[0]), min(leave, ends[1])
        if enter <= leave:
            return True
    return False


@pytest.fixture(scope="module")
def driven_through(walls, rollouts) -> list[bool]:
    found = [any(crosses(path, wall) for path in rollouts[:10]) for wall in walls]
    at_samples = [bool((wall.signed_distance(torch.from_numpy(rollouts[..., :2])) <= 0).any()) for wall in walls]
    # Most of those that are crossed are touched by no rollout at a sample: that is what is tested here.
    assert sum(found) > 60 and sum(a and not b for a, b in zip(found, at_samples)) > 40 and not all(found)
    return found


@pytest.fixture(scope="module")
def proved(tracker, reference):
    return verify_references(CellProver(Affine(), problem(), tracker), reference[None], counts=[1, 1])


def judged(proved, *walls, between=Between.SEGMENTS):
    return assess(
        proved.tube,
        problem(*walls).scene,
        cell_reference=proved.cell_reference,
        position=(0, 1),
        state_names=ROBOT.state_names,
        between=between,
    )


def test_no_verdict_is_safe_where_a_rollout_drives_through(proved, walls, driven_through):
    outcomes = [judged(proved, wall).verdicts[0].outcome for wall in walls]
    assert all(o is Outcome.MAY_COLLIDE for o, crossed in zip(outcomes, driven_through) if crossed)
    assert any(o is Outcome.SAFE for o in outcomes)
    # At the samples alone most of them would be called safe.
    careless = [judged(proved, wall, between=Between.SAMPLES).verdicts[0].outcome for wall in walls]
    assert sum(o is Outcome.SAFE and crossed for o, crossed in zip(careless, driven_through)) > 40


def test_the_attack_refutes_every_wall_that_all_rollouts_drive_through(proved, tracker, walls, rollouts):
    certain = [wall for wall in walls if all(crosses(path, wall) for path in rollouts[:10])]
    assert len(certain) > 40
    for wall in certain[::4]:
        found = dataclasses.replace(proved, verdicts=judged(proved, wall).verdicts)
        options = FalsifierOptions(restarts=1, safe_restarts=0)
        generator = torch.Generator().manual_seed(0)
        refuted = attack(found, problem(wall), tracker=tracker, generator=generator, options=options)
        [(_, example)] = refuted.counterexamples
        assert (
            example.proved and example.name == wall.name and refuted.verification.verdicts[0].outcome is Outcome.UNSAFE
        )
        assert crosses(example.states.numpy(), wall)
        a, b = example.states[example.step], example.states[min(example.step + 1, K)]
        met = (a + example.fraction * (b - a))[:2]
        assert abs(float(wall.signed_distance(met))) < 1e-6  # the time that is named is when it is first touched


def test_a_plan_through_a_wall_is_no_plan_for_a_library(reference, walls):
    path = reference.numpy()
    for wall in walls:
        [fault] = reference_faults(reference[None], problem(wall).scene, position=(0, 1))
        assert (fault == REFERENCE_COLLIDES) == crosses(path, wall)


def test_executed_rollouts_that_drive_through_are_counted_as_unsafe(proved, tracker, walls, reference):
    for wall in walls[::5]:
        done = execute_queries(
            proved, lambda starts: reference.expand(len(starts), -1, -1), problem=problem(wall), tracker=tracker,
            starts=START.center[None], rollouts=2, generator=torch.Generator().manual_seed(0),
        )  # fmt: skip
        assert done.safe.tolist() == [not crosses(path, wall) for path in done.states.numpy()]


def test_safety_rates_count_rollouts_that_drive_through(tracker, walls, reference):
    generator = torch.Generator().manual_seed(0)
    for wall in walls[::20]:
        tried = try_references(reference[None], problem(wall), tracker=tracker, rollouts=2, generator=generator)
        for way in (tried.open_loop, tried.closed_loop):
            crossed = [crosses(path, wall) for path in way.nearest[0].numpy()]
            assert [not bool(safe) for safe in way.safe[0].all(-1)] == crossed


def test_a_certificate_that_calls_a_wall_kept_clear_of_is_not_proved(proved, walls, driven_through):
    """The checker's own account of the lines, in balls, on the tube and walls alone."""
    cells = zip(proved.tube.lower[..., :2].numpy(), proved.tube.upper[..., :2].numpy(), strict=True)
    lines = [Line(*ends) for lower, upper in cells for ends in itertools.pairwise(boxes_of(lower, upper))]
    for wall, crossed in zip(walls, driven_through, strict=True):
        mapping = {"kind": "block", "name": wall.name, "lower": list(wall.lower), "upper": list(wall.upper)}
        safe = SafeSet.of({"obstacles": [mapping]})
        with ctx.workprec(BITS):
            [distance] = clearances(safe, lines, 8)
        assert not (crossed and distance > 0)
        [mine] = judged(proved, wall).clearance[0, 1:].tolist()
        assert float(distance) == pytest.approx(mine, abs=1e-12) and mine <= float(distance)


def test_a_strangers_loop_that_drives_through_is_not_proved(walls):
    """The same motion without a robot: straight ahead."""

    def step(x):
        return x + torch.tensor([0.08, 0.0], dtype=torch.float64)

    start = Box.around([0.0, 0.0], [0.005, 0.005])
    path = np.array([[0.08 * k, 0.0] for k in range(K + 1)])
    answers = set()
    for wall in walls[::8]:
        scene = {"obstacles": [{"kind": "block", "lower": list(wall.lower), "upper": list(wall.upper)}]}
        proof = prove(step, start, horizon=K, scene=scene, partitions=1)
        answers.add(proof.answer)
        assert proof.answer is not Answer.VERIFIED or not crosses(path, wall)
    assert answers == {Answer.VERIFIED, Answer.FALSIFIED}


def test_the_example_that_was_called_safe_is_not(tracker, reference):
    """A wall from 0.3 to 0.301 m, samples at 0.24 and 0.32 m: "SAFE, keeps 0.00337 m"."""
    wall = Block((0.3, -1.0), (0.301, 1.0), "thin wall")
    found = verify_references(CellProver(Affine(), problem(wall), tracker), reference[None], counts=[1, 1])
    verdict = found.verdicts[0]
    assert verdict.outcome is Outcome.MAY_COLLIDE and verdict.constraint == "thin wall"
    assert verdict.step == 3 and 0.5 < verdict.fraction < 0.75
    refuted = attack(found, problem(wall), tracker=tracker, generator=torch.Generator().manual_seed(0))
    assert refuted.verification.verdicts[0].outcome is Outcome.UNSAFE
