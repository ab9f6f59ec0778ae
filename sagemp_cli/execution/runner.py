"""Algorithm 3 of the paper: measure, ask the planner, track the closest certified reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.execution.disturbances import random_disturbances, worst_case_disturbances
from sagemp_cli.library.closest import closest_reference
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.verification import Verification

ROUNDING = 1e-9
"""Margin of the membership test, in state units: the tube encloses the real-arithmetic loop, and a simulated rollout
differs from it by the rounding of float64, which over a few hundred contracting steps stays far below this."""


@dataclass(frozen=True)
class Execution:
    """Rollouts of Algorithm 3 for Q queries with M rollouts each; ``rollouts`` = Q * M.

    Attributes:
        sampled: what the planner proposed, ``(Q, K+1, n)``.
        chosen: index of the certified reference that is tracked instead, ``(Q,)``.
        error: E_tau of equation 10, ``(Q,)``.
        query: query of each rollout, ``(rollouts,)``.
        states, controls, disturbances: ``(rollouts, K+1, n)``, ``(rollouts, K, m)``, ``(rollouts, K, d)``.
        in_tube: whether the rollout stayed in its certified tube, ``(rollouts,)``.
        safe: whether it kept clear over the whole of every step and ended in the goal, ``(rollouts,)``.
    """

    sampled: Tensor
    chosen: Tensor
    error: Tensor
    query: Tensor
    states: Tensor
    controls: Tensor
    disturbances: Tensor
    in_tube: Tensor
    safe: Tensor


def execute_queries(
    library: Verification,
    propose: Callable[[Tensor], Tensor],
    *,
    problem: Problem,
    tracker: Controller,
    starts: Tensor,
    rollouts: int,
    generator: torch.Generator,
    progress: Progress | None = None,
) -> Execution:
    """Run Algorithm 3 from measured starts, each under several disturbance sequences.

    Half of a query's rollouts (rounded up) are under random disturbances, the others under worst-case ones
    (:mod:`sagemp_cli.execution.disturbances`), all from the library's W.

    Args:
        library: certified references with their tubes and start boxes.
        propose: the planner, ``propose(starts (Q, n)) -> references (Q, K+1, n)``.
        problem: the robot, and the scene to judge the rollouts by, independently of the tubes.
        tracker: the policy that the library was certified with.
        starts: measured starts ``(Q, n)``.
        rollouts: M, rollouts per query.
        generator: randomness of the disturbances.
        progress: reports queries.

    Raises:
        UsageError: a start lies in no certified start box, so nothing is certified from there; or the library is
            empty or ``rollouts`` is not positive.
    """
    if rollouts < 1:
        raise UsageError(f"execute: rollouts must be positive, found {rollouts}")
    boxes = Box(library.start.lower, library.start.upper)
    eligible = boxes.contains(starts[:, None, :])  # (Q, C)
    for q, row in enumerate(eligible):
        if not bool(row.any()):
            raise UsageError(
                f"execute: measured start {starts[q].tolist()} lies in the start box X_I of none of {len(library)} "
                f"certified references; nothing is certified from there"
            )
    sampled = propose(starts)
    index, error = closest_reference(sampled.numpy(), library.references.numpy(), eligible=eligible.numpy())
    chosen = torch.from_numpy(index)

    unknowns = problem.dynamics.unknowns(library.disturbance)
    horizon, calm = library.references.shape[1] - 1, (rollouts + 1) // 2
    parts: list[tuple[Tensor, ...]] = []
    with (progress or Silent()).task("executing", len(starts)) as task:
        for q, i in enumerate(chosen.tolist()):
            loop = ClosedLoop(problem.dynamics, tracker, library.references[i])
            x = starts[q].expand(rollouts, -1)
            w = random_disturbances(unknowns, calm, horizon=horizon, generator=generator)
            if rollouts > calm:
                harm = worst_case_disturbances(loop, x[calm:], disturbance=unknowns, generator=generator)
                w = torch.cat([w, harm])
            with torch.no_grad():
                states, controls = loop.rollout(x, w)
                path = problem.dynamics.path(states, controls, w)
            cells, tubes = library.cells_of(i)
            clear = (problem.scene.signed_distance_along(path[..., list(problem.dynamics.position)]) > 0).all(-1)
            safe = clear & problem.scene.goal.contains(states[:, -1])
            parts.append((torch.full((rollouts,), q), states, controls, w, inside_tube(states, cells, tubes), safe))
            task.advance()
    query, states, controls, disturbances, in_tube, safe = (torch.cat(p) for p in zip(*parts, strict=True))
    return Execution(sampled, chosen, torch.from_numpy(error), query, states, controls, disturbances, in_tube, safe)


def inside_tube(states: Tensor, cells: Box, tubes: Tube, *, margin: float = ROUNDING) -> Tensor:
    """Whether rollouts ``(B, K+1, n)`` stay in the tube of every cell that contains their start, ``(B,)``.

    A start on a face belongs to the cells on both sides. A start in no cell is not inside.

    Args:
        states: rollouts.
        cells: partition of one start box, ``(C, n)``.
        tubes: their tubes, ``(C, K+1, n)``.
        margin: see :data:`ROUNDING`.
    """
    member = cells.contains(states[:, None, 0, :])  # (B, C)
    wide = Tube(tubes.lower - margin, tubes.upper + margin)
    stays = wide.contains(states[:, None])
    return (stays | ~member).all(-1) & member.any(-1)
