"""Why a tube has no bounds from some step on: the first operation that has none over the box before it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.program.program import Instruction
from sagemp_cli.sets import Box, Tube

_DIVISIONS = ("div", "reciprocal")
_BOTH_WAYS = ("pow", *_DIVISIONS)


def why_unbounded(loop: RecordedLoop, tube: Tube, disturbance: Box) -> str:
    """In words, for the first of the tube's cells ``(C, K+1, n)`` that is lost; empty if all are bounded.

    Found by intervals, of which no propagator is wider: what they bound and the tube does not was lost by the widths of
    forms, and is told as an overflow.
    """
    lost = ~(torch.isfinite(tube.lower) & torch.isfinite(tube.upper)).all(-1)
    if not bool(lost.any()):
        return ""
    step = int(lost.any(0).to(torch.int8).argmax())
    cell = int(lost[:, step].to(torch.int8).argmax())
    if step == 0:
        return "the start is not bounded"
    k, found = step - 1, []

    def noted(i: Instruction, operands: Sequence[IntervalForm]) -> IntervalForm:
        result = evaluate(i, operands)
        if not found and all(_bounded(o) for o in operands) and not _bounded(result):
            found.append(_reason(i, operands))
        return result

    numbers = loop.numbers_in(torch.Size([len(tube.lower)]))[k, cell] if loop.numbers.shape[-1] else None
    with torch.no_grad():
        loop.programs[k if len(loop.programs) > 1 else 0].run(
            IntervalForm(tube.lower[cell, k], tube.upper[cell, k]),
            IntervalForm(disturbance.lower, disturbance.upper),
            None if numbers is None else IntervalForm(numbers, numbers),
            evaluate=noted,
        )
    return found[0] if found else "the tube grew until it overflowed"


def _bounded(value: IntervalForm) -> bool:
    return all(bool(torch.isfinite(side).all()) for side in value.bounds)


def _reason(i: Instruction, operands: Sequence[IntervalForm]) -> str:
    """What an instruction has no bounds over."""
    name = {"div": "a quotient", "reciprocal": "a quotient", "log": "a logarithm", "sqrt": "a root", "tan": "a tangent"}
    low, high = operands[-1].bounds
    at = _worst(i, low, high)
    over = f"of a value in [{float(low[at]):.6g}, {float(high[at]):.6g}]"
    what = name.get(i.kind, f"a power {float(i.constants[0]):g}" if i.kind == "pow" else f"'{i.kind}'")
    if i.kind in _DIVISIONS:
        return f"{what} by a value in [{float(low[at]):.6g}, {float(high[at]):.6g}], which holds 0"
    if i.kind in ("log", "sqrt", "pow") and bool(low[at] <= 0):
        return f"{what} {over}, where it is not bounded"
    return f"{what} {over}, which has a pole" if i.kind == "tan" else f"{what} {over} overflows"


def _worst(i: Instruction, low: Tensor, high: Tensor) -> int:
    """Which entry: the one that reaches lowest, of a divisor the one that holds 0."""
    return int(((low <= 0) & (high >= 0)).to(torch.int8).argmax()) if i.kind in _BOTH_WAYS else int(low.argmin())
