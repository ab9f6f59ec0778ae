"""Searches for a rollout that leaves the safe set or misses the goal.

The search is in float64; what it finds is replayed in rigorous arithmetic
(:mod:`sagemp_cli.verification.attack.rigorous_replay`), and says whether that proved it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.scenes.segments import along
from sagemp_cli.sets import Between, Box
from sagemp_cli.verification.attack.ascent import ascend, first_units, simulate
from sagemp_cli.verification.attack.rigorous_replay import Replay, inner


@dataclass(frozen=True)
class Counterexample:
    """A rollout that breaks the claim, in float64 at least.

    Attributes:
        start: ``(n,)``, inside the start box.
        disturbances: ``(K, d)``, each inside the disturbance box and, in two columns more, the bounds of a lag.
        states: the replayed states ``(K+1, n)``, in float64.
        kind: ``"workspace"``, ``"obstacle"`` or ``"goal"``.
        name: the obstacle's name, or the kind again.
        step: the first step in which the constraint is broken (K for the goal).
        fraction: of that step, in [0, 1): the earliest time that is known at which it is.
        depth: how far it is broken at worst, metres in the scene, units of the state in the goal.
        state: of a missed goal the state that misses most, else -1.
        proved: whether rigorous arithmetic proves that the constraint is broken at ``step``. If not, the violation may
            be one of rounding only, and nothing is refuted.
    """

    start: Tensor
    disturbances: Tensor
    states: Tensor
    kind: str
    name: str
    step: int
    depth: float
    state: int = -1
    proved: bool = False
    fraction: float = 0.0


def margins(states: Tensor, problem: Problem) -> Tensor:
    """Signed margins ``(..., K+1, C)`` of states: [workspace, obstacles..., goal], broken if negative.

    Row k is over the whole of the straight line from ``x_k`` to ``x_{k+1}``, or at ``x_k`` alone if the problem asks
    for the samples only. The goal counts at step K only: all else in its row, and it in all others, is infinite where
    lines are asked for. Round to nearest.
    """
    scene, p = problem.scene, states[..., list(problem.dynamics.position)]
    inside = torch.minimum(p - scene.workspace.lower, scene.workspace.upper - p).amin(-1)
    endless = torch.full_like(inside, torch.inf)
    last = states[..., -1, :]
    reached = torch.minimum(last - scene.goal.lower, scene.goal.upper - last).amin(-1)
    goal = torch.cat([endless[..., :-1], reached[..., None]], dim=-1)
    if problem.between is Between.SAMPLES:
        return torch.stack([inside, *(o.signed_distance(p) for o in scene.obstacles), goal], dim=-1)
    rows = [
        torch.minimum(inside[..., :-1], inside[..., 1:]),  # the workspace is convex: an end is the worst place
        *(o.signed_distance(along(p, o.nearest(p))) for o in scene.obstacles),
    ]
    return torch.stack([*(torch.cat([row, endless[..., :1]], dim=-1) for row in rows), goal], dim=-1)


def worst_fractions(states: Tensor, problem: Problem) -> Tensor:
    """Where in [0, 1] of each step a rollout ``(K+1, n)`` is worst for each constraint, ``(K, C - 1)``: no goal."""
    scene, p = problem.scene, states[..., list(problem.dynamics.position)]
    inside = torch.minimum(p - scene.workspace.lower, scene.workspace.upper - p).amin(-1)
    return torch.stack([(inside[1:] < inside[:-1]).to(p), *(o.nearest(p) for o in scene.obstacles)], dim=-1)


def replay(loop: Loop, start: Tensor, disturbances: Tensor, problem: Problem) -> Counterexample | None:
    """The counterexample that a start ``(n,)`` and disturbances ``(K, d)`` make alone, or None if float64 shows none.

    Both are first moved into what X_I and W hold whatever their corners were rounded from. A rollout that overflows
    is no counterexample.

    Args:
        loop: what steps.
        start, disturbances: the rollout.
        problem: what is claimed, with X_I ``(n,)``; the loop may be another one than that of its robot.
    """
    start, disturbances = _into(inner(problem.start), start), _into(inner(problem.unknowns), disturbances)
    scene = problem.scene
    with torch.no_grad():
        states = simulate(loop, start, disturbances)
        found = margins(states, problem)
    if not bool(torch.isfinite(states).all()) or not bool((found < 0).any()):
        return None
    worst = worst_fractions(states, problem)
    rigorous = Replay.of(loop, start, disturbances, problem)
    proved = rigorous.broken(worst)
    certain = bool(proved.any())
    # Of what is proved (of what float64 shows, if nothing is) the constraint that is broken most.
    broken = proved if certain else found < 0
    constraint = int(torch.where(broken, found, torch.inf).amin(0).argmin())
    names = (*scene.constraint_names, "goal")
    kind = {0: "workspace", len(names) - 1: "goal"}.get(constraint, "obstacle")
    step, depth = int(broken[:, constraint].int().argmax()), -float(found[:, constraint].min())
    miss = int(torch.minimum(states[-1] - scene.goal.lower, scene.goal.upper - states[-1]).argmin())
    state, fraction = miss if kind == "goal" else -1, 0.0
    if kind != "goal" and problem.between is not Between.SAMPLES:
        fraction = float(worst[step, constraint])
        if certain:
            fraction = rigorous.first(step, constraint, fraction)
        if fraction == 1.0:
            step, fraction = step + 1, 0.0
    return Counterexample(start, disturbances, states, kind, names[constraint], step, depth, state, certain, fraction)


def _into(box: Box, point: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(point, box.lower), box.upper)


def falsify(
    loop: Loop,
    problem: Problem,
    *,
    generator: torch.Generator,
    restarts: int = 8,
    rates: tuple[float, ...] = (2.0, 1.0, 0.5, 0.5, 0.25, 0.25, 0.1, 0.1),
) -> list[Counterexample | None]:
    """One counterexample, or None, for each reference; where none is proved, the deepest that float64 shows.

    Every constraint (workspace, each obstacle, goal) is attacked by ``restarts`` ascents of its own, all in one
    batch with all references, from the middle, random points and bang-bang disturbances. None proves nothing.

    Args:
        loop: one reference, or a :class:`~sagemp_cli.loop.closed_loop.ClosedLoop` with references ``(R, K+1, n)``.
        problem: what is claimed, with X_I ``(n,)``, or ``(R, n)`` with one box for each reference; the loop may be
            another one than that of its robot.
        generator: draws the restarts.
        restarts: ascents for each constraint.
        rates: see :func:`~sagemp_cli.verification.attack.ascent.ascend`.
    """
    if restarts < 1:
        raise UsageError(f"falsifier: restarts must be a positive integer, found {restarts}")
    start, disturbance = problem.start, problem.unknowns
    if start.lower.dim() > 2:
        raise UsageError(f"falsifier: start must have shape (n,) or (R, n), found {tuple(start.lower.shape)}")
    if isinstance(loop, ClosedLoop) and loop.references.dim() > 2:
        singles = [dataclasses.replace(loop, references=r) for r in loop.references]
        loop = dataclasses.replace(loop, references=loop.references[:, None])
    else:
        singles = [loop]
    n, count, attacks = loop.state_dim, len(singles), len(problem.scene.constraint_names) + 1
    if start.lower.dim() == 2 and len(start.lower) != count:
        raise UsageError(f"falsifier: {len(start.lower)} start boxes for {count} references")
    boxes = Box(start.lower.expand(count, n)[:, None], start.upper.expand(count, n)[:, None])

    # Attack c of a reference is rows c, c + C, c + 2 C, ...; the others' margins are masked out of its score.
    rows = restarts * attacks
    target = torch.arange(rows) % attacks

    def score(states: Tensor) -> Tensor:
        least = margins(states, problem).amin(-2)
        return -least.gather(-1, target.expand(count, rows)[..., None])[..., 0]

    x, w = first_units((count, restarts), loop.horizon, start, disturbance, generator)
    worst = torch.full((count,), torch.inf, dtype=torch.float64)
    found: list[Counterexample | None] = [None] * count
    for trial in ascend(
        loop,
        boxes,
        disturbance,
        score=score,
        start_unit=x.repeat_interleave(attacks, dim=1),
        disturbance_unit=w.repeat_interleave(attacks, dim=1),
        rates=rates,
    ):
        least = torch.nan_to_num(margins(trial.states, problem).flatten(-2).amin(-1), nan=torch.inf)
        value, row = least.min(-1)
        for r in torch.nonzero(value < worst.clamp(max=0.0))[:, 0].tolist():
            example = replay(
                singles[r],
                trial.start[r, row[r]].clone(),
                trial.disturbances[r, row[r]].clone(),
                dataclasses.replace(problem, start=Box(boxes.lower[r, 0], boxes.upper[r, 0])),
            )
            if example is None:
                continue
            before = found[r]
            if before is None or example.proved or not before.proved:
                found[r], worst[r] = example, value[r]
        if all(example is not None and example.proved for example in found):
            break
    return found
