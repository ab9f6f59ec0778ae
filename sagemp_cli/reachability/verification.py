"""Verification of references: the one path that ``verify`` and ``build-library`` share.

Partition the start box, propagate every cell, judge the union, bound the controls. What is claimed of a SAFE
reference: for every start in X_I and every disturbance sequence in W^K the closed loop stays in the tube, the
tube is in the safe set at every step and in the goal at step K; with rounding included if the propagator is
rigorous, in exact arithmetic otherwise.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.closed_loop import ClosedLoop
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.reachability.partition import partition
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.reachability.verdict import Outcome, Verdict, assess
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box, Tube
from sagemp_cli.trackers.policy import Tracker


@dataclass(frozen=True)
class Verification:
    """R references with their tubes and verdicts.

    Attributes:
        references: ``(R, K+1, n)``.
        start: X_I of each reference, ``(R, n)``.
        disturbance: W, ``(d,)``.
        cells: partition of each start box, ``(R, C, n)``.
        tube: one tube per cell, ``(R, C, K+1, n)``.
        control_lower, control_upper: bounds of the controls over all cells, ``(R, K, m)``; infinite if the
            propagator offers none.
        verdicts: one per reference.
        constraint_names: names along the last dimension of ``clearance``.
        clearance: certified distance to each constraint, ``(R, constraints)``.
        goal_margin: distance of the tube at K from the goal's faces, ``(R, n)``, negative outside.
        seconds: share of the propagation time, ``(R,)``.
        propagator: its name.
        rigorous: whether rounding is included in the tubes.
        recording: the relaxations used, batched ``(R, C)``; None if the propagator keeps none.
    """

    references: Tensor
    start: Box
    disturbance: Box
    cells: Box
    tube: Tube
    control_lower: Tensor
    control_upper: Tensor
    verdicts: tuple[Verdict, ...]
    constraint_names: tuple[str, ...]
    clearance: Tensor
    goal_margin: Tensor
    seconds: Tensor
    propagator: str
    rigorous: bool
    recording: Recording | None = None

    def __len__(self) -> int:
        return self.references.shape[0]

    @property
    def safe(self) -> list[int]:
        """Indices of the certified references."""
        return [r for r, v in enumerate(self.verdicts) if v.outcome is Outcome.SAFE]

    def select(self, indices: Sequence[int]) -> Verification:
        """The same for some of the references, in the given order."""
        i = torch.as_tensor(list(indices), dtype=torch.int64)
        return dataclasses.replace(
            self,
            references=self.references[i],
            start=Box(self.start.lower[i], self.start.upper[i]),
            cells=Box(self.cells.lower[i], self.cells.upper[i]),
            tube=Tube(self.tube.lower[i], self.tube.upper[i]),
            control_lower=self.control_lower[i],
            control_upper=self.control_upper[i],
            verdicts=tuple(self.verdicts[int(r)] for r in i),
            clearance=self.clearance[i],
            goal_margin=self.goal_margin[i],
            seconds=self.seconds[i],
            recording=None if self.recording is None else self.recording.select(i),
        )

    @staticmethod
    def join(parts: Sequence[Verification]) -> Verification:
        """Verifications of the same loop, sets and partition counts as one."""
        first = parts[0]

        def cat(values: list[Tensor]) -> Tensor:
            return torch.cat(values, dim=0)

        return dataclasses.replace(
            first,
            references=cat([p.references for p in parts]),
            start=Box(cat([p.start.lower for p in parts]), cat([p.start.upper for p in parts])),
            cells=Box(cat([p.cells.lower for p in parts]), cat([p.cells.upper for p in parts])),
            tube=Tube(cat([p.tube.lower for p in parts]), cat([p.tube.upper for p in parts])),
            control_lower=cat([p.control_lower for p in parts]),
            control_upper=cat([p.control_upper for p in parts]),
            verdicts=tuple(v for p in parts for v in p.verdicts),
            clearance=cat([p.clearance for p in parts]),
            goal_margin=cat([p.goal_margin for p in parts]),
            seconds=cat([p.seconds for p in parts]),
            recording=Recording.join([p.recording for p in parts]),
        )


def require_finite(references: Tensor, state_names: Sequence[str]) -> None:
    """Raise a :class:`NonFiniteError` naming reference, step and state if a reference has a NaN or an infinity."""
    bad = torch.nonzero(~torch.isfinite(references))
    if len(bad):
        r, k, i = bad[0].tolist()
        value = float(references[r, k, i])
        raise NonFiniteError(
            f"reference {r} is {value} at step {k} in state '{state_names[i]}'; references must be finite numbers"
        )


def verify_references(
    propagator: Propagator,
    dynamics: Dynamics,
    *,
    tracker: Tracker,
    scene: Scene,
    references: Tensor,
    start: Box,
    disturbance: Box,
    counts: Sequence[int],
    cells_at_once: int = 128,
    progress: Progress | None = None,
) -> Verification:
    """Tubes and verdicts of references under one tracker.

    Args:
        propagator: bounds the loop.
        dynamics: the robot.
        tracker: the policy.
        scene: safe set and goal.
        references: ``(R, K+1, n)``, taken as exact numbers.
        start: X_I, one box ``(n,)`` for all or one each ``(R, n)``.
        disturbance: W, ``(d,)``.
        counts: cells per uncertain start dimension, see :func:`~sagemp_cli.reachability.partition.partition`.
        cells_at_once: cells in one call of the propagator, which bounds its memory.
        progress: reports cells.

    Raises:
        NonFiniteError: a reference contains NaN or infinity.
        UsageError: shapes that do not fit.
    """
    n = dynamics.state_dim
    if references.dim() != 3 or references.shape[-1] != n:
        raise UsageError(f"references must have shape (count, K+1, {n}), found {tuple(references.shape)}")
    require_finite(references, dynamics.state_names)
    count = references.shape[0]
    references = references.to(torch.float64)
    start = Box(start.lower.expand(count, n), start.upper.expand(count, n))
    cells = partition(start, counts)
    per_reference = cells.lower.shape[1]
    owner = torch.arange(count).repeat_interleave(per_reference)
    flat_lower, flat_upper = cells.lower.reshape(-1, n), cells.upper.reshape(-1, n)

    parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    recordings: list[Recording | None] = []
    seconds = torch.zeros(count, dtype=torch.float64)
    with (progress or Silent()).task("propagating cells", len(owner)) as task, torch.no_grad():
        for begin in range(0, len(owner), cells_at_once):
            some = slice(begin, begin + cells_at_once)
            began = time.perf_counter()
            *bounds, recording = _bound(
                propagator,
                ClosedLoop(dynamics, tracker, references[owner[some]]),
                Box(flat_lower[some], flat_upper[some]),
                disturbance,
            )
            parts.append(tuple(bounds))
            recordings.append(recording)
            share = (time.perf_counter() - began) / len(owner[some])
            seconds += share * torch.bincount(owner[some], minlength=count)
            task.advance(len(owner[some]))
    lower, upper, u_lower, u_upper = (
        torch.cat(p).unflatten(0, (count, per_reference)) for p in zip(*parts, strict=True)
    )
    recording = Recording.join(recordings) if recordings else None
    tube = Tube(lower, upper)
    assessment = assess(tube, scene, position=dynamics.position, state_names=dynamics.state_names)
    return Verification(
        references=references,
        start=start,
        disturbance=disturbance,
        cells=cells,
        tube=tube,
        control_lower=u_lower.amin(1),
        control_upper=u_upper.amax(1),
        verdicts=assessment.verdicts,
        constraint_names=scene.constraint_names,
        clearance=assessment.clearance,
        goal_margin=assessment.goal_margin,
        seconds=seconds,
        propagator=propagator.name,
        rigorous=propagator.rigorous,
        recording=None if recording is None else recording.unflatten((count, per_reference)),
    )


def _bound(
    propagator: Propagator, loop: ClosedLoop, start: Box, disturbance: Box
) -> tuple[Tensor, Tensor, Tensor, Tensor, Recording | None]:
    """Bounds of states ``(B, K+1, n)`` and controls ``(B, K, m)``, and the relaxations if the propagator keeps them."""
    prove = getattr(propagator, "prove", None)
    if prove is not None:
        tube, u_lower, u_upper, recording = prove(loop, start, disturbance)
        return tube.lower, tube.upper, u_lower, u_upper, recording
    with_controls = getattr(propagator, "propagate_with_controls", None)
    if with_controls is not None:
        tube, u_lower, u_upper = with_controls(loop, start, disturbance)
        return tube.lower, tube.upper, u_lower, u_upper, None
    tube = propagator.propagate(loop, start, disturbance)
    unknown = torch.full((*tube.lower.shape[:-2], loop.horizon, loop.dynamics.control_dim), torch.inf)
    return tube.lower, tube.upper, -unknown.double(), unknown.double(), None
