"""A stranger's ODE and controller, seen at work: called, recorded as programs, and compared with them.

As of a stranger's step (:mod:`sagemp_cli.reachability.observed`), what is bounded is what was recorded; that the
functions do what the programs say is tested wherever a difference would show. Both functions are tested as one:
``(x, u) -> (rate(x, u), control(x))``.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.continuous.writing import Writer
from sagemp_cli.reachability.observed import check_box
from sagemp_cli.reachability.program.comparing import MOST_POINTS, climbed, compare, corners_and_centres, near_kinks
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.reachability.program.probing import GlobalRandomness, Step, probe, steady
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.reachability.propagator import Reach
from sagemp_cli.sets import Box

NOTHING = Box(torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))


@dataclass(frozen=True, eq=False)
class ObservedOde:
    """An ODE under a sampled control, with its programs.

    Attributes:
        loop: what is bounded.
        start, disturbance: X_I and W, ``(n,)`` each.
    """

    loop: SampledLoop
    start: Box
    disturbance: Box
    both: Program
    called: Step
    drawn: GlobalRandomness

    def compare(self, reach: Reach) -> None:
        """Refuse functions that are found to differ from their programs, or to depend on anything but their arguments.

        Args:
            reach: of some cells; compared is on boxes that hold what is between the samples.

        Raises:
            UsageError: they do.
        """
        most, flow = MOST_POINTS[self.called.rowwise], reach.flow
        controls = reach.control_lower, reach.control_upper
        if flow is not None and controls[0] is not None and controls[1] is not None:
            states = [side.amin(0) if low else side.amax(0) for side, low in ((flow.lower, True), (flow.upper, False))]
            given = [controls[0].amin(0)[:, None], controls[1].amax(0)[:, None]]
            lower, upper = (
                torch.cat([x, u.expand(*x.shape[:-1], -1)], -1).flatten(0, 1)
                for x, u in zip(states, given, strict=True)
            )
            bounded = torch.isfinite(lower).all(-1) & torch.isfinite(upper).all(-1) & (lower <= upper).all(-1)
            boxes = Box(lower[bounded], upper[bounded])
            if len(boxes.lower):
                compare(self.called, 0, self.both, *corners_and_centres(boxes, NOTHING, most=most))
        x = _with_controls(self.start.center[None], self.loop.control)[0]
        steady(self.called, x, NOTHING.lower)
        self.drawn.refuse()


def observed_ode(
    rate: Callable[[Any, Any], Any],
    control: Callable[[Any], Any],
    start: Box,
    disturbance: Box | None,
    *,
    period: float,
    horizon: int,
) -> ObservedOde:
    """``x' = rate(x, u_k) + w(t)``, ``u_k = control(x(t_k))`` recorded, after both were called on some states.

    Args:
        rate, control: of a state ``(n,)`` and a control ``(m,)``, or of batches.
        start: X_I, ``(n,)``.
        disturbance: W, ``(n,)``, in the units of ``x'``; None if there is none.
        period: seconds between two samples.
        horizon: periods.

    Raises:
        UsageError: arguments that do not fit, or functions of anything else.
        UnsupportedOperationError: an operation that cannot be bounded.
    """
    check_box("start", start)
    n = start.dim
    if disturbance is None:
        disturbance = Box(torch.zeros(n, dtype=torch.float64), torch.zeros(n, dtype=torch.float64))
    check_box("disturbance", disturbance)
    if disturbance.dim != n:
        raise UsageError(
            f"the disturbance must have {n} dimensions, found {disturbance.dim}: in continuous time it is added to the "
            f"rate of every state"
        )
    if isinstance(period, bool) or not isinstance(period, int | float) or not 0 < period < math.inf:
        raise UsageError(f"period must be a positive number of seconds, found {period!r}")
    try:
        steps = operator.index(horizon)
    except TypeError:
        steps = 0
    if steps < 1 or isinstance(horizon, bool):
        raise UsageError(f"horizon must be a positive integer, found {horizon!r}")
    drawn = GlobalRandomness()
    x = start.center
    u = _example(control, x)
    m = len(u)

    def both(_: int, z: Any, __: Any) -> Any:
        return torch.cat([rate(z[..., :n], z[..., n:]), control(z[..., :n])], dim=-1)

    nothing = torch.zeros(n, dtype=torch.float64)
    law = record(lambda x, w: (x * 1, control(x)), x, nothing)
    field = record(lambda x, w, u: rate(x, u), x, nothing, u)
    loop = SampledLoop(law, field, torch.zeros(steps, 0, dtype=torch.float64), steps, float(period))
    generator = torch.Generator().manual_seed(1)
    points = _with_controls(start.sample(64, generator), law)
    around = Box(torch.cat([start.lower, points[:, n:].amin(0)]), torch.cat([start.upper, points[:, n:].amax(0)]))
    step = probe(both, around, NOTHING, batched=None)
    program = _composed(loop, n, m)
    compare(step, 0, program, points, NOTHING.lower.expand(len(points), 1))
    most = MOST_POINTS[step.rowwise]
    whole = Box(around.lower[None], around.upper[None])
    compare(step, 0, program, *corners_and_centres(whole, NOTHING, most=most))
    none = torch.zeros(0, dtype=torch.float64)
    compare(step, 0, program, *near_kinks(program, none, around, NOTHING))
    compare(step, 0, program, *climbed(step, program, none, around, NOTHING))
    return ObservedOde(loop, start, disturbance, program, step, drawn)


def _example(control: Callable[[Any], Any], x: Tensor) -> Tensor:
    """What the controller gives at a state, ``(m,)``, in float64."""
    held: dict[str, Tensor] = {}

    def padded(_: int, z: Any, __: Any) -> Any:
        held["u"] = torch.as_tensor(control(z))
        return z

    Step(padded).at(0, x, NOTHING.lower)
    u = held["u"].detach().as_subclass(Tensor).to(torch.float64)
    if u.dim() != 1 or not len(u) or not bool(torch.isfinite(u).all()):
        raise UsageError(
            f"control must give finite numbers of shape (m,) from a state of shape {tuple(x.shape)}, found "
            f"{tuple(u.shape)}" + ("" if bool(torch.isfinite(u).all()) else " with NaN or infinity")
        )
    return u


@torch.no_grad()
def _with_controls(x: Tensor, law: Program) -> Tensor:
    """States ``(B, n)`` and the controls there."""
    u = law.run(x, torch.zeros_like(x)).control
    return torch.cat([x, u.expand(*x.shape[:-1], -1)], -1)


def _composed(loop: SampledLoop, n: int, m: int) -> Program:
    """Both programs as one step of ``(x, u)``."""
    out = Writer(n + m, 1)
    x, u = out.pick(out.state, 0, n), out.pick(out.state, n, m)
    rate = out.embedded(loop.rate, {"state": x, "numbers": u}).next
    control = out.embedded(loop.control, {"state": x}).control
    return out.finished(next=out.join(rate, control))
