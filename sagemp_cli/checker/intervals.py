"""Programs on intervals: two ends for every entry, each a ball around the exact end, so that nothing is lost but what
interval arithmetic itself loses.

A value is a list of columns, a column a list of intervals. One column stands for as many as any other value has: what
depends on no direction is computed once for all directions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sagemp_cli.checker.balls import arb, arb_mat, ball, balls
from sagemp_cli.checker.functions import FUNCTIONS, function_of, log_of_sum
from sagemp_cli.checker.points import Point
from sagemp_cli.checker.program import INPUTS, Instruction, Program
from sagemp_cli.checker.ranges import values as ranges_of
from sagemp_cli.checker.unproved import Unproved

Interval = tuple[arb, arb]
"""Both ends; the same object twice is a number."""
Column = list[Interval]
Value = list[Column]

ZERO = arb(0)
NOTHING = (ZERO, ZERO)


def point(value: arb) -> Interval:
    """A number."""
    return value, value


def points(values: Sequence[arb]) -> Column:
    """Numbers."""
    return [point(v) for v in values]


class Bounds:
    """A program that bounds its output ``control`` or ``next``.

    Args:
        program: it.
        output: the slot that is wanted.
        smooth: whether there are bounds only where the program is smooth: where no angle jumps.
    """

    def __init__(self, program: Program, output: int, *, smooth: bool = True) -> None:
        self._program, self._output, self._smooth = program, output, smooth
        needed = {output}
        for slot in range(output, -1, -1):
            if slot in needed:
                needed.update(program.instructions[slot].reads)
        self._order = sorted(needed)
        self._constants: dict[int, Value] = {}
        self._weights: dict[int, tuple[arb_mat, arb_mat, Point]] = {}
        for slot in self._order:
            i = program.instructions[slot]
            if i.kind == "constant":
                self._constants[slot] = [points(balls(i.constants))]
            elif i.kind == "linear":
                self._weights[slot] = _weights(i, program.widths[i.reads[0]])

    def of(self, inputs: Mapping[str, Value]) -> Value:
        """Bounds over boxes of ``state``, ``disturbance`` and ``numbers``.

        Raises:
            Unproved: there are none, as over a pole.
        """
        values: dict[int, Value] = dict(self._constants)
        for slot in self._order:
            i = self._program.instructions[slot]
            if i.kind in INPUTS:
                values[slot] = inputs[i.kind]
            elif i.kind == "linear":
                values[slot] = _linear(*self._weights[slot], values[i.reads[0]])
            elif i.kind != "constant":
                reads = [values[r] for r in i.reads]
                count = max(map(len, reads))
                spread = [v if len(v) == count else v * count for v in reads]
                values[slot] = [_result(i, columns, smooth=self._smooth) for columns in zip(*spread, strict=True)]
        return values[self._output]


def _weights(i: Instruction, columns: int) -> tuple[arb_mat, arb_mat, Point]:
    """Positive and negative part of a matrix, and its bias."""
    rows = len(i.constants) // (columns + 1)
    matrix = i.constants[: rows * columns]
    up, down = (arb_mat(rows, columns, balls(part)) for part in (matrix.clip(min=0.0), matrix.clip(max=0.0)))
    return up, down, balls(i.constants[rows * columns :])


def _linear(up: arb_mat, down: arb_mat, bias: Point, value: Value) -> Value:
    """``M a + b``, of all columns at once."""
    lows, highs = ([column[i][side] for i in range(up.ncols()) for column in value] for side in (0, 1))
    count = len(value)
    low, high = (arb_mat(up.ncols(), count, ends) for ends in (lows, highs))
    least, most = (up * low + down * high).entries(), (up * high + down * low).entries()
    return [
        [(least[i * count + c] + b, most[i * count + c] + b) for i, b in enumerate(bias)] for c in range(count)
    ]  # fmt: skip


def _result(i: Instruction, reads: Sequence[Column], *, smooth: bool) -> Column:
    kind = i.kind
    if kind == "pick":
        return [reads[0][e] for e in i.entries.tolist()]
    if kind == "join":
        return [entry for column in reads for entry in column]
    if len(reads) == 2:
        width = max(map(len, reads))
        left, right = (column if len(column) == width else column * width for column in reads)
        if kind not in _PAIRS or (kind == "atan2" and not smooth):
            return _unsmooth(i, [left, right])
        if kind == "mul" and i.reads[0] == i.reads[1]:
            return [_power(a, 2) for a in left]
        return [_PAIRS[kind](a, b) for a, b in zip(left, right, strict=True)]
    if kind == "pow":
        exponent = float(i.constants[0])
        return [_real_power(a, exponent) if exponent % 1 else _power(a, int(exponent)) for a in reads[0]]
    if kind in _JUMPS and smooth:
        return [_left(function_of(kind, i.constants.tolist()), a) for a in reads[0]]
    return [_FUNCTIONS[kind](a) for a in reads[0]] if kind in _FUNCTIONS else _unsmooth(i, reads)


def _unsmooth(i: Instruction, reads: Sequence[Column]) -> Column:
    """Of what has a kink, or may jump."""
    found = []
    for entry in ranges_of(i, reads):
        if entry is None:
            raise Unproved(f"'{i.kind}' of an interval has no bound")
        found.append(entry)
    return found


# -- pairs -------------------------------------------------------------------------------------------------------------


def add(a: Interval, b: Interval) -> Interval:
    """The sum."""
    if a is NOTHING:
        return b
    return a if b is NOTHING else (a[0] + b[0], a[1] + b[1])


def _sub(a: Interval, b: Interval) -> Interval:
    return a if b is NOTHING else (a[0] - b[1], a[1] - b[0])


def mul(a: Interval, b: Interval) -> Interval:
    """The product of two values that have nothing to do with each other."""
    if a is NOTHING or b is NOTHING:
        return NOTHING
    low, high = a
    least, most = b
    if low >= 0:
        if least >= 0:
            return low * least, high * most
        if most <= 0:
            return high * least, low * most
        return high * least, high * most
    if high <= 0:
        if least >= 0:
            return low * most, high * least
        if most <= 0:
            return high * most, low * least
        return low * most, low * least
    if least >= 0:
        return low * most, high * most
    if most <= 0:
        return high * least, low * least
    return (low * most).min(high * least), (low * least).max(high * most)


def _div(a: Interval, b: Interval) -> Interval:
    return mul(a, _reciprocal(b))


def _atan2(y: Interval, x: Interval) -> Interval:
    """Refused where the angle jumps: there it has no derivative."""
    if not (x[0] > 0 or y[0] > 0 or y[1] < 0):
        raise Unproved("an angle may jump by a whole turn")
    corners = [arb.atan2(b, a) for b in y for a in x]
    low, high = corners[0], corners[0]
    for c in corners[1:]:
        low, high = low.min(c), high.max(c)
    return low, high


_PAIRS: Mapping[str, Callable[[Interval, Interval], Interval]] = {
    "add": add,
    "sub": _sub,
    "mul": mul,
    "div": _div,
    "atan2": _atan2,
    "logaddexp": lambda a, b: (log_of_sum(a[0], b[0]), log_of_sum(a[1], b[1])),
}


# -- functions of one value --------------------------------------------------------------------------------------------


def _reciprocal(a: Interval) -> Interval:
    if not (a[0] > 0 or a[1] < 0):
        raise Unproved("a divisor may be 0")
    return 1 / a[1], 1 / a[0]


def _power(a: Interval, exponent: int) -> Interval:
    """``a^p`` for a whole p other than 0."""
    if exponent < 0:
        return _reciprocal(_power(a, -exponent))
    low, high = a
    if low is high:
        return point(low**exponent)
    if exponent % 2 or low >= 0:
        return low**exponent, high**exponent
    if high <= 0:
        return high**exponent, low**exponent
    return ZERO, (-low).max(high) ** exponent


def _real_power(a: Interval, exponent: float) -> Interval:
    """``a^p`` for a p that is not whole."""
    if not (a[0] > 0 or (exponent > 0 and a[0] >= 0)):
        raise Unproved("a power that is not whole may be of less than 0")
    ends = a[0] ** ball(exponent), a[1] ** ball(exponent)
    return ends if exponent > 0 else (ends[1], ends[0])


def _left(function: Any, a: Interval) -> Interval:
    """What is left when whole periods are taken off; refused where it jumps: there it has no derivative."""
    if not function.straight(*a):
        raise Unproved("a remainder, or an angle, may jump by a whole period")
    return function.excess(ZERO, *a)


def _gelu_tanh(a: Interval) -> Interval:
    return FUNCTIONS["gelu_tanh"].excess(ZERO, *a)


def _met(a: Interval, first: arb, every: arb) -> bool:
    """Whether ``first`` or a whole number of ``every`` beside it may lie between the ends."""
    low, high = (a[0] - first) / every, (a[1] - first) / every
    return not low.lower().ceil() > high.upper().floor()


def _wave(a: Interval, function: Callable[[arb], arb], highest: arb, lowest: arb, turn: arb) -> Interval:
    """A sine or cosine, whose extreme values are at known places."""
    ends = function(a[0]), function(a[1])
    low = arb(-1) if _met(a, lowest, turn) else ends[0].min(ends[1])
    high = arb(1) if _met(a, highest, turn) else ends[0].max(ends[1])
    return low, high


def _sin(a: Interval) -> Interval:
    if a[0] is a[1]:
        return point(a[0].sin())
    pi = arb.pi()
    return _wave(a, arb.sin, pi / 2, -pi / 2, 2 * pi)


def _cos(a: Interval) -> Interval:
    if a[0] is a[1]:
        return point(a[0].cos())
    pi = arb.pi()
    return _wave(a, arb.cos, ZERO, pi, 2 * pi)


def _tan(a: Interval) -> Interval:
    pi = arb.pi()
    if _met(a, pi / 2, pi):
        raise Unproved("a tangent may have a pole")
    return a[0].tan(), a[1].tan()


def _log(a: Interval) -> Interval:
    if not a[0] > 0:
        raise Unproved("a logarithm may be of 0 or less")
    return a[0].log(), a[1].log()


def _sqrt(a: Interval) -> Interval:
    if not a[0] >= 0:
        raise Unproved("a root may be of less than 0")
    return a[0].sqrt(), a[1].sqrt()


def _sigmoid(x: arb) -> arb:
    return 1 / (1 + (-x).exp())


def _silu(a: Interval) -> Interval:
    """It falls down to ``-W(1 / e)`` at ``-1 - W(1 / e)`` and rises from there."""
    least = arb(-1).exp().lambertw()
    ends = a[0] * _sigmoid(a[0]), a[1] * _sigmoid(a[1])
    if a[0] >= -1 - least:
        return ends
    return (ends[1], ends[0]) if a[1] <= -1 - least else (-least, ends[0].max(ends[1]))


def _rising(function: Callable[[arb], arb]) -> Callable[[Interval], Interval]:
    return lambda a: (function(a[0]), function(a[1]))


_JUMPS = ("remainder", "fmod", "wrap")
"""Functions of one value that are smooth where they do not jump."""

_FUNCTIONS: Mapping[str, Callable[[Interval], Interval]] = {
    "neg": lambda a: a if a is NOTHING else (-a[1], -a[0]),
    "identity": lambda a: a,
    "reciprocal": _reciprocal,
    "sin": _sin,
    "cos": _cos,
    "tan": _tan,
    "log": _log,
    "sqrt": _sqrt,
    "silu": _silu,
    "gelu_tanh": _gelu_tanh,
    "exp": _rising(arb.exp),
    "atan": _rising(arb.atan),
    "tanh": _rising(arb.tanh),
    "sigmoid": _rising(_sigmoid),
}
