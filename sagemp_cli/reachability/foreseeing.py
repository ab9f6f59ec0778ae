"""Tubes, and what halving their cells would do."""

from __future__ import annotations

import dataclasses

import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.halving import Halving
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.sets import Box


def reach_foreseeing(
    propagator: Propagator, loop: RecordedLoop, start: Box, disturbance: Box, *, watch: bool = False
) -> Reach:
    """The tubes of cells ``(C, n)`` and what halving each would do, by forms whatever the propagator: it is a guide."""
    if isinstance(propagator, Affine):
        return propagator.reach(loop, start, disturbance, watch=watch, foresee=True)
    found = propagator.reach(loop, start, disturbance, watch=watch)
    with torch.no_grad():
        guide = Affine().run(loop, start, disturbance, halving=Halving(start))
    return dataclasses.replace(found, halves=None if guide.halving is None else guide.halving.halves(loop.horizon))
