"""Verification of references: the one path that ``verify`` and ``build-library`` share.

Partition the start box, propagate every cell, judge the union, bound the controls. What is claimed of a SAFE
reference: for every start in X_I and every disturbance sequence in W^K the closed loop stays in the tube, it is in the
safe set over the whole of every step and in the goal at step K; with rounding included if the propagator is rigorous,
in exact arithmetic otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.reachability.flow import Flow
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets import Between, Box, Bulge, Tube
from sagemp_cli.sets.partition import partition, uncertain_dimensions
from sagemp_cli.verification.adaptive import adaptive_cells
from sagemp_cli.verification.cells import CellProver, CellTubes, Chunk, Pieces, Run
from sagemp_cli.verification.executors import Executor, Serial
from sagemp_cli.verification.verdict import Outcome, Verdict, assess, shortfall


@dataclass(frozen=True)
class Verification:
    """R references with their tubes and verdicts. The cells of all references are one list of C.

    Attributes:
        references: ``(R, K+1, n)``.
        start: X_I of each reference, ``(R, n)``.
        disturbance: W, ``(d,)``.
        cell_reference: which reference each cell belongs to, ``(C,)``; not all need to have equally many.
        cells: partitions of the start boxes, ``(C, n)``.
        tube: one tube per cell, ``(C, K+1, n)``.
        control_lower, control_upper: bounds of the controls over all cells, ``(R, K, m)``; infinite if the
            propagator offers none.
        verdicts: one per reference.
        constraint_names: names along the last dimension of ``clearance``.
        clearance: certified distance to each constraint, ``(R, constraints)``.
        goal_margin: distance of the tube at K from the goal's faces, ``(R, n)``, negative outside.
        seconds: share of the propagation time, trials of an adaptive partition included, ``(R,)``.
        propagator: its name.
        rigorous: whether rounding is included in the tubes.
        recording: the relaxations used, batched ``(C,)``; None if the propagator keeps none.
        notes: of the propagator, one line each.
        between: what the verdicts say of the time between two samples.
        flow: in continuous time, what was proved between the instants.
    """

    references: Tensor
    start: Box
    disturbance: Box
    cell_reference: Tensor
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
    notes: tuple[str, ...] = ()
    between: Between = Between.SEGMENTS
    flow: Flow | None = None

    def __len__(self) -> int:
        return self.references.shape[0]

    @property
    def safe(self) -> list[int]:
        """Indices of the certified references."""
        return [r for r, v in enumerate(self.verdicts) if v.outcome is Outcome.SAFE]

    def cells_of(self, reference: int) -> tuple[Box, Tube]:
        """The cells of one reference ``(c, n)`` and their tubes ``(c, K+1, n)``."""
        own = self.cell_reference == reference
        return Box(self.cells.lower[own], self.cells.upper[own]), Tube(self.tube.lower[own], self.tube.upper[own])

    def select(self, indices: Sequence[int]) -> Verification:
        """The same for some of the references, in the given order."""
        i = torch.as_tensor(list(indices), dtype=torch.int64)
        own = [torch.nonzero(self.cell_reference == r).flatten() for r in i]
        cells = torch.cat([torch.zeros(0, dtype=torch.int64), *own])
        sizes = torch.tensor([len(c) for c in own], dtype=torch.int64)
        return dataclasses.replace(
            self,
            references=self.references[i],
            start=Box(self.start.lower[i], self.start.upper[i]),
            cell_reference=torch.arange(len(i)).repeat_interleave(sizes),
            cells=Box(self.cells.lower[cells], self.cells.upper[cells]),
            tube=Tube(self.tube.lower[cells], self.tube.upper[cells]),
            control_lower=self.control_lower[i],
            control_upper=self.control_upper[i],
            verdicts=tuple(self.verdicts[int(r)] for r in i),
            clearance=self.clearance[i],
            goal_margin=self.goal_margin[i],
            seconds=self.seconds[i],
            recording=None if self.recording is None else self.recording.select(cells),
            flow=None if self.flow is None else self.flow.select(cells),
        )

    @staticmethod
    def join(parts: Sequence[Verification]) -> Verification:
        """Verifications of the same loop and sets as one."""
        first = parts[0]
        offsets = [sum(len(p) for p in parts[:i]) for i in range(len(parts))]

        def cat(values: list[Tensor]) -> Tensor:
            return torch.cat(values, dim=0)

        return dataclasses.replace(
            first,
            references=cat([p.references for p in parts]),
            start=Box(cat([p.start.lower for p in parts]), cat([p.start.upper for p in parts])),
            cell_reference=cat([p.cell_reference + offset for p, offset in zip(parts, offsets, strict=True)]),
            cells=Box(cat([p.cells.lower for p in parts]), cat([p.cells.upper for p in parts])),
            tube=Tube(cat([p.tube.lower for p in parts]), cat([p.tube.upper for p in parts])),
            control_lower=cat([p.control_lower for p in parts]),
            control_upper=cat([p.control_upper for p in parts]),
            verdicts=tuple(v for p in parts for v in p.verdicts),
            clearance=cat([p.clearance for p in parts]),
            goal_margin=cat([p.goal_margin for p in parts]),
            seconds=cat([p.seconds for p in parts]),
            recording=Recording.join([p.recording for p in parts]),
            flow=Flow.join([p.flow for p in parts]),
            notes=tuple(dict.fromkeys(note for p in parts for note in p.notes)),
        )


def require_references(references: Tensor, dynamics: Dynamics) -> None:
    """Raise unless references are ``(R, K+1, n)`` with R >= 1 and finite.

    Raises:
        UsageError: another shape.
        NonFiniteError: a NaN or an infinity.
    """
    n = dynamics.state_dim
    if references.dim() != 3 or references.shape[-1] != n or references.shape[1] < 2 or not len(references):
        raise UsageError(f"references must have shape (count, K+1, {n}), found {tuple(references.shape)}")
    require_finite(references, dynamics.state_names)


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
    prover: CellProver,
    references: Tensor,
    *,
    counts: Sequence[int] | None,
    budget: int = 1,
    cells_at_once: int = 128,
    executor: Executor | None = None,
    pieces: Pieces | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Tubes and verdicts of references under one tracker.

    Args:
        prover: problem, tracker and propagator; X_I is one box ``(n,)`` for all references or one each ``(R, n)``.
        references: ``(R, K+1, n)``, taken as exact numbers.
        counts: cells per uncertain start dimension, see :func:`~sagemp_cli.sets.partition.partition`; None for
            an adaptive partition, see :mod:`sagemp_cli.verification.adaptive`.
        budget: cells of one reference at most, in an adaptive partition.
        cells_at_once: cells in one call of the propagator, which bounds its memory. What it costs nothing to box is
            looked for in all cells of a call together, so that tubes hang on this, by no more than that costs.
        executor: where the calls are made; here by default. The result does not depend on it.
        pieces: finished calls of an earlier, interrupted run of exactly these arguments; new ones are added.
        progress: reports cells.

    Raises:
        NonFiniteError: a reference contains NaN or infinity.
        UsageError: shapes that do not fit, or no references.
    """
    problem, propagator = prover.problem, prover.propagator
    dynamics, scene = problem.dynamics, problem.scene
    require_references(references, dynamics)
    count, n = references.shape[0], dynamics.state_dim
    references = references.to(torch.float64)
    start = Box(problem.start.lower.expand(count, n), problem.start.upper.expand(count, n))
    prover = dataclasses.replace(prover, foresee=counts is None)
    with (executor or Serial()).opened(prover) as run:
        work = _Work(run, references, cells_at_once, pieces, progress or Silent())
        if counts is None:
            found = adaptive_cells(
                work,
                start,
                budget=budget,
                shortfall=lambda found: shortfall(
                    found.tube,
                    scene,
                    position=dynamics.position,
                    between=problem.between,
                    lines=_lines(found, problem),
                ),
                hopeless=lambda owner, cells: _breaks(prover, references[owner], cells),
            )
        else:
            cells = partition(start, counts)
            owner = torch.arange(count).repeat_interleave(cells.lower.shape[1])
            found = work(owner, Box(cells.lower.reshape(-1, n), cells.upper.reshape(-1, n)))
    assessment = assess(
        found.tube,
        scene,
        cell_reference=found.cell_reference,
        position=dynamics.position,
        state_names=dynamics.state_names,
        between=problem.between,
        lines=_lines(found, problem),
    )
    mine = [found.cell_reference == r for r in range(count)]
    return Verification(
        references=references,
        start=start,
        disturbance=problem.disturbance,
        cell_reference=found.cell_reference,
        cells=found.cells,
        tube=found.tube,
        control_lower=torch.stack([found.control_lower[own].amin(0) for own in mine]),
        control_upper=torch.stack([found.control_upper[own].amax(0) for own in mine]),
        verdicts=assessment.verdicts,
        constraint_names=scene.constraint_names,
        clearance=assessment.clearance,
        goal_margin=assessment.goal_margin,
        seconds=work.seconds,
        propagator=propagator.name,
        rigorous=propagator.rigorous,
        recording=found.recording,
        notes=found.notes,
        between=problem.between,
        flow=found.flow,
    )


def _lines(found: CellTubes, problem: Problem) -> tuple[Tube, Bulge] | None:
    """In continuous time, boxes and bulges between which the states are."""
    flow = found.flow
    return None if flow is None else flow.lines(found.tube, problem.disturbance, problem.dynamics.dt)


class _Work:
    """Proves cells in chunks that are numbered over the whole run, and takes finished ones from where they are kept."""

    def __init__(
        self, run: Run, references: Tensor, cells_at_once: int, pieces: Pieces | None, progress: Progress
    ) -> None:
        self.run, self.references, self.cells_at_once = run, references, cells_at_once
        self.pieces, self.progress, self.chunks = pieces, progress, 0
        self.seconds = torch.zeros(len(references), dtype=torch.float64)
        self.substeps: int | None = None

    def __call__(self, owner: Tensor, cells: Box) -> CellTubes:
        """The tubes of cells ``(B, n)`` of references ``(B,)``, in their order."""
        chunks = [
            Chunk(0, own, self.references[own], Box(lower, upper), self.substeps)
            for own, lower, upper in zip(
                *(x.split(self.cells_at_once) for x in (owner, cells.lower, cells.upper)), strict=True
            )
        ]
        found = self._proved(chunks, len(owner))
        flows = [tubes.flow for tubes in found if tubes.flow is not None]
        if flows:  # one division for all, as fine as any chunk needs
            self.substeps = max(flow.division.substeps for flow in flows)
            coarse = [i for i, flow in enumerate(flows) if flow.division.substeps < self.substeps]
            again = [dataclasses.replace(chunks[i], substeps=self.substeps) for i in coarse]
            for i, tubes in zip(coarse, self._proved(again, sum(map(len, again))), strict=True):
                found[i] = tubes
        joined = CellTubes.join(found)
        self.seconds.index_add_(0, joined.cell_reference, joined.seconds)
        return joined

    def _proved(self, chunks: Sequence[Chunk], cells: int) -> list[CellTubes]:
        """The tubes of chunks, numbered here."""
        chunks = [dataclasses.replace(chunk, index=self.chunks + i) for i, chunk in enumerate(chunks)]
        self.chunks += len(chunks)
        kept = set() if self.pieces is None else set(self.pieces.finished)
        found = {c.index: CellTubes.of(self.pieces.load(c.index)) for c in chunks if self.pieces and c.index in kept}
        done = sum(map(len, found.values()))
        with self.progress.task("propagating cells", cells, done) as task:
            for index, tubes in self.run([c for c in chunks if c.index not in found]):
                if self.pieces is not None:
                    self.pieces.save(index, tubes.arrays())
                found[index] = tubes
                task.advance(len(tubes))
        return [found[c.index] for c in chunks]


def _breaks(prover: CellProver, references: Tensor, cells: Box) -> Tensor:
    """Whether a rollout from the centre or a vertex of each cell leaves the safe set or misses the goal, ``(B,)``.

    Simulated under the middle disturbance. It is no proof (rounding), and only decides whether to go on splitting.
    """
    x = torch.stack([cells.center, *_vertices(cells)])
    problem = prover.problem
    loop = prover.loop(references)
    w = problem.unknowns.center.expand(*x.shape[:-1], loop.horizon, -1)
    with torch.no_grad():
        states, controls = loop.rollout(x, w)
        path = problem.dynamics.path(states, controls, w)
    clear = problem.scene.signed_distance_along(path[..., list(problem.dynamics.position)]) > 0
    return (~(clear.all(-1) & problem.scene.goal.contains(states[..., -1, :]))).any(0)


def _vertices(cells: Box) -> list[Tensor]:
    """Vertices ``(B, n)`` of cells; where they are uncertain in many dimensions, those of the first four."""
    vertices = [cells.lower]
    for i in uncertain_dimensions(cells)[:4]:
        side = torch.arange(cells.dim) == i
        vertices += [torch.where(side, cells.upper, vertex) for vertex in vertices]
    return vertices
