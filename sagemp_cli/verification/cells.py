"""Cells to prove, in chunks that can be proved anywhere, and what was proved of them.

A chunk is proved by itself: its tubes depend on its own cells and references and on the prover, not on who proves it
or when. So executors may share chunks out, and finished ones may be kept and read again. (They do depend, in the last
bits, on which cells are together in a chunk.)
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import SampledLoop, sampled
from sagemp_cli.reachability.flow import AskedDivision, Flow
from sagemp_cli.reachability.foreseeing import reach_foreseeing
from sagemp_cli.reachability.program.loops import RecordedLoop, recorded
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets import Between, Box, Tube
from sagemp_cli.verification.cutting import best_cut
from sagemp_cli.verification.deviation import ComparedLoop
from sagemp_cli.verification.verdict import shortfall
from sagemp_cli.workers import one_thread


@dataclass(frozen=True)
class Chunk:
    """Cells that are propagated in one call.

    Attributes:
        index: number of the chunk in its run.
        cell_reference: which reference each cell belongs to, ``(B,)``.
        references: that reference, ``(B, K+1, n)``.
        cells: ``(B, n)``.
        substeps: in continuous time, parts of a period; None: as the prover says.
    """

    index: int
    cell_reference: Tensor
    references: Tensor
    cells: Box
    substeps: int | None = None

    def __len__(self) -> int:
        return len(self.cell_reference)

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it but the index as arrays by name, to send it elsewhere."""
        found = {
            "cell_reference": self.cell_reference,
            "references": self.references,
            "lower": self.cells.lower,
            "upper": self.cells.upper,
        }
        if self.substeps is not None:
            found["substeps"] = torch.tensor(self.substeps)
        return {name: tensor.numpy() for name, tensor in found.items()}

    @classmethod
    def of(cls, index: int, arrays: Mapping[str, np.ndarray]) -> Chunk:
        """Back from :meth:`arrays`."""
        owner, references, lower, upper = (
            torch.from_numpy(arrays[name].copy()) for name in ("cell_reference", "references", "lower", "upper")
        )
        substeps = int(arrays["substeps"]) if "substeps" in arrays else None
        return cls(index, owner, references, Box(lower, upper), substeps)


@dataclass(frozen=True)
class CellTubes:
    """What was proved of C cells.

    Attributes:
        cell_reference: which reference each belongs to, ``(C,)``.
        cells: ``(C, n)``.
        tube: ``(C, K+1, n)``.
        control_lower, control_upper: bounds of the controls, ``(C, K, m)``; infinite if the propagator offers none.
        seconds: share of the propagation time, ``(C,)``.
        recording: the relaxations used, batched ``(C,)``; None if the propagator keeps none.
        notes: of the propagator.
        flow: in continuous time, what was proved between the instants.
        cut: in which state halving each would leave least missing, ``(C,)``; None unless asked for.
    """

    cell_reference: Tensor
    cells: Box
    tube: Tube
    control_lower: Tensor
    control_upper: Tensor
    seconds: Tensor
    recording: Recording | None
    notes: tuple[str, ...] = ()
    flow: Flow | None = None
    cut: Tensor | None = None

    def __len__(self) -> int:
        return len(self.cell_reference)

    def select(self, index: Tensor) -> CellTubes:
        """The same for some of the cells, in the given order."""
        return CellTubes(
            self.cell_reference[index],
            Box(self.cells.lower[index], self.cells.upper[index]),
            Tube(self.tube.lower[index], self.tube.upper[index]),
            self.control_lower[index],
            self.control_upper[index],
            self.seconds[index],
            None if self.recording is None else self.recording.select(index),
            self.notes,
            None if self.flow is None else self.flow.select(index),
            None if self.cut is None else self.cut[index],
        )

    @staticmethod
    def join(parts: Sequence[CellTubes]) -> CellTubes:
        """All cells, one part after the other."""
        recordings = [p.recording for p in parts]
        cuts = [p.cut for p in parts if p.cut is not None]
        if len(parts) == 1:
            return parts[0]
        return CellTubes(
            torch.cat([p.cell_reference for p in parts]),
            Box(torch.cat([p.cells.lower for p in parts]), torch.cat([p.cells.upper for p in parts])),
            Tube(torch.cat([p.tube.lower for p in parts]), torch.cat([p.tube.upper for p in parts])),
            torch.cat([p.control_lower for p in parts]),
            torch.cat([p.control_upper for p in parts]),
            torch.cat([p.seconds for p in parts]),
            Recording.join(recordings),
            tuple(dict.fromkeys(note for p in parts for note in p.notes)),
            Flow.join([p.flow for p in parts]),
            torch.cat(cuts) if len(cuts) == len(parts) else None,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it as arrays by name, without pickles: what is sent between processes and kept on disk."""
        found = {
            "cell_reference": self.cell_reference,
            "cell_lower": self.cells.lower,
            "cell_upper": self.cells.upper,
            "tube_lower": self.tube.lower,
            "tube_upper": self.tube.upper,
            "control_lower": self.control_lower,
            "control_upper": self.control_upper,
            "seconds": self.seconds,
        }
        if self.cut is not None:
            found["cut"] = self.cut
        if self.recording is not None:
            r = self.recording
            found |= {"slope": r.slope, "offset": r.offset, "radius": r.radius}
            found |= {} if r.kept is None else {"kept": r.kept}
        if self.flow is not None:
            found |= {f"flow_{name}": side for name, side in self.flow.arrays().items()}
        arrays = {name: tensor.detach().numpy() for name, tensor in found.items()}
        if self.recording is not None:
            arrays["operations"] = np.array(self.recording.operations, dtype=np.str_)
            arrays["widths"] = np.array(self.recording.widths, dtype=np.int64)
        if self.notes:
            arrays["notes"] = np.array(self.notes, dtype=np.str_)
        return arrays

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> CellTubes:
        """Back from :meth:`arrays`.

        Raises:
            KeyError: an array is missing.
        """
        found = {name: torch.from_numpy(a) for name, a in arrays.items() if a.dtype.kind != "U"}
        recording = None
        if "operations" in arrays:
            recording = Recording(
                tuple(str(name) for name in arrays["operations"]),
                tuple(found["widths"].tolist()),
                found["slope"],
                found["offset"],
                found["radius"],
                found.get("kept"),
            )
        return cls(
            found["cell_reference"],
            Box(found["cell_lower"], found["cell_upper"]),
            Tube(found["tube_lower"], found["tube_upper"]),
            found["control_lower"],
            found["control_upper"],
            found["seconds"],
            recording,
            tuple(str(note) for note in arrays.get("notes", ())),
            Flow.of({name.removeprefix("flow_"): side for name, side in found.items()})
            if "flow_lower" in found
            else None,
            found.get("cut"),
        )


@dataclass(frozen=True)
class CellProver:
    """What all chunks of a run have in common.

    Attributes:
        propagator: bounds the loop.
        problem: what is proved.
        tracker: the policy, which stays as it is once something is proved of it.
        compared: whether the loop is that of the analytical model of a learned robot, by way of the robot:
            :class:`~sagemp_cli.verification.deviation.ComparedLoop`.
        division: in continuous time, how the periods are to be divided.
        foresee: whether to say of every cell in which state it is best halved.
    """

    propagator: Propagator
    problem: Problem
    tracker: Controller
    compared: bool = False
    division: AskedDivision = AskedDivision()
    foresee: bool = False

    def loop(self, references: Tensor) -> ClosedLoop:
        """What is bounded, on references ``(..., K+1, n)``."""
        return loop_of(self.problem, self.tracker, references, compared=self.compared)

    @functools.cached_property
    def _programs(self) -> tuple[Program, ...]:
        # Recorded once: a chunk has other numbers and no other step. It goes along to other processes if it is there.
        return step_of(self.problem, self.tracker, compared=self.compared)

    @functools.cached_property
    def _sampled(self) -> SampledLoop:
        return sampled_of(self.problem, self.tracker)

    def prove(self, chunk: Chunk) -> CellTubes:
        """Bound states and controls of every cell, with one thread wherever it runs."""
        loop = self.loop(chunk.references)
        began = time.perf_counter()
        with torch.no_grad(), one_thread():
            found = self._reach(loop, chunk)
            u_lower, u_upper = found.control_lower, found.control_upper
            if u_lower is None or u_upper is None:
                shape = (len(chunk), loop.horizon, loop.dynamics.control_dim)
                u_upper = torch.full(shape, torch.inf, dtype=torch.float64)
                u_lower = -u_upper
            least, most = self.tracker.control_range()
            more = (0, u_lower.shape[-1] - len(least))  # columns of a deviation, which may follow
            u_lower = torch.maximum(u_lower, torch.nn.functional.pad(least, more, value=-torch.inf))
            u_upper = torch.minimum(u_upper, torch.nn.functional.pad(most, more, value=torch.inf))
        share = (time.perf_counter() - began) / len(chunk)
        seconds = torch.full((len(chunk),), share, dtype=torch.float64)
        return CellTubes(
            chunk.cell_reference,
            chunk.cells,
            found.tube,
            u_lower,
            u_upper,
            seconds,
            found.recording,
            found.notes,
            found.flow,
            self._cut(chunk.cells, found),
        )

    def _cut(self, cells: Box, found: Reach) -> Tensor | None:
        if found.halves is None:
            return None
        scene, position = self.problem.scene, self.problem.dynamics.position

        def missing(tube: Tube) -> Tensor:
            between = Between.SEGMENTS if self.problem.between is Between.CONTINUOUS else self.problem.between
            return shortfall(tube, scene, position=position, between=between)[1]

        return best_cut(cells, found.tube, found.halves, missing)

    def _reach(self, loop: ClosedLoop, chunk: Chunk) -> Reach:
        numbers, w = loop.numbers().to(torch.float64), self.problem.disturbance
        if not loop.continuous:
            known = RecordedLoop(self._programs, numbers, loop.horizon)
            reach = reach_foreseeing if self.foresee else type(self.propagator).reach
            return reach(self.propagator, known, chunk.cells, w, watch=True)
        if self.compared:
            raise UsageError(
                "what is proved about a learned robot's analytical model by way of the network is in discrete time"
            )
        known = dataclasses.replace(self._sampled, numbers=numbers, horizon=loop.horizon)
        substeps = chunk.substeps or self.division.substeps
        return reach_continuously(
            self.propagator,
            known,
            chunk.cells,
            w,
            substeps=substeps,
            order=self.division.order,
            foresee=self.foresee,
        )


def loop_of(problem: Problem, tracker: Controller, references: Tensor, *, compared: bool = False) -> ClosedLoop:
    """The loop of a problem under a tracker; see :class:`CellProver`."""
    return (ComparedLoop if compared else ClosedLoop)(problem.dynamics, tracker, references)


@torch.no_grad()
def sampled_of(problem: Problem, tracker: Controller) -> SampledLoop:
    """The ODE and the control of :func:`loop_of` in continuous time as programs, the same whatever the references."""
    any_reference = torch.zeros(problem.horizon + 1, problem.dynamics.state_dim, dtype=torch.float64)
    return sampled(loop_of(problem, tracker, any_reference), problem.start)


@torch.no_grad()
def step_of(problem: Problem, tracker: Controller, *, compared: bool = False) -> tuple[Program, ...]:
    """The step of :func:`loop_of` as programs, the same whatever the references."""
    any_reference = torch.zeros(problem.horizon + 1, problem.dynamics.state_dim, dtype=torch.float64)
    loop = loop_of(problem, tracker, any_reference, compared=compared)
    return recorded(loop, problem.start, problem.disturbance).programs


class Run(Protocol):
    """Proves chunks and hands each over, with its index, as soon as it is finished."""

    def __call__(self, chunks: Sequence[Chunk]) -> Iterator[tuple[int, CellTubes]]:
        """In any order."""
        ...


class Pieces(Protocol):
    """Where finished chunks are kept, so that an interrupted run resumes."""

    @property
    def finished(self) -> Collection[int]:
        """Indices of the chunks that are there."""
        ...

    def load(self, index: int) -> Mapping[str, np.ndarray]:
        """What :meth:`save` was given."""
        ...

    def save(self, index: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a finished chunk."""
