"""A division of the period by trials on the first periods, where nobody says which."""

from __future__ import annotations

from sagemp_cli.reachability.continuous.division import FLOOR, ORDERS, chosen, remainder_share
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.sets import Box

TRIED = 4
"""Periods of a trial."""


def suggested(
    propagator: Propagator, loop: SampledLoop, cells: Box, w: Box, *, substeps: int | None, order: int | None
) -> Division:
    """A division to begin with, for cells ``(C, n)``; what is given stays."""
    first = loop.beginning(min(TRIED, loop.horizon))

    def tried(division: Division) -> Reach:
        return reach_continuously(propagator, first, cells, w, substeps=division.substeps, order=division.order)

    def share(found: Reach) -> float:
        return float(remainder_share(found, FLOOR).amax())

    begin = Division(substeps or 1, order or ORDERS[0])
    return chosen(tried, begin, substeps=substeps, order=order, share=share)[0]
