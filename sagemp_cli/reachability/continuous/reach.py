"""The tube of a sampled loop in continuous time: how a period is divided, and what is said where nothing was found."""

from __future__ import annotations

import dataclasses
import math

import torch

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.division import ORDERS, chosen
from sagemp_cli.reachability.continuous.expansion import expansion
from sagemp_cli.reachability.continuous.propagation import FlowRun, propagated
from sagemp_cli.reachability.continuous.sampled import Sampled, SampledLoop, sampled
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.halves import Halves
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.sets import Box

ORDER = ORDERS[0]
"""Degree of the Taylor polynomials where none is asked for."""


def reach_continuously(
    propagator: Propagator,
    loop: Sampled | SampledLoop,
    start: Box,
    w: Box,
    *,
    substeps: int | None = None,
    order: int | None = None,
    foresee: bool = False,
) -> Reach:
    """Enclosures at the instants and between them, of every solution from ``start (C, n)`` under every measurable
    signal in ``w (n,)``, or in each period in a box of its own, ``(K, n)``, or in each part of one, ``(K, S, n)``.

    Args:
        propagator: bounds the steps; ``affine``.
        loop: an ODE and its control.
        start, w: boxes.
        substeps: parts of a period, a power of two; None begins with one and doubles while there is a period in which
            no enclosure is found and more parts leave fewer of them.
        order: degree of the Taylor polynomials, :data:`ORDER` by default.
        foresee: whether to say what halving each cell would do.

    Raises:
        UsageError: boxes or numbers that do not fit.
        UnsupportedOperationError: another propagator, or an operation that cannot be bounded or has no derivative.
    """
    if not isinstance(propagator, Affine):
        raise UnsupportedOperationError(
            f"propagator '{propagator.name}' bounds loops at their instants only; in continuous time take 'affine'"
        )
    known = sampled(loop, start)
    n, order = known.state_dim, ORDER if order is None else order
    if (
        start.lower.dim() != 2
        or start.dim != n
        or w.lower.shape not in ((n,), (known.horizon, n), (known.horizon, substeps, n))
    ):
        raise UsageError(
            f"the start boxes must be (C, {n}) and the disturbance ({n},), found {tuple(start.lower.shape)} and "
            f"{tuple(w.lower.shape)}: in continuous time w is added to the rate of every state"
        )
    if not 0 < known.period < math.inf:
        raise UsageError(f"the period must be a positive number of seconds, found {known.period}")
    if substeps is not None and (substeps < 1 or substeps & (substeps - 1)):
        raise UsageError(f"substeps must be a power of two, found {substeps}")
    if known.lag is not None and not known.controls:
        raise UsageError("a control that lags is said of a loop that has no control")
    if known.lag is not None and w.lower.dim() > 2:
        raise UsageError("of a control that lags the disturbance may change from period to period, not within one")
    if order < 1:
        raise UsageError(f"order must be at least 1, found {order}")

    def tried(division: Division) -> FlowRun:
        return propagated(propagator, known, start, w, division, foresee=foresee)

    _, best = chosen(tried, Division(substeps or 1, order), substeps=substeps, order=order)
    halves = None if best.run.halving is None else best.run.halving.halves(known.horizon)
    if halves is not None:  # a control before that is part of the state is not a side of a cell
        halves = Halves(*(side[:, :n, :, :n] for side in (halves.shift, halves.narrowing)))
    return dataclasses.replace(_result(best, known), halves=halves)


def polynomial_steps(loop: Sampled | SampledLoop, start: Box, w: Box) -> tuple[RecordedLoop, Box]:
    """The loop as steps of Taylor polynomials without their remainders or a lag, with their disturbance: no proof.

    What comes out is differentiable by weights of the loop, where autograd is on.
    """
    known = dataclasses.replace(sampled(loop, start), lag=None)
    step = expansion(known, Division(1, ORDER)).step
    nothing = torch.zeros_like(w.lower)
    sides = (torch.cat([side, side, nothing]) for side in (w.lower, w.upper))
    return RecordedLoop((step,), known.numbers, known.horizon), Box(*sides)


def _result(found: FlowRun, loop: SampledLoop) -> Reach:
    run, m, parts = found.run, loop.controls, found.flow.division.substeps
    notes, first = list(run.notes), int(found.failed.amin())
    if first < loop.horizon:
        notes.append(
            f"period {first}: no box was found that the flow stays in within 1/{parts} of {loop.period:g} s; the tube "
            f"ends there"
        )
    if first < loop.horizon and not run.bands:  # it was given up before the last period
        nothing = torch.full((*run.tube.lower.shape[:-2], loop.horizon, m), torch.inf, dtype=torch.float64)
        return Reach(run.tube, -nothing, nothing, None, tuple(notes), found.flow)
    recording = run.recording() if run.alike else None
    if run.watched_lower is None or run.watched_upper is None:
        return Reach(run.tube, recording=recording, notes=tuple(notes), flow=found.flow)
    lower, upper = run.watched_lower[..., :m], run.watched_upper[..., :m]
    bad = torch.isnan(lower) | torch.isnan(upper)
    lower, upper = torch.where(bad, -math.inf, lower), torch.where(bad, math.inf, upper)
    return Reach(run.tube, lower, upper, recording, tuple(notes), found.flow)
