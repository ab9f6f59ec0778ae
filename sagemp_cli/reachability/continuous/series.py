"""Taylor coefficients, in time, of every value of a program along a curve of states.

``a(t) = a_0 + a_1 t + a_2 t^2 + ...``; sums and linear maps act on each coefficient, a product is Cauchy's, and of the
others the derivative's equation gives coefficient q from those before (Griewank and Walther 2008, section 13.2).
Coefficients that are zero throughout are None, and nothing is written for them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.continuous.writing import Writer
from sagemp_cli.reachability.program.kinds import INPUTS
from sagemp_cli.reachability.program.program import Instruction, Program
from sagemp_cli.reachability.relaxations.gelu import CUBIC, SCALE

Coefficients = list[int | None]
"""Slots, of order 0, 1, 2, ..."""

LINEAR = ("pick", "join", "linear", "neg", "add", "sub", "identity")
UNSMOOTH = (
    "relu", "leaky_relu", "abs", "clamp", "elu", "softplus", "softsign", "hardswish", "maximum", "minimum", "floor",
    "ceil", "round", "trunc", "sign", "positive",
)  # fmt: skip


class Series:
    """Coefficients of a program's values, order by order.

    Args:
        out: where instructions are written.
        program: whose values; it must not read its disturbance.
        state: coefficients of the state, which may become more between calls of :meth:`next_order`.
        numbers: of the program's numbers, which do not change in time.
        output: the slot whose coefficients are asked for; the program's output ``next`` by default.

    Raises:
        UnsupportedOperationError: an operation without derivatives.
    """

    def __init__(
        self, out: Writer, program: Program, state: Coefficients, numbers: int | None, output: int | None = None
    ) -> None:
        for i in program.instructions:
            if i.kind in UNSMOOTH:
                raise UnsupportedOperationError(
                    f"'{i.kind}' stands in the right-hand side of the ODE, which must be smooth for a proof in "
                    f"continuous time; smooth ones are tanh, sigmoid, silu, sin, ..."
                )
            if i.kind not in (*INPUTS, "constant", *LINEAR, "mul", "div", "atan2", "logaddexp", *RULES):
                raise UnsupportedOperationError(
                    f"'{i.kind}' stands in the right-hand side of the ODE, and no derivatives in time are written for "
                    f"it; they are for {', '.join(RULES)}"
                )
        self._out, self._program, self._state = out, program, state
        self._numbers = numbers
        self._wanted = program.outputs.next if output is None else output
        self._values: list[Coefficients] = [[] for _ in program.instructions]
        self._beside: dict[tuple[str, int], Coefficients] = {}

    def next_order(self) -> int | None:
        """Of what is asked for, the coefficient after those that were asked for."""
        q = len(self._values[0])
        for slot, i in enumerate(self._program.instructions):
            self._values[slot].append(self._coefficient(slot, i, q))
        return self._values[self._wanted][q]

    def _coefficient(self, slot: int, i: Instruction, q: int) -> int | None:
        if i.kind == "state":
            return self._state[q]
        if i.kind == "numbers":
            return self._numbers if q == 0 else None
        if i.kind == "disturbance":
            return None
        if i.kind == "constant":
            return self._out.constant(i.constants[0]) if q == 0 else None
        if i.kind in LINEAR:
            return self._linear(i, q)
        if i.kind in ("mul", "div", "atan2", "logaddexp"):
            return getattr(self, f"_{i.kind}")(slot, *i.operands, q)
        return RULES[i.kind](self, slot, i, q)

    # -- what acts on each coefficient -------------------------------------------------------------------------------

    def _linear(self, i: Instruction, q: int) -> int | None:
        parts = [self._values[o][q] for o in i.operands]
        if all(p is None for p in parts):
            return None
        sizes = [self._program.instructions[o].size for o in i.operands]
        if i.kind == "join":
            given = [self._zeros(s) if p is None else p for p, s in zip(parts, sizes, strict=True)]
            return self._out.made(i, given)
        if i.kind in ("add", "sub"):
            a, b = (None if p is None else self._spread(p, i.size) for p in parts)
            return self._sum(a, b, i.kind)
        (a,) = parts
        assert a is not None
        if i.kind == "identity":
            return a if q else self._out.made(i, [a])
        if i.kind == "linear" and q:
            weight, bias = i.constants
            return self._out.of("linear", a, constants=(weight, torch.zeros_like(bias)), size=i.size)
        return self._out.made(i, [a])

    def _zeros(self, size: int) -> int:
        return self._out.constant(torch.zeros(size, dtype=torch.float64))

    def _spread(self, slot: int, size: int) -> int:
        """A value of one entry for all entries of another, where nothing else says how many there are."""
        if self._out.size(slot) == size:
            return slot
        return self._out.of("pick", slot, entries=(0,) * size, size=size)

    def _sum(self, a: int | None, b: int | None, kind: str = "add") -> int | None:
        if b is None:
            return a
        if a is None:
            return b if kind == "add" else self._out.of("neg", b)
        return self._out.of(kind, a, b)

    # -- products ----------------------------------------------------------------------------------------------------

    def _times(self, a: int | None, b: int | None) -> int | None:
        return None if a is None or b is None else self._out.of("mul", a, b)

    def _scaled(self, a: int | None, factor: float) -> int | None:
        return None if a is None else self._out.scaled(a, factor)

    def _divided(self, a: int | None, divisor: float) -> int | None:
        return None if a is None else self._out.divided(a, divisor)

    def _cauchy(self, a: Coefficients, b: Coefficients, q: int, first: int = 0, last: int | None = None) -> int | None:
        """``sum_{i=first..last} a_i b_{q-i}``; of a value with itself each pair once."""
        last = q if last is None else last
        total: int | None = None
        if a is b and first == q - last:
            for i in range(first, (q + 1) // 2):
                total = self._sum(total, self._scaled(self._times(a[i], a[q - i]), 2))
            return self._sum(total, self._times(a[q // 2], a[q // 2])) if q % 2 == 0 else total
        for i in range(first, last + 1):
            total = self._sum(total, self._times(a[i], b[q - i]))
        return total

    def _integrated(self, a: Coefficients, slope: Coefficients, q: int) -> int | None:
        """Coefficient q of ``c`` with ``c' = slope a'``: ``(1/q) sum_{i=1..q} i a_i slope_{q-i}``."""
        total: int | None = None
        for i in range(1, q + 1):
            total = self._sum(total, self._scaled(self._times(a[i], slope[q - i]), i))
        return self._divided(total, q)

    def _mul(self, slot: int, a: int, b: int, q: int) -> int | None:
        return self._cauchy(self._values[a], self._values[b], q)

    def _div(self, slot: int, a: int, b: int, q: int) -> int | None:
        """``c = a / b``: ``c_q = (a_q - sum_{i<q} c_i b_{q-i}) / b_0``."""
        over, under, found = self._values[a], self._values[b], self._values[slot]
        rest = self._sum(over[q], self._cauchy(found, under, q, 0, q - 1) if q else None, "sub")
        return None if rest is None else self._out.of("div", rest, _there(under[0]))

    def _atan2(self, slot: int, y: int, x: int, q: int) -> int | None:
        """``D theta' = x y' - y x'`` with ``D = x^2 + y^2``."""
        ys, xs, found = self._values[y], self._values[x], self._values[slot]
        square = self._beside.setdefault(("square", slot), [])
        square.append(self._sum(self._cauchy(xs, xs, q), self._cauchy(ys, ys, q)))
        if q == 0:
            return self._out.of("atan2", _there(ys[0]), _there(xs[0]))
        total: int | None = None
        for i in range(1, q + 1):
            turn = self._sum(self._times(xs[q - i], ys[i]), self._times(ys[q - i], xs[i]), "sub")
            total = self._sum(total, self._scaled(turn, i))
            if i < q:
                total = self._sum(total, self._scaled(self._times(found[i], square[q - i]), i), "sub")
        return None if total is None else self._divided(self._out.of("div", total, _there(square[0])), q)

    def _logaddexp(self, slot: int, a: int, b: int, q: int) -> int | None:
        """``c' = b' + s d'`` with ``d = a - b`` and ``s = sigmoid(d)``."""
        d, s, slope = (self.series_beside(name, slot) for name in ("difference", "sigmoid", "slope"))
        first, second = self._values[a], self._values[b]
        d.append(self._sum(first[q], second[q], "sub"))
        s.append(self._out.of("sigmoid", _there(d[0])) if q == 0 else self._integrated(d, slope, q))
        slope.append(self._sum(s[q], self._cauchy(s, s, q), "sub"))
        if q == 0:
            return self._out.of("logaddexp", _there(first[0]), _there(second[0]))
        return self._sum(second[q], self._integrated(d, s, q))

    # -- functions of one value --------------------------------------------------------------------------------------

    def series_beside(self, name: str, slot: int) -> Coefficients:
        """A further series that belongs to a slot."""
        return self._beside.setdefault((name, slot), [])

    def _sine_and_cosine(self, operand: int, q: int) -> tuple[Coefficients, Coefficients]:
        """``s' = c a'`` and ``c' = -s a'``, both up to order q, once for all that read them."""
        a, s, c = self._values[operand], self.series_beside("sin", operand), self.series_beside("cos", operand)
        if len(s) <= q:
            if q == 0:
                s.append(self._out.of("sin", _there(a[0])))
                c.append(self._out.of("cos", _there(a[0])))
            else:
                sine, cosine = self._integrated(a, c, q), self._integrated(a, s, q)
                s.append(sine)
                c.append(None if cosine is None else self._out.of("neg", cosine))
        return s, c

    def _sin(self, slot: int, i: Instruction, q: int) -> int | None:
        return self._sine_and_cosine(i.operands[0], q)[0][q]

    def _cos(self, slot: int, i: Instruction, q: int) -> int | None:
        return self._sine_and_cosine(i.operands[0], q)[1][q]

    def _exp(self, slot: int, i: Instruction, q: int) -> int | None:
        a = self._values[i.operands[0]]
        return self._out.made(i, [_there(a[0])]) if q == 0 else self._integrated(a, self._values[slot], q)

    def _log(self, slot: int, i: Instruction, q: int) -> int | None:
        """``a l' = a'``."""
        a, found = self._values[i.operands[0]], self._values[slot]
        if q == 0:
            return self._out.made(i, [_there(a[0])])
        total = a[q]
        for j in range(1, q):
            total = self._sum(total, self._divided(self._scaled(self._times(found[j], a[q - j]), j), q), "sub")
        return None if total is None else self._out.of("div", total, _there(a[0]))

    def _sqrt(self, slot: int, i: Instruction, q: int) -> int | None:
        """``s s = a``."""
        a, found = self._values[i.operands[0]], self._values[slot]
        if q == 0:
            return self._out.made(i, [_there(a[0])])
        rest = self._sum(a[q], self._cauchy(found, found, q, 1, q - 1), "sub")
        return None if rest is None else self._divided(self._out.of("div", rest, _there(found[0])), 2)

    def _reciprocal(self, slot: int, i: Instruction, q: int) -> int | None:
        a, found = self._values[i.operands[0]], self._values[slot]
        if q == 0:
            return self._out.made(i, [_there(a[0])])
        rest = self._times(self._cauchy(a, found, q, 1, q), found[0])
        return None if rest is None else self._out.of("neg", rest)

    def _tanh(self, slot: int, i: Instruction, q: int) -> int | None:
        """``t' = (1 - t^2) a'``."""
        return self._squared_slope(slot, i, q, slope=lambda _, square: self._one_less(square, q, -1.0))

    def _tan(self, slot: int, i: Instruction, q: int) -> int | None:
        """``t' = (1 + t^2) a'``."""
        return self._squared_slope(slot, i, q, slope=lambda _, square: self._one_less(square, q, 1.0))

    def _sigmoid(self, slot: int, i: Instruction, q: int) -> int | None:
        """``s' = (s - s^2) a'``."""
        return self._squared_slope(slot, i, q, slope=lambda s, square: self._sum(s, square, "sub"))

    def _silu(self, slot: int, i: Instruction, q: int) -> int | None:
        """``a sigmoid(a)``."""
        a, s, slope = (
            self._values[i.operands[0]],
            self.series_beside("sigmoid", slot),
            self.series_beside("slope", slot),
        )
        s.append(self._out.of("sigmoid", _there(a[0])) if q == 0 else self._integrated(a, slope, q))
        slope.append(self._sum(s[q], self._cauchy(s, s, q), "sub"))
        return self._out.made(i, [_there(a[0])]) if q == 0 else self._cauchy(a, s, q)

    def _atan(self, slot: int, i: Instruction, q: int) -> int | None:
        """``c' = a' / (1 + a^2)``."""
        a = self._values[i.operands[0]]
        under, slope = self.series_beside("under", slot), self.series_beside("slope", slot)
        square = self._cauchy(a, a, q)
        under.append(self._one_less(square, q, 1.0))
        if q == 0:
            slope.append(self._out.of("reciprocal", _there(under[0])))
            return self._out.made(i, [_there(a[0])])
        found = self._integrated(a, slope, q)
        rest = self._times(self._cauchy(under, slope, q, 1, q), slope[0])
        slope.append(None if rest is None else self._out.of("neg", rest))
        return found

    def _gelu_tanh(self, slot: int, i: Instruction, q: int) -> int | None:
        """``a sigmoid(p)`` with ``p = 2 c (a + d a^3)``."""
        a, square, p, s, slope = (
            self._values[i.operands[0]],
            *(self.series_beside(name, slot) for name in ("square", "inner", "sigmoid", "slope")),
        )
        square.append(self._cauchy(a, a, q))
        cube = self._scaled(self._cauchy(square, a, q), CUBIC)
        p.append(self._scaled(self._sum(a[q], cube), 2 * SCALE))
        s.append(self._out.of("sigmoid", _there(p[0])) if q == 0 else self._integrated(p, slope, q))
        slope.append(self._sum(s[q], self._cauchy(s, s, q), "sub"))
        return self._out.made(i, [_there(a[0])]) if q == 0 else self._cauchy(a, s, q)

    def _within_a_period(self, slot: int, i: Instruction, q: int) -> int | None:
        """What is left of a value has the value's derivatives, as long as nothing jumps."""
        a = self._values[i.operands[0]]
        return a[q] if q else self._out.made(i, [_there(a[0])])

    def _real_power(self, slot: int, i: Instruction, q: int) -> int | None:
        """``a c' = p c a'``."""
        a, found, p = self._values[i.operands[0]], self._values[slot], float(i.constants[0])
        if q == 0:
            return self._out.made(i, [_there(a[0])])
        over = under = None
        for j in range(1, q + 1):
            over = self._sum(over, self._scaled(self._times(a[j], found[q - j]), j))
        for j in range(1, q):
            under = self._sum(under, self._scaled(self._times(found[j], a[q - j]), j))
        total = self._divided(self._sum(self._scaled(over, p), under, "sub"), q)
        return None if total is None else self._out.of("div", total, _there(a[0]))

    def _pow(self, slot: int, i: Instruction, q: int) -> int | None:
        """A power as products: binary, from the highest digit; of a negative exponent, the reciprocal of one."""
        if float(i.constants[0]) % 1:
            return self._real_power(slot, i, q)
        a, exponent = self._values[i.operands[0]], int(i.constants[0])
        power: Coefficients = a
        for place, digit in enumerate(bin(abs(exponent))[3:]):
            for name in ("square", "more") if digit == "1" else ("square",):
                further = self.series_beside(f"{name} {place}", slot)
                further.append(self._cauchy(power, power if name == "square" else a, q))
                power = further
        if exponent > 0:
            return self._out.made(i, [_there(a[0])]) if q == 0 else power[q]
        found = self._values[slot]
        if q == 0:
            return self._out.made(i, [_there(a[0])])
        rest = self._times(self._cauchy(power, found, q, 1, q), found[0])
        return None if rest is None else self._out.of("neg", rest)

    def _one_less(self, square: int | None, q: int, sign: float) -> int | None:
        """Coefficient of ``1 + sign square``."""
        if q == 0:
            size = self._out.size(_there(square))
            one = self._out.constant(torch.ones(size, dtype=torch.float64))
            return self._sum(one, square, "add" if sign > 0 else "sub")
        return square if sign > 0 or square is None else self._out.of("neg", square)

    def _squared_slope(
        self, slot: int, i: Instruction, q: int, *, slope: Callable[[int | None, int | None], int | None]
    ) -> int | None:
        """A function whose derivative is a polynomial of second degree in itself."""
        a, found, slopes = self._values[i.operands[0]], list(self._values[slot]), self.series_beside("slope", slot)
        found.append(self._out.made(i, [_there(a[0])]) if q == 0 else self._integrated(a, slopes, q))
        slopes.append(slope(found[q], self._cauchy(found, found, q)))
        return found[q]


def _there(slot: int | None) -> int:
    """A coefficient of order 0, which every value has."""
    assert slot is not None
    return slot


RULES: dict[str, Callable[[Series, int, Instruction, int], int | None]] = {
    **{
        name: getattr(Series, f"_{name}")
        for name in (
            "sin", "cos", "exp", "log", "sqrt", "reciprocal", "tanh", "tan", "sigmoid", "silu", "gelu_tanh", "atan",
            "pow",
        )
    },
    **dict.fromkeys(("remainder", "fmod", "wrap"), Series._within_a_period),
}  # fmt: skip


def state_coefficients(
    out: Writer, program: Program, state: int, numbers: int | None, w: int | None, order: int
) -> Sequence[int | None]:
    """Coefficients 0 to ``order`` of the solution of ``x' = f(x, u) + w`` with constant ``u`` and ``w``.

    Args:
        out: where instructions are written.
        program: f; its ``numbers`` are u.
        state, numbers, w: slots of x_0, u and w.
        order: the highest one.
    """
    coefficients: Coefficients = [state]
    series = Series(out, program, coefficients, numbers)
    for q in range(order):
        rate = series.next_order()
        if q == 0 and w is not None:
            rate = w if rate is None else out.of("add", rate, w)
        coefficients.append(None if rate is None else out.divided(rate, q + 1))
    return coefficients
