"""How far a function's graph lies from a line, over an interval: the one fact that a relaxation rests on.

``excess`` gives ``[least, most]`` that contains ``f(x) - slope x`` for every real x of ``[lower, upper]``. Nothing is
assumed about how the slope was found. A function is a list of pieces, straight or smooth; a smooth piece is split
until its curvature has one sign, where a tangent and a chord bound it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sagemp_cli.checker.balls import Unproved, arb, ball
from sagemp_cli.checker.float32 import ROUNDINGS, Rounding
from sagemp_cli.checker.jumps import JUMPS, Sawtooth, Staircase, fmod, remainder

_MOST_SPLITS = 4096
_NEWTON_STEPS = 16


@dataclass(frozen=True)
class Line:
    """``a x + b``."""

    a: arb
    b: arb

    def value(self, x: arb) -> arb:
        """``f(x)``."""
        return self.a * x + self.b

    def excess(self, slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
        """See the module; exactly 0 if the line has this slope and passes through 0."""
        ends = [(self.a - slope) * x + self.b for x in (lower, upper)]
        return ends[0].min(ends[1]), ends[0].max(ends[1])


@dataclass(frozen=True)
class Smooth:
    """A twice differentiable function: its value and its first two derivatives on balls; of the second one the sign is
    enough where the ball is no number.
    """

    value: Callable[[arb], arb]
    first: Callable[[arb], arb]
    second: Callable[[arb], arb]
    bend: int = 0  # 1 or -1: its sign wherever it is defined, though it may be infinite at an end

    def excess(self, slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
        """See the module."""
        todo = [] if lower == upper else [(lower, upper)]  # at a point no slope is needed, it may be infinite
        splits = 0
        ends = [self.value(x) - slope * x for x in (lower, upper)]
        least, most = ends[0].min(ends[1]), ends[0].max(ends[1])
        while todo:
            low, high = todo.pop()
            curvature = arb(self.bend) if self.bend and least.is_finite() else self.second(low.union(high))
            if curvature >= 0:
                least = least.min(self._tangent(slope, low, high, arb.min))
            elif curvature <= 0:
                most = most.max(self._tangent(slope, low, high, arb.max))
            else:
                splits += 1
                if splits > _MOST_SPLITS:
                    raise Unproved("an interval is too wide for a bound of its function")
                middle = ((low + high) / 2).mid()
                if (high - low) * ball(2.0**60) <= 1 + abs(middle):  # an inflection: bound it as it is
                    whole, at = low.union(high), self.value(middle) - slope * middle
                    spread = (self.first(whole) - slope) * (whole - middle)
                    least, most = least.min((at + spread).lower()), most.max((at + spread).upper())
                else:
                    at = self.value(middle) - slope * middle
                    least, most = least.min(at), most.max(at)
                    todo += [(low, middle), (middle, high)]
        return least, most

    def _tangent(self, slope: arb, low: arb, high: arb, pick: Callable[[arb, arb], arb]) -> arb:
        """The bound by a tangent of the excess, taken near its extremum (any point would be sound)."""
        x = ((low + high) / 2).mid()
        for _ in range(_NEWTON_STEPS):
            bend = self.second(x)
            if bend.contains(0):
                break
            step = ((self.first(x) - slope) / bend).mid()
            before, x = x, (x - step).max(low).min(high).mid()
            if not self.first(x).is_finite():  # at the end of the domain
                x = ((before + x) / 2).mid()
                continue
            if abs(step) * ball(2.0**40) <= high - low:
                break
        at, tilt = self.value(x) - slope * x, self.first(x) - slope
        return pick(at + tilt * (low - x), at + tilt * (high - x))


Piece = tuple[float | None, Line | Smooth, float | None]


@dataclass(frozen=True)
class Function:
    """A function made of pieces ``(from, what, to)``; None is no end. Pieces may overlap, as a limit does."""

    pieces: tuple[Piece, ...]

    def excess(self, slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
        """See the module."""
        if not (slope.is_finite() and lower.is_finite() and upper.is_finite()):
            raise Unproved("an interval is not finite")
        found = None
        for begin, piece, end in self.pieces:
            low = lower if begin is None else lower.max(ball(begin))
            high = upper if end is None else upper.min(ball(end))
            if low > high:
                continue
            part = piece.excess(slope, low, high)
            found = part if found is None else (found[0].min(part[0]), found[1].max(part[1]))
        if found is None or not (found[0].is_finite() and found[1].is_finite()):
            raise Unproved("an interval contains a pole, or leaves the domain of its function")
        return found

    def value(self, x: arb) -> arb:
        """``f`` of a ball: the hull of the pieces that it meets."""
        found = None
        for begin, piece, end in self.pieces:
            if (begin is not None and x < ball(begin)) or (end is not None and x > ball(end)):
                continue
            found = piece.value(x) if found is None else found.union(piece.value(x))
        assert found is not None
        return found


def _smooth(value: Callable, first: Callable, second: Callable, *, bend: int = 0) -> Function:
    return Function(((None, Smooth(value, first, second, bend), None),))


def _line(a: float, b: float = 0.0) -> Line:
    return Line(ball(a), ball(b))


def _sigmoid(x: arb) -> arb:
    return 1 / (1 + (-x).exp())


def _silu_first(x: arb) -> arb:
    s = _sigmoid(x)
    return s * (1 + x * (1 - s))


def _silu_second(x: arb) -> arb:
    s = _sigmoid(x)
    return s * (1 - s) * (2 + x * (1 - 2 * s))


def _tan_second(x: arb) -> arb:
    return 2 * x.tan() * x.sec() ** 2


def _signed(sign: Callable[[arb], arb], size: Callable[[arb], arb]) -> Callable[[arb], arb]:
    """A product whose second factor is positive, and left out where the argument is no number: of a wide ball it says
    nothing.
    """
    return lambda x: sign(x) * size(x) if x.rad() == 0 else sign(x)


def _normal(x: arb) -> arb:
    """The distribution of a standard normal number."""
    return (-x / arb(2).sqrt()).erfc() / 2


def _bell(x: arb) -> arb:
    """Its density."""
    return (-x * x / 2).exp() / (2 * arb.pi()).sqrt()


_GELU_SCALE, _GELU_CUBIC = 0.7978845608028654, 0.044715
"""The numbers of GELU's tanh form: c and d of ``x (1 + tanh(c (x + d x^3))) / 2 = x sigmoid(p)``."""


def _gelu_inner(x: arb) -> tuple[arb, arb, arb]:
    """p and its derivatives."""
    c, d = 2 * ball(_GELU_SCALE), ball(_GELU_CUBIC)
    return c * (x + d * x**3), c * (1 + 3 * d * x**2), 6 * c * d * x


def _gelu_tanh_first(x: arb) -> arb:
    p, rise, _ = _gelu_inner(x)
    return _sigmoid(p) * (1 + x * _sigmoid(-p) * rise)


def _gelu_tanh_bend(x: arb) -> arb:
    p, rise, bend = _gelu_inner(x)
    return 2 * rise + x * bend - x * rise**2 * (p / 2).tanh()


def _gelu_tanh_size(x: arb) -> arb:
    p, *_ = _gelu_inner(x)
    return _sigmoid(p) * _sigmoid(-p)


def _mish_left() -> Smooth:
    """Mish ``x n / (n + 2)`` with ``n = e (e + 2)``, ``e = exp(x)``, left of 0."""

    def over(e: arb) -> arb:
        return e * (e + 2) + 2

    def first(x: arb) -> arb:
        e = x.exp()
        return e * (e + 2) / over(e) + x * 4 * e * (1 + e) / over(e) ** 2

    def bend(x: arb) -> arb:
        e = x.exp()
        return 2 * (e + 1) * over(e) + x * (2 + 2 * e - 3 * e**2 - 2 * e**3)

    size = _signed(bend, lambda x: 4 * x.exp() / over(x.exp()) ** 3)
    return Smooth(lambda x: x * x.exp() * (x.exp() + 2) / over(x.exp()), first, size)


def _mish_right() -> Smooth:
    """The same in terms of ``q = exp(-x)``, right of 0."""

    def over(q: arb) -> arb:
        return 1 + 2 * q + 2 * q**2

    def first(x: arb) -> arb:
        q = (-x).exp()
        return (1 + 2 * q) / over(q) + x * 4 * (1 + q) * q**2 / over(q) ** 2

    def bend(x: arb) -> arb:
        q = (-x).exp()
        return 2 * (1 + q) * over(q) + x * (2 * q**3 + 2 * q**2 - 3 * q - 2)

    size = _signed(bend, lambda x: 4 * (-2 * x).exp() / over((-x).exp()) ** 3)
    return Smooth(lambda x: x * (1 + 2 * (-x).exp()) / over((-x).exp()), first, size)


_SOFTSIGN = (
    Smooth(lambda x: x / (1 - x), lambda x: 1 / (1 - x) ** 2, lambda x: 2 / (1 - x) ** 3),
    Smooth(lambda x: x / (1 + x), lambda x: 1 / (1 + x) ** 2, lambda x: -2 / (1 + x) ** 3),
)
_PARABOLA = Smooth(lambda x: x * (x + 3) / 6, lambda x: (2 * x + 3) / 6, lambda x: arb(1) / 3)


FUNCTIONS: dict[str, Function] = {
    "sin": _smooth(arb.sin, arb.cos, lambda x: -x.sin()),
    "cos": _smooth(arb.cos, lambda x: -x.sin(), lambda x: -x.cos()),
    "tan": _smooth(arb.tan, lambda x: x.sec() ** 2, _tan_second),
    "atan": _smooth(arb.atan, lambda x: 1 / (1 + x * x), lambda x: -2 * x / (1 + x * x) ** 2),
    "tanh": _smooth(arb.tanh, lambda x: x.sech() ** 2, lambda x: -2 * x.tanh() * x.sech() ** 2),
    "sigmoid": _smooth(
        _sigmoid,
        lambda x: _sigmoid(x) * _sigmoid(-x),
        lambda x: _sigmoid(x) * _sigmoid(-x) * (_sigmoid(-x) - _sigmoid(x)),
    ),
    "silu": _smooth(lambda x: x * _sigmoid(x), _silu_first, _silu_second),
    "gelu": _smooth(lambda x: x * _normal(x), lambda x: _normal(x) + x * _bell(x), _signed(lambda x: 2 - x * x, _bell)),
    "gelu_tanh": _smooth(
        lambda x: x * _sigmoid(_gelu_inner(x)[0]), _gelu_tanh_first, _signed(_gelu_tanh_bend, _gelu_tanh_size)
    ),
    "mish": Function(((None, _mish_left(), 0.0), (0.0, _mish_right(), None))),
    "softsign": Function(((None, _SOFTSIGN[0], 0.0), (0.0, _SOFTSIGN[1], None))),
    "hardswish": Function(((None, _line(0.0), -3.0), (-3.0, _PARABOLA, 3.0), (3.0, _line(1.0), None))),
    "erf": _smooth(
        arb.erf,
        lambda x: 2 * (-x * x).exp() / arb.pi().sqrt(),
        _signed(lambda x: -x, lambda x: 4 * (-x * x).exp() / arb.pi().sqrt()),
    ),
    "exp": _smooth(arb.exp, arb.exp, arb.exp),
    "log": _smooth(arb.log, lambda x: 1 / x, lambda x: -1 / x**2),
    "sqrt": _smooth(arb.sqrt, lambda x: 1 / (2 * x.sqrt()), lambda x: -1 / (4 * x * x.sqrt()), bend=-1),
    "reciprocal": _smooth(lambda x: 1 / x, lambda x: -1 / x**2, lambda x: 2 / x**3),
    "identity": Function(((None, _line(1.0), None),)),
    "abs": Function(((None, _line(-1.0), 0.0), (0.0, _line(1.0), None))),
    "relu": Function(((None, _line(0.0), 0.0), (0.0, _line(1.0), None))),
}
"""Functions without parameters, by the name under which a certificate records them."""


def leaky_relu(negative_slope: float) -> Function:
    """``max(x, s x)`` for s <= 1, and torch's definition for any s."""
    return Function(((None, _line(negative_slope), 0.0), (0.0, _line(1.0), None)))


def elu(alpha: float) -> Function:
    """``x`` above 0, ``a (exp x - 1)`` below."""
    a = ball(alpha)
    below = Smooth(lambda x: a * x.expm1(), lambda x: a * x.exp(), lambda x: a * x.exp())
    return Function(((None, below, 0.0), (0.0, _line(1.0), None)))


def softplus(beta: float, threshold: float) -> Function:
    """``log(1 + exp(b x)) / b``, or x where ``b x`` exceeds the threshold (both are allowed there)."""
    if not beta > 0:
        raise Unproved(f"softplus needs a positive beta, found {beta}")
    b = ball(beta)
    smooth = Smooth(
        lambda x: (b * x).exp().log1p() / b,
        lambda x: _sigmoid(b * x),
        lambda x: b * _sigmoid(b * x) * _sigmoid(-b * x),
    )
    begin = math.nextafter(threshold / beta, -math.inf)
    return Function(((None, smooth, None), (begin, _line(1.0), None)))


def log_of_sum(a: arb, b: arb) -> arb:
    """``log(exp(a) + exp(b))``."""
    return a.max(b) + (-abs(a - b)).exp().log1p()


SOFTPLUS = _smooth(
    lambda x: x.max(arb(0)) + (-abs(x)).exp().log1p(), _sigmoid, lambda x: _sigmoid(x) * _sigmoid(-x), bend=1
)
"""``log(1 + exp(x))`` throughout."""


def integer_power(exponent: int) -> Function:
    """``x^p``."""
    p = exponent
    return _smooth(lambda x: x**p, lambda x: p * x ** (p - 1), lambda x: p * (p - 1) * x ** (p - 2))


def power(exponent: float) -> Function:
    """``x^p``; for a p that is not whole that of ``x >= 0``."""
    if exponent == int(exponent):
        return integer_power(int(exponent))
    p = ball(exponent)
    return _smooth(
        lambda x: x**p,
        lambda x: p * x ** (p - 1),
        lambda x: p * (p - 1) * x ** (p - 2),
        bend=-1 if 0 < exponent < 1 else 1,
    )


def clamp(low: float, high: float) -> Function:
    """``min(max(x, low), high)``; infinite is no limit; ``high`` where the lower limit is above it."""
    if low > high:
        return Function(((None, _line(0.0, high), None),))
    ends = (low if low > -math.inf else None), (high if high < math.inf else None)
    pieces: list[Piece] = [(ends[0], _line(1.0), ends[1])]
    if ends[0] is not None:
        pieces.append((None, _line(0.0, low), low))
    if ends[1] is not None:
        pieces.append((high, _line(0.0, high), None))
    return Function(tuple(pieces))


def function_of(kind: str, constants: Sequence[float]) -> Function | Staircase | Sawtooth | Rounding:
    """The function of an instruction that has one operand and is not linear; of float32 what is known of it."""
    if kind in JUMPS:
        return JUMPS[kind]
    if kind in ROUNDINGS:
        return ROUNDINGS[kind]
    made = _WITH_NUMBERS.get(kind)
    return FUNCTIONS[kind] if made is None else made(*constants)


_WITH_NUMBERS: dict[str, Callable[..., Function | Sawtooth]] = {
    "leaky_relu": leaky_relu,
    "elu": elu,
    "softplus": softplus,
    "pow": power,
    "remainder": remainder,
    "fmod": fmod,
}
