"""Every relaxation with its function in ball arithmetic, and the one check of soundness that all tests use."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import flint
import torch
from flint import arb
from torch import Tensor
from torch.nn import functional

from sagemp_cli.reachability.relaxations import (
    absolute,
    arctangent,
    clamp,
    elu,
    error_function,
    exponential,
    gelu,
    hardswish,
    leaky_relu,
    logarithm,
    mish,
    power,
    reciprocal,
    sawtooth,
    sigmoid,
    silu,
    sine,
    softplus,
    softsign,
    square_root,
    staircase,
    tangent,
    tanh,
)

PRECISION = 300


@dataclass(frozen=True)
class Case:
    """A function as torch computes it and as Arb encloses it, with its relaxation.

    ``special``: kinks, inflections, poles, extrema. ``poles(l, u)``: whether the exact interval leaves the domain.
    ``moderate``: intervals where the band must be near the best one.
    """

    name: str
    value: Callable[[Tensor], Tensor]
    exact: Callable[[arb], arb]
    band: Callable
    lines: Callable
    value_range: Callable
    special: tuple[float, ...] = (0.0,)
    undefined: Callable[[float, float], bool] = lambda low, high: False
    moderate: tuple[float, float] = (-4.0, 4.0)
    largest: float = 1e6
    ratio: float = 1.001

    def __str__(self) -> str:
        return self.name


def _logistic(x: arb) -> arb:
    return 1 / (1 + (-x).exp())


def _softplus(x: arb) -> arb:
    return (-abs(x)).exp().log1p() + arb.max(x, arb(0))


def _tan_undefined(low: float, high: float) -> bool:
    with flint_precision():
        turns = [(arb(x) / arb.pi() - arb("0.5")).floor() for x in (low, high)]
        return turns[0] != turns[1]


class flint_precision:  # noqa: N801
    """Ball arithmetic with so many bits."""

    def __init__(self, bits: int = PRECISION):
        self.bits = bits

    def __enter__(self):
        self.before, flint.ctx.prec = flint.ctx.prec, self.bits

    def __exit__(self, *_):
        flint.ctx.prec = self.before


def _real_power_case(n: float) -> Case:
    return Case(
        f"power {n}",
        lambda x: torch.pow(x, n),
        lambda x: x ** arb(n),
        lambda low, high: power.band(low, high, n),
        lambda low, high: power.lines(low, high, n),
        lambda low, high: power.value_range(low, high, n),
        undefined=lambda low, high: low < 0 or (n < 0 and low == 0),
        moderate=(0.0, 3.0) if n > 0 else (0.3, 4.0),
    )


def _elu_case(alpha: float) -> Case:
    return Case(
        f"elu {alpha}",
        lambda x: functional.elu(x, alpha),
        lambda x: x if x > 0 else arb(alpha) * x.expm1(),
        lambda low, high: elu.band(low, high, alpha),
        lambda low, high: elu.lines(low, high, alpha),
        lambda low, high: elu.value_range(low, high, alpha),
    )


def _mish(x: arb) -> arb:
    return x * _softplus(x).tanh()


def _gelu_tanh(x: arb) -> arb:
    return x * _logistic(2 * arb(gelu.SCALE) * (x + arb(gelu.CUBIC) * x**3))


def _staircase_case(name: str, steps: staircase.Staircase, exact: Callable[[arb], arb]) -> Case:
    return Case(
        name, steps.value, exact, steps.band, steps.lines, steps.value_range, special=(0.0, 0.5, -0.5, 1.0, 1.5, -2.0)
    )


def _nearest(x: arb) -> arb:
    found = (x + arb("0.5")).floor()
    return found - 1 if found == x + arb("0.5") and found.unique_fmpz() % 2 else found


def _truncated(x: arb) -> arb:
    return x.floor() if x >= 0 else x.ceil()


def _sawtooth_case(
    name: str, exact: Callable[[arb], arb], of: tuple[Callable, Callable, Callable], *own: float
) -> Case:
    function = {"remainder": torch.remainder, "fmod": torch.fmod, "wrap": lambda x: torch.atan2(x.sin(), x.cos())}[name]
    band, lines, value_range = of
    return Case(
        f"{name} {own}",
        lambda x: function(x, *own),
        exact,
        lambda low, high: band(low, high, *own),
        lambda low, high: lines(low, high, *own),
        lambda low, high: value_range(low, high, *own),
        special=(0.0, *(p * k for p in (own or (math.pi,)) for k in (-3, -1, 1, 2, 5))),
        largest=1e9,
    )


def _power_case(n: int) -> Case:
    return Case(
        f"power {n}",
        lambda x: torch.pow(x, n),
        lambda x: x**n,
        lambda low, high: power.band(low, high, n),
        lambda low, high: power.lines(low, high, n),
        lambda low, high: power.value_range(low, high, n),
        undefined=lambda low, high: n < 0 and low <= 0 <= high,
        moderate=(-3.0, 3.0) if n > 0 else (0.3, 4.0),
    )


def _leaky_case(s: float) -> Case:
    return Case(
        f"leaky relu {s}",
        lambda x: functional.leaky_relu(x, s),
        lambda x: arb.max(x, arb(s) * x),
        lambda low, high: leaky_relu.band(low, high, s),
        lambda low, high: leaky_relu.lines(low, high, s),
        lambda low, high: leaky_relu.value_range(low, high, s),
        largest=1e200,
    )


def _clamp_case(low: float, high: float) -> Case:
    return Case(
        f"clamp [{low}, {high}]",
        lambda x: x.clamp(low, high),
        lambda x: arb.min(arb.max(x, arb(low)), arb(high)),
        lambda a, b: clamp.band(a, b, low, high),
        lambda a, b: clamp.lines(a, b, low, high),
        lambda a, b: clamp.value_range(a, b, low, high),
        special=tuple(v for v in (low, high) if math.isfinite(v)),
        largest=1e200,
    )


def _softplus_case(beta: float, threshold: float, jumps: bool) -> Case:
    def exact(x: arb) -> arb:
        z = arb(beta) * x
        return x if jumps and z > threshold else _softplus(z) / arb(beta)

    return Case(
        f"softplus {beta} {threshold} {'as torch' if jumps else 'smooth'}",
        lambda x: functional.softplus(x, beta, threshold),
        exact,
        lambda low, high: softplus.band(low, high, beta, threshold),
        lambda low, high: softplus.lines(low, high, beta, threshold),
        lambda low, high: softplus.value_range(low, high, beta, threshold),
        special=(0.0, threshold / beta, math.nextafter(threshold / beta, 1e9)),
    )


CASES = [
    _leaky_case(0.0),
    _leaky_case(0.1),
    Case("abs", torch.abs, abs, absolute.band, absolute.lines, absolute.value_range, largest=1e200),
    _clamp_case(-1.0, 1.0),
    _clamp_case(0.0, 6.0),
    _clamp_case(-math.inf, 0.3),
    _clamp_case(-0.7, math.inf),
    Case("tanh", torch.tanh, lambda x: x.tanh(), tanh.band, tanh.lines, tanh.value_range),
    Case("sigmoid", torch.sigmoid, _logistic, sigmoid.band, sigmoid.lines, sigmoid.value_range),
    Case("atan", torch.atan, lambda x: x.atan(), arctangent.band, arctangent.lines, arctangent.value_range),
    _softplus_case(1.0, 20.0, False),
    _softplus_case(1.0, 20.0, True),
    _softplus_case(3.7, 5.0, True),
    Case(
        "silu",
        functional.silu,
        lambda x: x * _logistic(x),
        silu.band,
        silu.lines,
        silu.value_range,
        special=(0.0, -silu.INFLECTION, silu.INFLECTION, silu.LOWEST),
        ratio=1.005,
    ),
    Case(
        "elu",
        functional.elu,
        lambda x: x if x > 0 else x.expm1(),
        elu.band,
        elu.lines,
        elu.value_range,
    ),
    _elu_case(0.3),
    _elu_case(1.7),
    Case(
        "gelu",
        functional.gelu,
        lambda x: x * (-x / arb(2).sqrt()).erfc() / 2,
        gelu.band,
        gelu.lines,
        gelu.value_range,
        special=(0.0, -gelu.INFLECTION, gelu.INFLECTION, gelu.LOWEST),
        ratio=1.005,
    ),
    Case(
        "gelu tanh",
        lambda x: functional.gelu(x, approximate="tanh"),
        _gelu_tanh,
        gelu.tanh_band,
        gelu.tanh_lines,
        gelu.tanh_value_range,
        special=(0.0, -gelu.TANH_INFLECTION, gelu.TANH_INFLECTION, gelu.TANH_LOWEST),
        ratio=1.005,
    ),
    Case(
        "mish",
        functional.mish,
        _mish,
        mish.band,
        mish.lines,
        mish.value_range,
        special=(0.0, *mish.INFLECTIONS, mish.LOWEST),
        ratio=1.005,
    ),
    Case(
        "softsign",
        functional.softsign,
        lambda x: x / (1 + abs(x)),
        softsign.band,
        softsign.lines,
        softsign.value_range,
    ),
    Case(
        "hardswish",
        functional.hardswish,
        lambda x: x * arb.min(arb.max(x + 3, arb(0)), arb(6)) / 6,
        hardswish.band,
        hardswish.lines,
        hardswish.value_range,
        special=(0.0, -3.0, 3.0, -1.5),
        moderate=(-6.0, 6.0),
    ),
    Case("erf", torch.erf, arb.erf, error_function.band, error_function.lines, error_function.value_range),
    Case(
        "exp", torch.exp, lambda x: x.exp(), exponential.band, exponential.lines, exponential.value_range, largest=700.0
    ),
    Case(
        "log",
        torch.log,
        lambda x: x.log(),
        logarithm.band,
        logarithm.lines,
        logarithm.value_range,
        undefined=lambda low, high: low <= 0,
        moderate=(0.2, 5.0),
    ),
    Case(
        "sqrt",
        torch.sqrt,
        lambda x: x.sqrt(),
        square_root.band,
        square_root.lines,
        square_root.value_range,
        undefined=lambda low, high: low < 0,
        moderate=(0.0, 5.0),
    ),
    Case(
        "reciprocal",
        torch.reciprocal,
        lambda x: 1 / x,
        reciprocal.band,
        reciprocal.lines,
        reciprocal.value_range,
        undefined=lambda low, high: low <= 0 <= high,
        moderate=(0.2, 5.0),
    ),
    *(_power_case(n) for n in (2, 3, 4, 7, -1, -2, -3)),
    *(_real_power_case(n) for n in (0.3, 1.5, 2.7, -0.5)),
    Case(
        "sin",
        torch.sin,
        lambda x: x.sin(),
        sine.sine_band,
        sine.sine_lines,
        sine.sine_range,
        special=tuple(0.5 * math.pi * k for k in (-7, -2, -1, 0, 1, 2, 3, 40)),
        moderate=(-9.0, 9.0),
        largest=1e13,
        ratio=1.05,
    ),
    Case(
        "cos",
        torch.cos,
        lambda x: x.cos(),
        sine.cosine_band,
        sine.cosine_lines,
        sine.cosine_range,
        special=tuple(0.5 * math.pi * k for k in (-7, -2, -1, 0, 1, 2, 3, 40)),
        moderate=(-9.0, 9.0),
        largest=1e13,
        ratio=1.05,
    ),
    Case(
        "tan",
        torch.tan,
        lambda x: x.tan(),
        tangent.band,
        tangent.lines,
        tangent.value_range,
        special=tuple(0.5 * math.pi * k for k in (-5, -2, -1, 0, 1, 2, 3)),
        undefined=_tan_undefined,
        moderate=(-1.4, 1.4),
    ),
]

JUMPING = [
    _staircase_case("floor", staircase.FLOOR, arb.floor),
    _staircase_case("ceil", staircase.CEIL, arb.ceil),
    _staircase_case("round", staircase.ROUND, _nearest),
    _staircase_case("trunc", staircase.TRUNC, _truncated),
    _staircase_case("sign", staircase.SIGN, lambda x: arb(1 if x > 0 else -1 if x < 0 else 0)),
    _staircase_case("positive", staircase.POSITIVE, lambda x: arb(1 if x > 0 else 0)),
    *(
        _sawtooth_case(
            "remainder",
            lambda x, m=m: x - arb(m) * (x / arb(m)).floor(),
            (sawtooth.remainder_band, sawtooth.remainder_lines, sawtooth.remainder_range),
            m,
        )
        for m in (0.7, 2 * math.pi)
    ),
    _sawtooth_case(
        "fmod",
        lambda x: x - arb(0.7) * _truncated(x / arb(0.7)),
        (sawtooth.fmod_band, sawtooth.fmod_lines, sawtooth.fmod_range),
        0.7,
    ),
    _sawtooth_case(
        "wrap",
        lambda x: x - 2 * arb.pi() * ((x / arb.pi() - 1) / 2).ceil(),
        (sawtooth.wrap_band, sawtooth.wrap_lines, sawtooth.wrap_range),
    ),
]
"""Functions that jump: no band is close to them."""


def points(case: Case, lower: Tensor, upper: Tensor, slopes: list[Tensor]) -> Tensor:
    """Where a relaxation is most likely to break, ``(B, P)``: ends, kinks and inflections, inside, and the extremes of
    ``f(x) - slope x`` for each slope, found on a grid that is refined twice around the best point."""
    unit = torch.linspace(0.0, 1.0, 65, dtype=torch.float64)
    special = torch.tensor(case.special, dtype=torch.float64)
    fixed = torch.cat([special, torch.nextafter(special, special - 1), torch.nextafter(special, special + 1)])
    fixed = torch.cat([lower[:, None], upper[:, None], fixed.expand(len(lower), -1)], dim=1)
    inside = lower[:, None] + (upper - lower)[:, None] * unit[[3, 17, 32, 40, 58]]
    found = [torch.minimum(torch.maximum(p, lower[:, None]), upper[:, None]) for p in (fixed, inside)]
    for slope in slopes:
        for sign in (1.0, -1.0):
            low, high = lower, upper
            for _ in range(3):
                x = low[:, None] + (high - low)[:, None] * unit
                x = torch.minimum(torch.maximum(x, lower[:, None]), upper[:, None])
                excess = (sign * (case.value(x) - slope[:, None] * x)).nan_to_num(-math.inf)
                best = excess.argmax(1, keepdim=True)
                low = x.gather(1, (best - 1).clamp(min=0))[:, 0]
                high = x.gather(1, (best + 1).clamp(max=64))[:, 0]
            found.append(x.gather(1, best))
    return torch.cat(found, dim=1)


def escapes(case: Case, lower: Tensor, upper: Tensor, relaxation) -> list[str]:
    """Points at which the graph is not certainly inside, in ball arithmetic without tolerance.

    ``relaxation`` is a Band, Lines or a value range (a plain pair), for intervals ``(B,)`` inside the domain.
    """
    parts = [part.tolist() for part in relaxation]
    slopes = [] if len(parts) == 2 else [relaxation[0]] if len(parts) == 3 else [relaxation[0], relaxation[2]]
    found = []
    with flint_precision():
        for b, row in enumerate(points(case, lower, upper, slopes).tolist()):
            numbers = [part[b] for part in parts]
            if any(math.isnan(v) for v in numbers):
                found.append(f"{case} on [{lower[b]}, {upper[b]}]: NaN")
                continue
            for x in dict.fromkeys(row):
                value = case.exact(arb(x))
                if not _holds(value, arb(x), numbers) and not _holds_at_last(case, x, numbers):
                    found.append(
                        f"{case} on [{lower[b]:.17g}, {upper[b]:.17g}] at {x:.17g}: {value.str(20)}, {numbers}"
                    )
    return found


def _holds_at_last(case: Case, x: float, numbers: list[float]) -> bool:
    """The same with enough bits to tell 1 from the cosine of a denormal number."""
    with flint_precision(5000):
        return _holds(case.exact(arb(x)), arb(x), numbers)


def _holds(value: arb, x: arb, numbers: list[float]) -> bool:
    if len(numbers) == 2:
        return _below(numbers[0], value) and _below(-numbers[1], -value)
    if len(numbers) == 3:
        slope, offset, radius = numbers
        return radius == math.inf or bool(abs(value - arb(slope) * x - arb(offset)) <= arb(radius))
    low_slope, low, high_slope, high = numbers
    return _below(low, value - arb(low_slope) * x) and _below(-high, arb(high_slope) * x - value)


def _below(bound: float, value: arb) -> bool:
    return bound == -math.inf or bool(arb(bound) <= value)
