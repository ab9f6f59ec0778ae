"""Bounds of a function of the state along a flow, at the instants and over whole parts of periods.

Of a function g, a solution x of a part of length h, and ``g' = Dg(x) (f(x, u) + w)`` along it: with a and b bounds of g
at both ends of the part and ``[r, s]`` bounds of g' over it, ::

    max(a + t r, b - (h - t) s) <= g(x(t))    for t in [0, h]

for every w, since g is the integral of g' along any solution. Of two lines, whatever lies between them by a share q in
[0, 1] bounds too, and is least at an end. Where w cannot change, g(x(t)) is smooth and differs from the chord between
its ends by at most ``t (h - t) |g''| / 2``, with ``g'' / 2`` the second Taylor coefficient of g along the solution. The
direct bound of g over the part's box is used where it is better, and alone where g has no derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.continuous.enclosure import run_smoothly
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.continuous.series import Series, state_coefficients
from sagemp_cli.reachability.continuous.writing import Writer
from sagemp_cli.reachability.flow import Flow
from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.sets import Box, Tube, round_down, round_up


@dataclass(frozen=True, eq=False)
class Observable:
    """A function of the state as programs.

    Attributes:
        value: of the state; its output ``control`` is ``g(x) (c,)``.
        change: of the state, a constant disturbance and the control as numbers; its output ``control`` has the first
            and the second Taylor coefficient of g along the solution. None if g has no derivative.
        size: c.
    """

    value: Program
    change: Program | None
    size: int


def observable(function: Callable[[Any], Any], loop: SampledLoop, example: Tensor, name: str) -> Observable:
    """A function recorded.

    Args:
        function: of states ``(..., n)``, values ``(..., c)``.
        loop: along whose solutions it is to be bounded.
        example: a state, ``(n,)``.
        name: for messages.

    Raises:
        UsageError: it gives something else.
        UnsupportedOperationError: an operation that cannot be bounded.
    """
    n = loop.state_dim
    with torch.no_grad():
        given = function(example)
    if not isinstance(given, Tensor) or given.dim() > 1 or not given.numel():
        found = f"shape {tuple(given.shape)}" if isinstance(given, Tensor) else type(given).__name__
        raise UsageError(f"requirement '{name}' must give numbers (c,) from a state ({n},), found {found}")
    try:
        value = record(lambda x, w: (x * 1, function(x)), example, torch.zeros_like(example))
    except UsageError as e:
        raise UsageError(f"requirement '{name}': {e}") from None
    assert value.outputs.control is not None
    _same(function, value, example, name)
    size = value.instructions[value.outputs.control].size
    out = Writer(n, n, loop.controls)
    try:
        states = state_coefficients(out, loop.rate, out.state, out.numbers, out.disturbance, 2)
        series = Series(out, value, list(states), None, value.outputs.control)
        series.next_order()
        found = [series.next_order(), series.next_order()]
    except UnsupportedOperationError:
        return Observable(value, None, size)
    zeros = out.constant([0.0] * size)
    change = out.finished(next=out.state, control=out.join(*(zeros if slot is None else slot for slot in found)))
    return Observable(value, change, size)


@torch.no_grad()
def _same(function: Callable[[Any], Any], value: Program, example: Tensor, name: str) -> None:
    """Refuse a function that does something else than its program at states around the example, or the second time."""
    for i in range(8):
        x = example + i * 0.1 * (1 + example.abs()) * torch.cos(torch.arange(len(example)) * (i + 1.0))
        recorded = value.run(x, torch.zeros_like(x)).control
        given = function(x).reshape(-1).to(torch.float64)
        both = torch.isfinite(given) & torch.isfinite(recorded)
        if not bool(((given - recorded).abs() <= 1e-9 * (1 + given.abs()))[both].all()):
            raise UsageError(
                f"requirement '{name}' does not always do the same: at x = {x.tolist()} it gives {given.tolist()}, "
                f"recorded {recorded.tolist()}; it must be a function of x only, in torch operations"
            )


@torch.no_grad()
def at_boxes(g: Observable, boxes: Box) -> tuple[Tensor, Tensor]:
    """Bounds of g over boxes ``(..., n)``, ``(..., c)`` each."""
    return _bounds(g.value, IntervalForm(boxes.lower, boxes.upper), None, None)


@torch.no_grad()
def along(
    g: Observable, loop: SampledLoop, flow: Flow, tube: Tube, controls: tuple[Tensor, Tensor], w: Box
) -> tuple[Tensor, Tensor]:
    """Lower bounds of g, and of each entry: at the ends of all parts ``(C, K S + 1, c)`` and over them
    ``(C, K S, c)``; -inf where nothing is known.

    Args:
        g: the function.
        loop: whose flow it is.
        flow, tube, controls: of cells, the controls ``(C, K, m)``.
        w: W.
    """
    cells, periods, parts, n = flow.lower.shape
    h = loop.period / parts
    starts = [side.flatten(1, 2) for side in (flow.state_lower, flow.state_upper)]
    ends = [torch.cat([s, e[:, -1:]], 1) for s, e in zip(starts, (tube.lower, tube.upper), strict=True)]
    ends[0], ends[1] = torch.nan_to_num(ends[0], nan=-torch.inf), torch.nan_to_num(ends[1], nan=torch.inf)
    instants, _ = _bounds(g.value, IntervalForm(*ends), None, None)
    stay = IntervalForm(flow.lower.flatten(1, 2), flow.upper.flatten(1, 2))
    nothing = IntervalForm(*(torch.zeros(1, dtype=torch.float64) for _ in range(2)))
    _, smooth = run_smoothly(g.value, stay, nothing, None)
    over, _ = _bounds(g.value, stay, None, None)
    if g.change is None:
        return instants, over
    u = None
    if loop.controls:
        u = IntervalForm(*(side[:, :, None].expand(cells, periods, parts, -1).flatten(1, 2) for side in controls))
    lower, upper = _bounds(g.change, stay, IntervalForm(w.lower, w.upper), u)
    a, b = instants[:, :-1], instants[:, 1:]
    least = torch.nan_to_num(_between(a, b, lower[..., : g.size], upper[..., : g.size], h), nan=-torch.inf)
    if bool((w.lower == w.upper).all()):
        bend = torch.maximum(lower[..., g.size :].abs(), upper[..., g.size :].abs()) * (h * h / 4 * (1 + 1e-12))
        chord = round_down(torch.minimum(a, b) - round_up(bend))
        least = torch.maximum(least, torch.nan_to_num(chord, nan=-torch.inf))
    # Where g may jump, as an angle does, it is no integral of its rate of change.
    return instants, torch.where(smooth[..., None], torch.maximum(over, least), over)


def _between(a: Tensor, b: Tensor, slow: Tensor, fast: Tensor, h: float) -> Tensor:
    """Lower bound over a part: of a share of the line from its beginning and of that from its end, the lower end."""
    falls, rises = round_down(slow.clamp(max=0.0) * h), round_up(fast.clamp(min=0.0) * h)
    share = (rises / (rises - falls)).nan_to_num(nan=0.5).clamp(0.0, 1.0)
    rest = 1 - share  # exact or not, both are numbers in [0, 1]: what they do not sum up to is paid for below
    first = share * a + rest * (b - rises)
    last = share * (a + falls) + rest * b
    size = a.abs() + b.abs() + rises - falls
    return round_down(torch.minimum(first, last) - 1e-14 * size)


def _bounds(
    program: Program, state: IntervalForm, w: IntervalForm | None, u: IntervalForm | None
) -> tuple[Tensor, Tensor]:
    nothing = IntervalForm(*(torch.zeros(1, dtype=torch.float64) for _ in range(2)))
    found = program.run(state, nothing if w is None else w, u, evaluate=evaluate).control
    shape = (*state.lower.shape[:-1], found.lower.shape[-1])
    return found.lower.expand(shape), found.upper.expand(shape)
