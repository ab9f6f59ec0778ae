"""What an instruction makes of intervals: two ends for every entry, exact or balls around the exact end.

None stands for an interval of which nothing is known. Only what a function gives over the whole line is said of that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from sagemp_cli.checker.balls import arb, ball
from sagemp_cli.checker.float32 import of_sums, sizes
from sagemp_cli.checker.functions import function_of, log_of_sum
from sagemp_cli.checker.program import Instruction
from sagemp_cli.checker.rows import weights_of
from sagemp_cli.checker.unproved import Unproved

Range = tuple[arb, arb] | None
"""Ends of an interval; None where nothing is known."""

_ZERO = arb(0)


def values(instruction: Instruction, operands: Sequence[Sequence[Range]]) -> list[Range]:
    """Of a nonlinear instruction, from those of its operands, which are equally long; of sums in float32 from the exact
    sums and what is summed.
    """
    kind = instruction.kind
    if kind == "float32_linear":
        return _sums(instruction, *operands)
    if kind == "where":
        return [_outwards(_chosen(*entry)) for entry in zip(*operands, strict=True)]
    if kind in _PAIRS:
        if kind == "mul" and instruction.reads[0] == instruction.reads[1]:
            return [_outwards(None if a is None else _power(a, 2)) for a in operands[0]]
        pairs = zip(*operands, strict=True)
        return [_outwards(None if a is None or b is None else _PAIRS[kind](a, b)) for a, b in pairs]
    return [_outwards(_of_one(instruction, i, a)) for i, a in enumerate(operands[0])]


def both(a: Range, b: Range) -> Range:
    """What lies in two intervals."""
    if a is None or b is None:
        return b if a is None else a
    return a[0].max(b[0]), a[1].min(b[1])


def _outwards(a: Range) -> Range:
    """Exact ends; None where one is not finite."""
    if a is None or not (a[0].is_finite() and a[1].is_finite()):
        return None
    return a[0].lower(), a[1].upper()


def _chosen(c: Range, a: Range, b: Range) -> Range:
    """a where c is positive, else b."""
    if c is not None and (c[0] > 0 or c[1] <= 0):
        return a if c[0] > 0 else b
    return None if a is None or b is None else (a[0].min(b[0]), a[1].max(b[1]))


def _sums(instruction: Instruction, exact: Sequence[Range], terms: Sequence[Range]) -> list[Range]:
    ends = [a for a in terms if a is not None]
    if len(ends) < len(terms):
        return [None] * len(exact)
    matrix, bias = weights_of(instruction, len(terms))
    errors = [of_sums(size, len(terms)) for size in sizes(matrix, bias, ends)]
    return [None if a is None else _outwards((a[0] - e, a[1] + e)) for a, e in zip(exact, errors, strict=True)]


def _of_one(instruction: Instruction, i: int, a: Range) -> Range:
    """Entry i of a function."""
    kind, constants = instruction.kind, instruction.constants.tolist()
    if kind == "clamp":
        limits = constants[i], constants[len(constants) // 2 + i]
        if a is None:
            finite = all(abs(limit) < float("inf") for limit in limits)
            return (ball(min(limits)), ball(limits[1])) if finite else None
        low, high = (_clamped(x, *limits) for x in a)
        return low, high
    if a is None and kind in _BOUNDED:
        low, high = _BOUNDED[kind]
        return (ball(low) if isinstance(low, float) else low()), (ball(high) if isinstance(high, float) else high())
    if a is None and kind in ("remainder", "fmod"):
        return ball(0.0 if kind == "remainder" else -constants[0]), ball(constants[0])
    if a is None:
        return None
    if kind == "pow":
        return _power(a, int(constants[0])) if constants[0] == int(constants[0]) else _real_power(a, constants[0])
    if kind in _OWN:
        return _OWN[kind](a)
    function = function_of(kind, constants)
    if kind in _RISING or (kind == "leaky_relu" and constants[0] >= 0):
        return function.value(a[0]), function.value(a[1])
    try:
        return function.excess(_ZERO, *a)
    except Unproved:
        return None


def _clamped(x: arb, low: float, high: float) -> arb:
    x = x.max(ball(low)) if low > -float("inf") else x
    return x.min(ball(high)) if high < float("inf") else x


def _product(a: tuple[arb, arb], b: tuple[arb, arb]) -> Range:
    corners = [x * y for x in a for y in b]
    low, high = corners[0], corners[0]
    for c in corners[1:]:
        low, high = low.min(c), high.max(c)
    return low, high


def _reciprocal(a: tuple[arb, arb]) -> Range:
    return (1 / a[1], 1 / a[0]) if a[0] > 0 or a[1] < 0 else None


def _quotient(a: tuple[arb, arb], b: tuple[arb, arb]) -> Range:
    inverse = _reciprocal(b)
    return None if inverse is None else _product(a, inverse)


def _angle(y: tuple[arb, arb], x: tuple[arb, arb]) -> Range:
    """The whole circle if the box may meet the jump."""
    if not (x[0] > 0 or y[0] > 0 or y[1] < 0):
        return -arb.pi(), arb.pi()
    corners = [arb.atan2(b, a) for b in y for a in x]
    low, high = corners[0], corners[0]
    for c in corners[1:]:
        low, high = low.min(c), high.max(c)
    return low, high


def _power(a: tuple[arb, arb], exponent: int) -> Range:
    if exponent < 0:
        whole = _power(a, -exponent)
        return None if whole is None or not (a[0] > 0 or a[1] < 0) else _reciprocal(whole)
    ends = a[0] ** exponent, a[1] ** exponent
    if exponent % 2 or a[0] >= 0:
        return ends
    return (ends[1], ends[0]) if a[1] <= 0 else (_ZERO, ends[0].max(ends[1]))


def _real_power(a: tuple[arb, arb], exponent: float) -> Range:
    """Of a number that is not negative."""
    if not (a[0] >= 0 if exponent > 0 else a[0] > 0):
        return None
    ends = a[0] ** ball(exponent), a[1] ** ball(exponent)
    return ends if exponent > 0 else (ends[1], ends[0])


def _size(a: tuple[arb, arb]) -> Range:
    if a[0] >= 0:
        return a
    return (-a[1], -a[0]) if a[1] <= 0 else (_ZERO, (-a[0]).max(a[1]))


def _met(a: tuple[arb, arb], first: arb, parts: int = 1) -> bool:
    """Whether ``first``, or a whole number of such parts of a turn beside it, may lie between the ends."""
    turn = 2 * arb.pi() / parts
    low, high = (a[0] - first) / turn, (a[1] - first) / turn
    return not low.lower().ceil() > high.upper().floor()


def _wave(a: tuple[arb, arb], function: Callable[[arb], arb], highest: arb) -> Range:
    """A sine or cosine, of which one highest point is known."""
    ends = function(a[0]), function(a[1])
    low = ball(-1) if _met(a, highest + arb.pi()) else ends[0].min(ends[1])
    high = ball(1) if _met(a, highest) else ends[0].max(ends[1])
    return low, high


def _tangent(a: tuple[arb, arb]) -> Range:
    """It rises between two poles, half a turn apart."""
    return None if _met(a, arb.pi() / 2, parts=2) else (arb.tan(a[0]), arb.tan(a[1]))


_PAIRS: dict[str, Callable[[tuple[arb, arb], tuple[arb, arb]], Range]] = {
    "mul": _product,
    "div": _quotient,
    "atan2": _angle,
    "maximum": lambda a, b: (a[0].max(b[0]), a[1].max(b[1])),
    "minimum": lambda a, b: (a[0].min(b[0]), a[1].min(b[1])),
    "logaddexp": lambda a, b: (log_of_sum(a[0], b[0]), log_of_sum(a[1], b[1])),
}

_OWN: dict[str, Callable[[tuple[arb, arb]], Range]] = {
    "sin": lambda a: _wave(a, arb.sin, arb.pi() / 2),
    "cos": lambda a: _wave(a, arb.cos, _ZERO),
    "tan": _tangent,
    "abs": _size,
    "relu": lambda a: (a[0].max(_ZERO), a[1].max(_ZERO)),
    "identity": lambda a: a,
    "reciprocal": _reciprocal,
}

_RISING = ("atan", "tanh", "sigmoid", "exp", "log", "sqrt", "elu", "softplus", "softsign", "erf")
"""Outside of their domain they give what is not finite."""

_BOUNDED: dict[str, tuple[Any, Any]] = {
    **dict.fromkeys(("sin", "cos", "tanh", "erf", "softsign", "sign"), (-1.0, 1.0)),
    **dict.fromkeys(("sigmoid", "positive"), (0.0, 1.0)),
    "wrap": (lambda: -arb.pi(), arb.pi),
}
