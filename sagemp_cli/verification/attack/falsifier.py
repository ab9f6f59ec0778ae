"""Searches for a rollout that leaves the safe set or misses the goal; what it returns has been replayed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box
from sagemp_cli.verification.attack.ascent import ascend, first_units, simulate

REPLAY_MARGIN = 1e-9
"""How deep, in units of the state, a replayed violation must be: far above what rounding adds to a rollout."""


@dataclass(frozen=True)
class Counterexample:
    """A rollout that was replayed and breaks the claim.

    Attributes:
        start: ``(n,)``, inside the start box.
        disturbances: ``(K, d)``, each inside the disturbance box.
        states: the replayed states ``(K+1, n)``.
        kind: ``"workspace"``, ``"obstacle"`` or ``"goal"``.
        name: the obstacle's name, or the kind again.
        step: the first step at which the constraint is broken (K for the goal).
        depth: how far it is broken at worst, metres in the scene, units of the state in the goal.
    """

    start: Tensor
    disturbances: Tensor
    states: Tensor
    kind: str
    name: str
    step: int
    depth: float


def margins(states: Tensor, scene: Scene, position: tuple[int, ...]) -> Tensor:
    """Signed margins ``(..., K+1, C)`` of states: [workspace, obstacles..., goal], broken if negative.

    The goal counts at step K only; earlier rows are infinite. Round to nearest.
    """
    p = states[..., list(position)]
    inside = torch.minimum(p - scene.workspace.lower, scene.workspace.upper - p).amin(-1)
    goal = torch.full_like(inside, torch.inf)
    last = states[..., -1, :]
    reached = torch.minimum(last - scene.goal.lower, scene.goal.upper - last).amin(-1)
    goal = torch.cat([goal[..., :-1], reached[..., None]], dim=-1)
    return torch.stack([inside, *(o.signed_distance(p) for o in scene.obstacles), goal], dim=-1)


def replay(
    loop: Loop, start: Tensor, disturbances: Tensor, *, scene: Scene, position: tuple[int, ...]
) -> Counterexample | None:
    """The counterexample that a start ``(n,)`` and disturbances ``(K, d)`` make, simulated alone, or None.

    Violations of at most :data:`REPLAY_MARGIN` do not count, nor does a rollout that overflows.
    """
    with torch.no_grad():
        states = simulate(loop, start, disturbances)
        found = margins(states, scene, position)
    if not bool(torch.isfinite(states).all()):
        return None
    constraint = int(found.amin(0).argmin())
    along = found[:, constraint]
    broken = along < -REPLAY_MARGIN
    if not bool(broken.any()):
        return None
    names = (*scene.constraint_names, "goal")
    kind = {0: "workspace", len(names) - 1: "goal"}.get(constraint, "obstacle")
    step, depth = int(broken.int().argmax()), -float(along.min())
    return Counterexample(start, disturbances, states, kind, names[constraint], step, depth)


def falsify(
    loop: Loop,
    start: Box,
    disturbance: Box,
    *,
    scene: Scene,
    position: tuple[int, ...],
    generator: torch.Generator,
    restarts: int = 8,
    rates: tuple[float, ...] = (2.0, 1.0, 0.5, 0.5, 0.25, 0.25, 0.1, 0.1),
) -> list[Counterexample | None]:
    """One counterexample, or None, for each reference.

    Every constraint (workspace, each obstacle, goal) is attacked by ``restarts`` ascents of its own, all in one
    batch with all references, from the middle, random points and bang-bang disturbances. None proves nothing.

    Args:
        loop: one reference, or a :class:`~sagemp_cli.loop.closed_loop.ClosedLoop` with references ``(R, K+1, n)``.
        start: ``(n,)``, or ``(R, n)`` with one box for each reference.
        disturbance: ``(d,)``.
        scene: workspace, obstacles and goal.
        position: indices of the state that are the position in the scene.
        generator: draws the restarts.
        restarts: ascents for each constraint.
        rates: see :func:`~sagemp_cli.verification.attack.ascent.ascend`.
    """
    if restarts < 1:
        raise UsageError(f"falsifier: restarts must be a positive integer, found {restarts}")
    if start.lower.dim() > 2:
        raise UsageError(f"falsifier: start must have shape (n,) or (R, n), found {tuple(start.lower.shape)}")
    batched = isinstance(loop, ClosedLoop) and loop.references.dim() > 2
    if batched:
        singles = [dataclasses.replace(loop, references=r) for r in loop.references]
        loop = dataclasses.replace(loop, references=loop.references[:, None])
    else:
        singles = [loop]
    n, count, attacks = loop.state_dim, len(singles), len(scene.constraint_names) + 1
    if start.lower.dim() == 2 and len(start.lower) != count:
        raise UsageError(f"falsifier: {len(start.lower)} start boxes for {count} references")
    boxes = Box(start.lower.expand(count, n)[:, None], start.upper.expand(count, n)[:, None])

    # Attack c of a reference is rows c, c + C, c + 2 C, ...; the others' margins are masked out of its score.
    rows = restarts * attacks
    target = torch.arange(rows) % attacks

    def score(states: Tensor) -> Tensor:
        least = margins(states, scene, position).amin(-2)
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
        least = torch.nan_to_num(margins(trial.states, scene, position).flatten(-2).amin(-1), nan=torch.inf)
        value, row = least.min(-1)
        for r in torch.nonzero(value < worst.clamp(max=-REPLAY_MARGIN))[:, 0].tolist():
            example = replay(
                singles[r],
                trial.start[r, row[r]].clone(),
                trial.disturbances[r, row[r]].clone(),
                scene=scene,
                position=position,
            )
            if example is not None:
                found[r], worst[r] = example, value[r]
        if all(example is not None for example in found):
            break
    return found
