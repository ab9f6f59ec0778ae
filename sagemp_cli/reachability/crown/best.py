"""Affine arithmetic and CROWN together: the intersection of both, each sharpening the other's intermediate bounds.

A forward affine pass finds relaxations; a backward sweep over them bounds all states and the inputs of all operations
once more; the next round's relaxations are made for the intersected bounds. All tubes enclose the same rollouts, so
their intersection does; it lies inside those of :class:`~sagemp_cli.reachability.affine.affine.Affine` and
:class:`~sagemp_cli.reachability.crown.crown.Crown`, which are its first round.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled.hints import Hints
from sagemp_cli.reachability.batch import recorded_and_batched
from sagemp_cli.reachability.blocks import in_blocks
from sagemp_cli.reachability.crown.crown import TOGETHER, Crown, cells_at_once, taken_back, taking_back
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import NUMBER, Footprint, Loop, LoopSize, Propagator, Reach
from sagemp_cli.sets import Box, Tube


@dataclass(frozen=True)
class Best(Propagator):
    """Affine arithmetic and CROWN sharpening each other; rigorous, as both are; as many cells at once as by CROWN.

    Attributes:
        rounds: forward and backward passes; where the set is wide, more than two still pay.
        symbols: most generators kept between steps (None: all).
        rows: most rows that go back at once for one cell.
    """

    rounds: int = 2
    symbols: int | None = None
    rows: int = 8192
    name: ClassVar[str] = "best"
    rigorous: ClassVar[bool] = True

    def __post_init__(self) -> None:
        Crown(symbols=self.symbols, rows=self.rows)
        if self.rounds < 1:
            raise ConfigError(f"propagator.rounds must be a positive integer, found {self.rounds}")

    @torch.no_grad()
    def reach(self, loop: Loop, start: Box, disturbance: Box, *, watch: bool = False) -> Reach:
        """See :class:`~sagemp_cli.reachability.propagator.Propagator`; controls and recordings it has none."""
        known, start = recorded_and_batched(loop, start, disturbance)

        def bounded(some: RecordedLoop, cells: Box) -> Reach:
            return self._bounded(some, cells, disturbance)

        return in_blocks(bounded, known, start, at_once=cells_at_once(self, known, start, disturbance))

    def _bounded(self, loop: RecordedLoop, start: Box, disturbance: Box) -> Reach:
        affine = Affine(symbols=self.symbols)
        hints: list[Hints] | None = None
        tubes: list[Tube] = []
        notes: tuple[str, ...] = ()
        for n in range(self.rounds):
            run = affine.run(loop, start, disturbance, keep_steps=True, hints=hints)
            back, found = taken_back(run, start, rows=self.rows, inputs=n + 1 < self.rounds)
            hints = _sharper(hints, found) if hints and found else hints or found
            tubes += [run.tube, back]
            notes = run.notes
        lower, upper = (torch.stack(sides) for sides in zip(*((t.lower, t.upper) for t in tubes), strict=True))
        return Reach(Tube(lower.amax(0), upper.amin(0)), notes=notes)

    def footprint(self, size: LoopSize) -> Footprint:
        """That of CROWN, and the bounds of all operations' inputs."""
        rows = min(self.rows, max(2 * size.steps * size.states, 2 * TOGETHER * size.variables))
        crown = taking_back(self.symbols, rows, size)
        assert crown.working is not None
        return Footprint(crown.working + 4 * NUMBER * size.steps * size.entries, crown.kept)


def _sharper(old: list[Hints], new: list[Hints]) -> list[Hints]:
    """Both rounds' bounds hold."""
    return [[a.intersected(b) for a, b in zip(*step, strict=True)] for step in zip(old, new, strict=True)]
