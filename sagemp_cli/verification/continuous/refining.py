"""Cells of an ODE bounded and judged, and tried again where their proof fails.

Where the remainders of the Taylor polynomials are a noticeable share of the tube, more parts a period are taken; else
the cells are halved, each in the state whose halves are foreseen to miss least together. Where a tube explodes before
the end, what its first periods say decides both (:meth:`Refinement.narrowed`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.division import (
    ENOUGH,
    FINE,
    finer,
    periods_lost,
    remainder_share,
)
from sagemp_cli.reachability.continuous.observed import ObservedOde
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.continuous.trial import TRIED, suggested
from sagemp_cli.reachability.flow import Division, Flow
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets import Box, Tube
from sagemp_cli.sets.partition import halved
from sagemp_cli.verification.continuous.judging import Asked, Judgement, foreseen_missing, judged
from sagemp_cli.verification.cutting import best_cut, cut_gains

_PATIENCE = 3
"""Halvings in a row that may be in vain, before the rest is given up."""

_GAIN = 0.02
"""A halving is in vain if what is missing falls by less than this share of it."""

_WORTH = 0.05
"""Of cells whose tubes explode: by how much, as the mean of logarithms, a change must narrow the tube of the first
periods for the next one to be made before they are bounded again."""

SYMBOLS = 100
"""Generators that are kept for each state, where nobody says how many."""


@dataclass(frozen=True)
class Piece:
    """Some cells that were bounded in one call.

    Attributes:
        cells: ``(C, n)``.
        reach: of them.
        judgement: what that proves.
    """

    cells: Box
    reach: Reach
    judgement: Judgement

    @property
    def bounded(self) -> bool:
        """Whether all of its tubes are, up to the end."""
        return bool(self.reach.tube.bounded.all())

    def of(self, index: Tensor) -> Piece:
        """The same for some of the cells."""
        r, j = self.reach, self.judgement
        assert r.flow is not None
        controls = [None if side is None else side[index] for side in (r.control_lower, r.control_upper)]
        return Piece(
            Box(self.cells.lower[index], self.cells.upper[index]),
            replace(
                r,
                tube=Tube(r.tube.lower[index], r.tube.upper[index]),
                control_lower=controls[0],
                control_upper=controls[1],
                recording=None if r.recording is None else r.recording.select(index),
                flow=r.flow.select(index),
                halves=None if r.halves is None else r.halves.select(index),
            ),
            Judgement(j.margin[index], j.time[index], j.holds[index], j.missing[index]),
        )


class Refinement:
    """Bounds and judges cells."""

    def __init__(
        self,
        seen: ObservedOde,
        propagator: Propagator,
        asked: Sequence[Asked],
        at_once: int,
        substeps: int | None,
        order: int | None,
    ) -> None:
        if isinstance(propagator, Affine) and propagator.symbols is None:
            propagator = replace(propagator, symbols=SYMBOLS * seen.loop.state_dim)
        self.loop, self.w, self.propagator, self.asked, self.at_once = (
            seen.loop,
            seen.disturbance,
            propagator,
            asked,
            at_once,
        )
        self.given = {"substeps": substeps, "order": order}

    def proved(self, cells: Box, budget: int) -> list[Piece]:
        """Pieces that cover the cells, halved up to a budget where their proof fails."""
        division = suggested(self.propagator, self.loop, cells, self.w, **self.given)
        done: list[Piece] = []
        piece, vain, refines = self.piece(cells, division), 0, True
        while True:
            open_ones = ~piece.judgement.holds.all(1)
            done.append(piece.of(torch.nonzero(~open_ones)[:, 0]))
            piece = piece.of(torch.nonzero(open_ones)[:, 0])
            count = len(piece.cells.lower)
            if not count:
                break
            room = budget - sum(len(p.cells.lower) for p in done)
            if not piece.bounded and 2 * count <= room:
                cells, better = self.narrowed(piece, division, room)
                if better != division or len(cells.lower) > count:
                    piece, division, refines = self.piece(cells, better), better, True
                    continue
            more = finer(division, **self.given) if refines and self.coarse(piece) else None
            if more is not None:
                again = self.piece(piece.cells, more)
                refines = float(again.judgement.missing.sum()) < (1 - _GAIN) * float(piece.judgement.missing.sum())
                if refines:
                    piece, division = again, more
                    continue
            if 2 * count > room or vain >= _PATIENCE:
                break
            before = float(piece.judgement.missing.sum())
            halves = self.halved(piece, division)
            if halves is None:
                break
            piece = halves
            vain = vain + 1 if float(piece.judgement.missing.sum()) > 2 * (1 - _GAIN) * before else 0
        return [p for p in (*done, piece) if len(p.cells.lower)]

    def narrowed(self, piece: Piece, division: Division, most: int) -> tuple[Box, Division]:
        """Cells whose tubes explode, halved, each in the state in which that is foreseen to narrow the tube of the
        first periods most, or their periods divided finer, if that does more; as long as it does a good deal. What
        makes a tube explode is there from the beginning.
        """
        first, cells = self.loop.beginning(min(TRIED, self.loop.horizon)), piece.cells
        share, more = float(remainder_share(piece.reach).mean()), finer(division, **self.given)
        reach, halvings = _first(piece.reach, first.horizon), 0
        most_halvings = 1 + round(2 * periods_lost(piece.reach) / self.loop.horizon)
        while halvings < most_halvings and 2 * len(cells.lower) <= most:
            assert reach.halves is not None
            gains, states = cut_gains(cells, reach.tube, reach.halves).max(1)
            gain = float(gains.mean())
            # Remainders add up: a finer division would gain what they are on average over these periods.
            if more is not None and (share * (first.horizon + 1) / 2 > gain or not bool(reach.tube.bounded.all())):
                again = self.reach(first, cells, more)
                if float((_log_widths(reach.tube) - _log_widths(again.tube)).mean()) > max(gain, _WORTH):
                    reach, division, more = again, more, None
                    continue
            if not gain > (_WORTH if halvings else 0.0):
                break
            cells, halvings, more = halved(cells, states), halvings + 1, None
            if halvings < most_halvings:
                reach = self.reach(first, cells, division)
        return cells, division

    def coarse(self, piece: Piece) -> bool:
        """Whether more parts would help: a tube that explodes does so for other reasons if remainders are small."""
        return bool((remainder_share(piece.reach) > (FINE if piece.bounded else ENOUGH)).any())

    def piece(self, cells: Box, division: Division) -> Piece:
        """Cells bounded and judged."""
        reach = self.reach(self.loop, cells, division)
        return Piece(cells, reach, judged(reach, self.asked, self.loop, self.w))

    def reach(self, loop: SampledLoop, cells: Box, division: Division) -> Reach:
        """Cells bounded, all periods or the first ones, and what halving them would do, which costs next to nothing."""
        return _joined(
            [
                reach_continuously(
                    self.propagator,
                    loop,
                    Box(low, high),
                    self.w,
                    substeps=division.substeps,
                    order=division.order,
                    foresee=True,
                )
                for low, high in zip(cells.lower.split(self.at_once), cells.upper.split(self.at_once), strict=True)
            ]
        )

    def halved(self, piece: Piece, division: Division) -> Piece | None:
        """The halves of all cells, each in the state whose halves are foreseen to miss least; None if one cannot be."""
        reach = piece.reach
        assert reach.halves is not None

        def missing(tube: Tube) -> Tensor:
            return foreseen_missing(tube, self.asked, self.loop)

        cut = best_cut(piece.cells, reach.tube, reach.halves, missing)
        return None if bool((cut < 0).any()) else self.piece(halved(piece.cells, cut), division)


def _first(reach: Reach, periods: int) -> Reach:
    """The tubes of the first periods alone, and what halving would do to them."""
    tube, halves = reach.tube, reach.halves
    assert halves is not None
    steps = slice(periods + 1)
    cut = Halves(halves.shift[:, :, steps], halves.narrowing[:, :, steps])
    return Reach(Tube(tube.lower[:, steps], tube.upper[:, steps]), halves=cut)


def _log_widths(tube: Tube) -> Tensor:
    """Of each cell, the mean logarithm of the widths after the start; huge where one is infinite."""
    width = torch.nan_to_num(tube.width[:, 1:], nan=1e300, posinf=1e300)
    return width.clamp(1e-200, 1e300).log().mean((1, 2))


def _joined(reaches: Sequence[Reach]) -> Reach:
    """Of the same loop and division, as one."""
    if len(reaches) == 1:
        return reaches[0]
    flows = [r.flow for r in reaches if r.flow is not None]
    lower, upper = ([getattr(r, f"control_{side}") for r in reaches] for side in ("lower", "upper"))
    known = all(side is not None for side in (*lower, *upper))
    return Reach(
        Tube(*(torch.cat([getattr(r.tube, side) for r in reaches]) for side in ("lower", "upper"))),
        torch.cat(lower) if known else None,
        torch.cat(upper) if known else None,
        Recording.join([r.recording for r in reaches]),
        tuple(dict.fromkeys(note for r in reaches for note in r.notes)),
        Flow.join(flows),
        Halves.join([r.halves for r in reaches]),
    )
