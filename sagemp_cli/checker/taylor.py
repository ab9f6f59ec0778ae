"""Taylor coefficients in time of the values of a right-hand side along its own solutions.

``a(t) = a_0 + a_1 t + a_2 t^2 + ...``: order by order, for every instruction in turn, as
``docs/continuous_time.md`` lists them. A coefficient that is 0 throughout is None, and nothing is written for it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sagemp_cli.checker.program import Instruction, Program
from sagemp_cli.checker.writing import Writer

Value = int | None
Series = list[Value]

SMOOTH = (
    "sin", "cos", "tan", "atan", "tanh", "sigmoid", "silu", "gelu_tanh", "exp", "log", "sqrt", "reciprocal", "pow",
    "remainder", "fmod", "wrap",
)  # fmt: skip
"""Functions of one value that have all derivatives wherever they are defined and do not jump."""
_GELU = 2 * 0.7978845608028654, 0.044715
"""The factors of ``p = 2 c (a + d a^3)`` in ``gelu_tanh a = a sigmoid(p)``."""
_EACH = ("pick", "join", "linear", "neg", "add", "sub", "identity")
RATES = ("state", "numbers", "constant", "mul", "div", "atan2", "logaddexp", *_EACH, *SMOOTH)
"""What a right-hand side may be made of; what it may not has a kink, or is the disturbance."""


class Expansion:
    """Coefficients of all values of a right-hand side.

    Args:
        out: where they are written.
        rate: the program; it may not read its disturbance.
        state: coefficients of the state, to which others may be added between calls of :meth:`order`.
        control: the value of its numbers, which are constant in time; None if it has none.
        output: the slot whose coefficients are asked for; ``next`` by default.

    Raises:
        ValueError: an instruction that is not smooth, or the disturbance.
    """

    def __init__(
        self, out: Writer, rate: Program, state: Series, control: Value, output: int | None = None
    ) -> None:  # fmt: skip
        require_smooth(rate)
        self.out, self.rate, self.state, self.control = out, rate, state, control
        self._output = rate.next if output is None else output
        self._of: list[Series] = [[] for _ in rate.widths]
        self._with: dict[tuple[int, str], Series] = {}

    def order(self, q: int) -> Value:
        """Coefficient q of the output; all before have to be there."""
        for slot, instruction in enumerate(self.rate.instructions):
            self._of[slot].append(self._coefficient(slot, instruction, q))
        return self._of[self._output][q]

    def _coefficient(self, slot: int, i: Instruction, q: int) -> Value:
        kind = i.kind
        if kind == "state":
            return self.state[q]
        if kind == "numbers":
            return self.control if q == 0 else None
        if kind == "constant":
            return self.out.constant(i.constants) if q == 0 else None
        if kind == "disturbance":
            return None
        read = [self._of[r] for r in i.reads]
        if kind in _EACH:
            return self._each(i, [series[q] for series in read], q)
        if kind == "mul":
            return self._product(read[0], read[1], q)
        if kind == "div":
            return self._quotient(read[0], read[1], self._of[slot], q)
        if kind == "atan2":
            return self._angle(slot, read[0], read[1], q)
        if kind == "logaddexp":
            return self._log_of_sum(slot, read[0], read[1], q)
        if kind in ("sin", "cos"):
            return self._turn(i.reads[0], q)[kind == "cos"]
        if kind == "pow":
            return self._power(slot, i, read[0], q)
        if kind in _SQUARED:
            return self._with_square(slot, kind, read[0], q)
        if kind in ("remainder", "fmod", "wrap"):
            return read[0][q] if q else self.out.copy(i, [_sure(read[0][0])])
        if kind == "gelu_tanh":
            return self._gelu(slot, read[0], q)
        if kind in ("silu", "atan"):
            return (self._silu if kind == "silu" else self._arctangent)(slot, read[0], q)
        if q == 0:
            return self.out.put(kind, _sure(read[0][0]))
        return self._plain(kind, read[0], self._of[slot], q)

    # -- sums and multiples ------------------------------------------------------------------------------------------

    def _each(self, i: Instruction, values: Sequence[Value], q: int) -> Value:
        """What acts on every coefficient by itself."""
        if all(v is None for v in values):
            return None
        out, kind = self.out, i.kind
        if kind == "join":
            widths = [self.rate.widths[r] for r in i.reads]
            return out.copy(
                i, [out.constant(np.zeros(w)) if v is None else v for v, w in zip(values, widths, strict=True)]
            )
        if kind in ("add", "sub"):
            width = max(self.rate.widths[r] for r in i.reads)
            a, b = (
                v if v is None or out.widths[v] == width else out.put("pick", v, entries=[0] * width) for v in values
            )
            return self._sum(kind, a, b)
        value = _sure(values[0])
        if kind == "identity" and q:
            return value
        if kind == "linear" and q:
            rows = len(i.constants) // (self.rate.widths[i.reads[0]] + 1)
            return out.put("linear", value, constants=np.concatenate([i.constants[:-rows], np.zeros(rows)]))
        return out.copy(i, [value])

    def _sum(self, kind: str, a: Value, b: Value) -> Value:
        if a is None or b is None:
            return a if b is None else b if kind == "add" else self.out.put("neg", b)
        return self.out.put(kind, a, b)

    def _times(self, a: Value, b: Value) -> Value:
        return None if a is None or b is None else self.out.put("mul", a, b)

    def _scaled(self, a: Value, factor: float) -> Value:
        return None if a is None else self.out.times(a, factor)

    def _over(self, a: Value, divisor: float) -> Value:
        return None if a is None else self.out.over(a, divisor)

    def _quotient_by(self, a: Value, b: Value) -> Value:
        return None if a is None else self.out.put("div", a, _sure(b))

    # -- products ----------------------------------------------------------------------------------------------------

    def _products(self, a: Series, b: Series, q: int, first: int, last: int) -> Value:
        """``sum a_i b_{q-i}`` over i from first to last."""
        total: Value = None
        for i in range(first, last + 1):
            total = self._sum("add", total, self._times(a[i], b[q - i]))
        return total

    def _squares(self, a: Series, q: int, first: int = 0) -> Value:
        """The same of a value with itself, from first to ``q - first``: every pair once."""
        total: Value = None
        for i in range(first, (q + 1) // 2):
            total = self._sum("add", total, self._scaled(self._times(a[i], a[q - i]), 2))
        if q % 2 == 0:
            total = self._sum("add", total, self._times(a[q // 2], a[q // 2]))
        return total

    def _product(self, a: Series, b: Series, q: int) -> Value:
        return self._squares(a, q) if a is b else self._products(a, b, q, 0, q)

    def _quotient(self, a: Series, b: Series, own: Series, q: int) -> Value:
        rest = self._products(own, b, q, 0, q - 1)
        return self._quotient_by(self._sum("sub", a[q], rest), b[0])

    def _chain(self, a: Series, slope: Series, q: int) -> Value:
        """Of a function with ``c' = slope a'``: ``(sum_{i=1..q} a_i slope_{q-i} i) / q``."""
        total: Value = None
        for i in range(1, q + 1):
            total = self._sum("add", total, self._scaled(self._times(a[i], slope[q - i]), i))
        return self._over(total, q)

    def _angle(self, slot: int, y: Series, x: Series, q: int) -> Value:
        own, square = self._of[slot], self._beside(slot, "square")
        square.append(self._sum("add", self._squares(x, q), self._squares(y, q)))
        if q == 0:
            return self.out.put("atan2", _sure(y[0]), _sure(x[0]))
        total: Value = None
        for i in range(1, q + 1):
            turn = self._sum("sub", self._times(x[q - i], y[i]), self._times(y[q - i], x[i]))
            total = self._sum("add", total, self._scaled(turn, i))
            if i < q:
                total = self._sum("sub", total, self._scaled(self._times(own[i], square[q - i]), i))
        return self._over(self._quotient_by(total, square[0]), q)

    def _log_of_sum(self, slot: int, a: Series, b: Series, q: int) -> Value:
        rest, s, slope = (self._beside(slot, name) for name in ("rest", "sigmoid", "slope"))
        rest.append(self._sum("sub", a[q], b[q]))
        s.append(self.out.put("sigmoid", _sure(rest[0])) if q == 0 else self._chain(rest, slope, q))
        slope.append(self._sum("sub", s[q], self._squares(s, q)))
        if q == 0:
            return self.out.put("logaddexp", _sure(a[0]), _sure(b[0]))
        return self._sum("add", b[q], self._chain(rest, s, q))

    # -- functions of one value --------------------------------------------------------------------------------------

    def _beside(self, slot: int, name: str) -> Series:
        """A series that a function needs beside its own."""
        return self._with.setdefault((slot, name), [])

    def _plain(self, kind: str, a: Series, own: Series, q: int) -> Value:
        if kind == "exp":
            return self._chain(a, own, q)
        if kind == "log":
            total = a[q]
            for i in range(1, q):
                total = self._sum("sub", total, self._over(self._scaled(self._times(own[i], a[q - i]), i), q))
            return self._quotient_by(total, a[0])
        if kind == "sqrt":
            rest = self._sum("sub", a[q], self._squares(own, q, 1))
            return self._over(self._quotient_by(rest, own[0]), 2)
        return self._inverse(a, own, q)

    def _inverse(self, a: Series, own: Series, q: int) -> Value:
        """Of ``1 / a``."""
        rest = self._times(self._products(a, own, q, 1, q), own[0])
        return None if rest is None else self.out.put("neg", rest)

    def _turn(self, operand: int, q: int) -> tuple[Value, Value]:
        """Sine and cosine of a value, once for all that need them."""
        a, sine, cosine = self._of[operand], self._beside(operand, "sin"), self._beside(operand, "cos")
        if len(sine) <= q:
            if q == 0:
                new: tuple[Value, Value] = self.out.put("sin", _sure(a[0])), self.out.put("cos", _sure(a[0]))
            else:
                rise, fall = self._chain(a, cosine, q), self._chain(a, sine, q)
                new = rise, None if fall is None else self.out.put("neg", fall)
            sine.append(new[0])
            cosine.append(new[1])
        return sine[q], cosine[q]

    def _with_square(self, slot: int, kind: str, a: Series, q: int) -> Value:
        """``tanh``, ``tan`` and ``sigmoid``, whose slopes are ``1 - t^2``, ``1 + t^2`` and ``s - s^2``."""
        slope = self._beside(slot, "slope")
        own = [*self._of[slot], self.out.put(kind, _sure(a[0])) if q == 0 else self._chain(a, slope, q)]
        square = self._squares(own, q)
        slope.append(self._sum("sub", own[q], square) if kind == "sigmoid" else self._one(square, q, _SQUARED[kind]))
        return own[q]

    def _one(self, square: Value, q: int, kind: str) -> Value:
        """Of 1 plus or minus a square."""
        return self._sum(kind, self.out.constant(np.ones(self.out.widths[_sure(square)])) if q == 0 else None, square)

    def _silu(self, slot: int, a: Series, q: int) -> Value:
        s, slope = self._beside(slot, "sigmoid"), self._beside(slot, "slope")
        s.append(self.out.put("sigmoid", _sure(a[0])) if q == 0 else self._chain(a, slope, q))
        slope.append(self._sum("sub", s[q], self._squares(s, q)))
        return self.out.put("silu", _sure(a[0])) if q == 0 else self._products(a, s, q, 0, q)

    def _gelu(self, slot: int, a: Series, q: int) -> Value:
        square, inner, s, slope = (self._beside(slot, name) for name in ("square", "inner", "sigmoid", "slope"))
        square.append(self._squares(a, q))
        cube = self._scaled(self._products(square, a, q, 0, q), _GELU[1])
        inner.append(self._scaled(self._sum("add", a[q], cube), _GELU[0]))
        s.append(self.out.put("sigmoid", _sure(inner[0])) if q == 0 else self._chain(inner, slope, q))
        slope.append(self._sum("sub", s[q], self._squares(s, q)))
        return self.out.put("gelu_tanh", _sure(a[0])) if q == 0 else self._products(a, s, q, 0, q)

    def _arctangent(self, slot: int, a: Series, q: int) -> Value:
        under, slope = self._beside(slot, "under"), self._beside(slot, "slope")
        under.append(self._one(self._squares(a, q), q, "add"))
        if q == 0:
            slope.append(self.out.put("reciprocal", _sure(under[0])))
            return self.out.put("atan", _sure(a[0]))
        own = self._chain(a, slope, q)
        slope.append(self._inverse(under, slope, q))
        return own

    def _real_power(self, i: Instruction, a: Series, own: Series, q: int) -> Value:
        if q == 0:
            return self.out.copy(i, [_sure(a[0])])
        over: Value = None
        under: Value = None
        for j in range(1, q + 1):
            over = self._sum("add", over, self._scaled(self._times(a[j], own[q - j]), j))
        for j in range(1, q):
            under = self._sum("add", under, self._scaled(self._times(own[j], a[q - j]), j))
        rest = self._sum("sub", self._scaled(over, float(i.constants[0])), under)
        return self._quotient_by(self._over(rest, q), a[0])

    def _power(self, slot: int, i: Instruction, a: Series, q: int) -> Value:
        if i.constants[0] % 1:
            return self._real_power(i, a, self._of[slot], q)
        exponent = int(i.constants[0])
        power = a
        for place, digit in enumerate(f"{abs(exponent):b}"[1:]):
            square = self._beside(slot, f"square {place}")
            square.append(self._squares(power, q))
            power = square
            if digit == "1":
                more = self._beside(slot, f"more {place}")
                more.append(self._products(power, a, q, 0, q))
                power = more
        if q == 0:
            return self.out.copy(i, [_sure(a[0])])
        return power[q] if exponent > 0 else self._inverse(power, self._of[slot], q)


_SQUARED = {"tanh": "sub", "tan": "add", "sigmoid": ""}


def require_smooth(rate: Program) -> None:
    """Refuse a right-hand side that has a kink or reads the disturbance, which is not its to read.

    Raises:
        ValueError: naming the instruction.
    """
    if rate.reads_disturbance:
        raise ValueError("the right-hand side of the ODE reads the disturbance, which is added to it")
    for i in rate.instructions[2:]:
        if i.kind not in RATES:
            raise ValueError(f"'{i.kind}' stands in the right-hand side of the ODE, which must be smooth")


def solution(out: Writer, rate: Program, state: int, control: Value, w: int, order: int) -> Series:
    """Coefficients 0 to order of the solution of ``x' = f(x, u) + w`` with constant u and w."""
    found: Series = [state]
    expansion = Expansion(out, rate, found, control)
    for q in range(order):
        slope = expansion.order(q)
        if q == 0:
            slope = w if slope is None else out.put("add", slope, w)
        found.append(None if slope is None else out.over(slope, q + 1))
    return found


def _sure(value: Value) -> int:
    """A coefficient of order 0, which is never left out."""
    assert value is not None
    return value
