"""Intervals: values that know two bounds per entry, both rounded outwards, and what instructions do to them.

Bounds are tensors, or numpy's arrays, whose operations on a few numbers take a fifth of the time: for the intervals
that are carried beside affine forms (:mod:`.affine.compiled.intervals`), and for programs that are run on few boxes.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.program.kinds import join, pick
from sagemp_cli.reachability.program.program import Evaluate, Instruction, Outputs, Program
from sagemp_cli.reachability.relaxations import float32
from sagemp_cli.reachability.relaxations.functions import contiguous, functions_of, on_tensors
from sagemp_cli.reachability.relaxations.registry import relaxation
from sagemp_cli.sets import round_down, round_up
from sagemp_cli.sets.rounding import TINY, slack


class IntervalForm:
    """Every value between ``lower`` and ``upper`` ``(..., size)``, entry by entry; infinite where nothing is known."""

    __slots__ = ("lower", "upper")

    def __init__(self, lower: Any, upper: Any) -> None:
        m = functions_of(lower)
        self.lower = m.nan_to_num(lower, nan=-math.inf, posinf=math.inf, neginf=-math.inf)
        self.upper = m.nan_to_num(upper, nan=math.inf, posinf=math.inf, neginf=-math.inf)

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Lower and upper bound."""
        return self.lower, self.upper


def evaluate(i: Instruction, operands: Sequence[IntervalForm]) -> IntervalForm:
    """What an instruction makes of intervals."""
    if i.kind == "constant":
        return IntervalForm(i.constants[0], i.constants[0])
    if i.kind == "pick":
        return IntervalForm(*(pick(side, i.entries) for side in operands[0].bounds))
    if i.kind == "join":
        return IntervalForm(join([o.lower for o in operands]), join([o.upper for o in operands]))
    if i.kind == "linear":
        (operand,), (weight, bias) = operands, i.constants
        return _linear(operand, weight, bias)
    if i.kind == "float32_linear":
        (operand,), (weight, bias) = operands, i.constants
        exact = _linear(operand, weight, bias)
        sizes = float32.sizes_of_sums(*operand.bounds, weight.abs(), bias.abs())
        return IntervalForm(*float32.widened(*exact.bounds, float32.error_of_sums(sizes, weight.shape[-1])))
    if i.kind in _RULES:
        return _RULES[i.kind](*operands)
    if i.kind == "atan2":
        sides = functions_of(operands[0].lower).broadcast_tensors(*operands[0].bounds, *operands[1].bounds)
        return IntervalForm(*on_tensors(relaxation(i.kind).operation.value_range, *map(contiguous, sides)))
    _, operation, parameters = relaxation(i.kind, i.constants)
    return IntervalForm(*operation.value_range(*operands[0].bounds, *parameters))


@np.errstate(all="ignore")  # what overflows has infinite bounds
def run_on_arrays(program: Program, *inputs: IntervalForm | None, evaluate: Evaluate | None = None) -> Outputs:
    """What a program gives over boxes of tensors, as tensors; on arrays between.

    Args:
        program: what.
        inputs: the state, the disturbance and the numbers, ``(..., entries)``.
        evaluate: see :meth:`.Program.run`; what :func:`evaluate_arrays` does by default.
    """
    given = (None if x is None else IntervalForm(*(side.numpy() for side in x.bounds)) for x in inputs)
    found = program.run(*given, evaluate=evaluate or evaluate_arrays)

    def placed(x: IntervalForm | None) -> IntervalForm | None:
        return None if x is None else IntervalForm(*(torch.from_numpy(np.ascontiguousarray(s)) for s in x.bounds))

    return Outputs(placed(found.next), placed(found.control), placed(found.deviation))


def evaluate_arrays(i: Instruction, operands: Sequence[IntervalForm]) -> IntervalForm:
    """What an instruction makes of intervals of arrays."""
    if i.kind == "constant":
        value = i.constants[0].numpy()
        return IntervalForm(value, value)
    if i.kind == "pick":
        first, count = i.entries[0], len(i.entries)
        neighbours = i.entries == tuple(range(first, first + count))
        entries = slice(first, first + count) if neighbours else list(i.entries)
        return IntervalForm(*(side[..., entries] for side in operands[0].bounds))
    if i.kind == "join":
        batch = max((o.lower.shape[:-1] for o in operands), key=len)
        lower, upper = (
            [side if side.shape[:-1] == batch else np.broadcast_to(side, (*batch, side.shape[-1])) for side in sides]
            for sides in zip(*(o.bounds for o in operands), strict=True)
        )
        return IntervalForm(np.concatenate(lower, -1), np.concatenate(upper, -1))
    if i.kind == "float32_linear":
        tensors = [IntervalForm(*(torch.from_numpy(np.array(side)) for side in o.bounds)) for o in operands]
        return IntervalForm(*(side.numpy() for side in evaluate(i, tensors).bounds))
    if i.kind == "linear" or i.kind in _RULES or i.kind == "atan2":
        return evaluate(i, operands)
    _, operation, parameters = relaxation(i.kind, i.constants)
    return IntervalForm(*operation.range_of(*operands[0].bounds, *parameters))


def _outwards(lower: Any, upper: Any) -> tuple[Any, Any]:
    """Bounds that were rounded to nearest, moved to the next floats outside."""
    return round_down(lower), round_up(upper)


def _signed(low: Any, high: Any, not_negative: Any, not_positive: Any) -> IntervalForm:
    """Bounds whose rounding does not cross 0 where the sign is known: there a root or a quotient has its end."""
    m = functions_of(low)
    return IntervalForm(
        m.where(not_negative, m.clamp(low, min=0.0), low), m.where(not_positive, m.clamp(high, max=0.0), high)
    )


def _signs(a: IntervalForm, b: IntervalForm) -> tuple[Any, Any]:
    """Where a product or quotient is not negative, and where it is not positive."""
    up_a, down_a, up_b, down_b = a.lower >= 0, a.upper <= 0, b.lower >= 0, b.upper <= 0
    return (up_a & up_b) | (down_a & down_b), (up_a & down_b) | (down_a & up_b)


def _sum(a: IntervalForm, b: IntervalForm) -> IntervalForm:
    found = _outwards(a.lower + b.lower, a.upper + b.upper)
    return _signed(*found, (a.lower >= 0) & (b.lower >= 0), (a.upper <= 0) & (b.upper <= 0))


def _negative(a: IntervalForm) -> IntervalForm:
    return IntervalForm(-a.upper, -a.lower)


def _corners(a: IntervalForm, b: IntervalForm, operation: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    m = functions_of(a.lower)
    values = m.stack([operation(x, y) for x in a.bounds for y in b.bounds])
    return m.amin(values, 0), m.amax(values, 0)


def _product(a: IntervalForm, b: IntervalForm) -> IntervalForm:
    """Product; of one value with itself the square."""
    if a is b:
        _, square, parameters = relaxation("pow", (torch.tensor(2.0),))
        return IntervalForm(*square.range_of(*a.bounds, *parameters))
    return _signed(*_outwards(*_corners(a, b, operator.mul)), *_signs(a, b))


def _quotient(a: IntervalForm, b: IntervalForm) -> IntervalForm:
    """Quotient; unbounded where the denominator may be 0."""
    pole, m = (b.lower <= 0) & (b.upper >= 0), functions_of(a.lower)
    found = _signed(*_outwards(*_corners(a, b, operator.truediv)), *_signs(a, b))
    return IntervalForm(m.where(pole, -math.inf, found.lower), m.where(pole, math.inf, found.upper))


def _larger(a: IntervalForm, b: IntervalForm) -> IntervalForm:
    m = functions_of(a.lower)
    return IntervalForm(m.maximum(a.lower, b.lower), m.maximum(a.upper, b.upper))


def _smaller(a: IntervalForm, b: IntervalForm) -> IntervalForm:
    m = functions_of(a.lower)
    return IntervalForm(m.minimum(a.lower, b.lower), m.minimum(a.upper, b.upper))


def _linear(x: IntervalForm, weight: Tensor, bias: Tensor) -> IntervalForm:
    """``W x + b``; the sums round by at most gamma times the sums of absolute values (Higham 2002, section 3.1)."""
    m = functions_of(x.lower)
    tensors = isinstance(x.lower, Tensor)
    w, b = (side if tensors else side.numpy() for side in (weight, bias))
    apply: Callable[..., Any] = torch.nn.functional.linear if tensors else _applied
    positive, negative = m.clamp(w, min=0.0), m.clamp(w, max=0.0)
    size = apply(m.maximum(abs(x.lower), abs(x.upper)), abs(w), abs(b))
    margin = slack(size, 2 * w.shape[-1] + 8) + TINY  # two products, and joining them and the bias
    low = apply(x.lower, positive, b) + apply(x.upper, negative)
    high = apply(x.upper, positive, b) + apply(x.lower, negative)
    # No term of a sum is negative if the negative ones add up to 0, which is exact then.
    below = apply(m.clamp(x.lower, max=0.0), positive) + apply(m.clamp(x.upper, min=0.0), negative)
    above = apply(m.clamp(x.upper, min=0.0), positive) + apply(m.clamp(x.lower, max=0.0), negative)
    return _signed(low - margin, high + margin, (below == 0) & (b >= 0), (above == 0) & (b <= 0))


def _applied(x: np.ndarray, weight: np.ndarray, bias: np.ndarray | None = None) -> np.ndarray:
    """``W x + b`` of rows."""
    product = x @ weight.T
    return product if bias is None else product + bias


def _chosen(c: IntervalForm, a: IntervalForm, b: IntervalForm) -> IntervalForm:
    """One of two where it is known which, else both."""
    m, yes, no = functions_of(a.lower), c.lower > 0, c.upper <= 0
    return IntervalForm(
        m.where(yes, a.lower, m.where(no, b.lower, m.minimum(a.lower, b.lower))),
        m.where(yes, a.upper, m.where(no, b.upper, m.maximum(a.upper, b.upper))),
    )


def _log_of_sum(a: IntervalForm, b: IntervalForm) -> IntervalForm:
    """It rises in both; what is computed is a sum of the larger one and of something in [0, log 2]."""
    m, ends = functions_of(a.lower), []
    for x, y, sign in ((a.lower, b.lower, -1.0), (a.upper, b.upper, 1.0)):
        value = m.logaddexp(x, y)
        ends.append(value + sign * (slack(1.0 + abs(m.maximum(x, y)), 16) + TINY))
    return IntervalForm(*ends)


_RULES = {
    "logaddexp": _log_of_sum,
    "where": _chosen,
    "neg": _negative,
    "add": _sum,
    "sub": lambda a, b: _sum(a, _negative(b)),
    "mul": _product,
    "div": _quotient,
    "maximum": _larger,
    "minimum": _smaller,
}
