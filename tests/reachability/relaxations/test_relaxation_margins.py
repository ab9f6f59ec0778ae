"""The stated margins of elementary functions hold: torch against ball arithmetic over many magnitudes."""

import math

import numpy as np
import pytest
import torch
from flint import arb
from torch import nn

from sagemp_cli.reachability.relaxations import (
    arctangent,
    elu,
    error_function,
    exponential,
    gelu,
    hardswish,
    logarithm,
    mish,
    power,
    reciprocal,
    silu,
    sine,
    softplus,
    softsign,
    square_root,
    tangent,
    tanh,
)
from sagemp_cli.reachability.relaxations.functions import functions_of

from .relaxation_cases import _gelu_tanh, _mish, flint_precision

COUNT = 6_000


def _sample(smallest: float, largest: float, *, negative: bool, count: int = COUNT) -> torch.Tensor:
    """Arguments uniform in magnitude's logarithm, with the ordinary range drawn densely as well."""
    generator = torch.Generator().manual_seed(3)
    spread = torch.rand(count, dtype=torch.float64, generator=generator)
    magnitude = 10 ** (math.log10(smallest) + spread * (math.log10(largest) - math.log10(smallest)))
    magnitude[: count // 2] = torch.rand(count // 2, dtype=torch.float64, generator=generator) * min(largest, 8.0)
    magnitude = magnitude.clamp(smallest, largest)
    sign = torch.randint(2, (count,), generator=generator) * 2 - 1 if negative else 1
    return magnitude * sign


def worst_ulps(computed: torch.Tensor, exact, x: torch.Tensor, *, absolute: bool) -> float:
    """Largest error in units of 2^-52, of the size of the value or of 1."""
    with flint_precision(200):
        errors = []
        for value, argument in zip(computed.tolist(), x.tolist(), strict=True):
            truth = exact(arb(argument))
            scale = arb(1) if absolute else abs(truth)
            # Values that underflow are covered by TINY and by nothing else.
            if not absolute and abs(truth) < 1e-290:
                errors.append(0.0 if abs(value) < 1e-289 else math.inf)
                continue
            errors.append(float(abs(arb(value) - truth) / scale) * 2.0**52)
    return float(np.max(errors))


def _sech_squared(x: arb) -> arb:
    return 1 / x.cosh() ** 2


def _logistic(x: arb) -> arb:
    return 1 / (1 + (-x).exp())


def _softplus(x: arb) -> arb:
    return x + (-x).exp().log1p() if x > 0 else x.exp().log1p()


def _normal(x: arb) -> arb:
    return (-x / arb(2).sqrt()).erfc() / 2


def _gelu_slope(x: arb) -> arb:
    return _normal(x) + x * (-x * x / 2).exp() / (2 * arb.pi()).sqrt()


def _gelu_tanh_slope(x: arb) -> arb:
    c, d = arb(gelu.SCALE), arb(gelu.CUBIC)
    p = 2 * c * (x + d * x**3)
    return _logistic(p) * (1 + x * _logistic(-p) * 2 * c * (1 + 3 * d * x**2))


def _mish_slope(x: arb) -> arb:
    inner = _softplus(x)
    return inner.tanh() + x * _logistic(x) / inner.cosh() ** 2


def _of_arrays(name: str):
    """What a relaxation uses where it gets arrays."""
    return lambda x: torch.as_tensor(getattr(functions_of(x.numpy()), name)(x.numpy()))


FORMULAS = {
    **{
        f"{name} of arrays": (_of_arrays(name), exact, (1e-300, largest, True), sine.ULPS, True)
        for name, exact, largest in (
            ("sin", lambda x: x.sin(), 1e13),
            ("cos", lambda x: x.cos(), 1e13),
            ("acos", lambda x: x.acos(), 1.0),
            ("asin", lambda x: x.asin(), 1.0),
            ("sinc", lambda x: x.sinc_pi(), 100.0),
        )
    },
    "sin": (torch.sin, lambda x: x.sin(), (1e-300, 1e13, True), sine.ULPS, True),
    "cos": (torch.cos, lambda x: x.cos(), (1e-300, 1e13, True), sine.ULPS, True),
    "acos": (torch.acos, lambda x: x.acos(), (1e-300, 1.0, True), sine.ULPS, True),
    "asin": (torch.asin, lambda x: x.asin(), (1e-300, 1.0, True), sine.ULPS, True),
    "sinc": (torch.sinc, lambda x: x.sinc_pi(), (1e-300, 100.0, True), sine.ULPS, True),
    "tan": (torch.tan, lambda x: x.tan(), (1e-300, 1e9, True), tangent.ULPS, False),
    "tan'": (tangent._derivative, lambda x: 1 + x.tan() ** 2, (1e-300, 1e9, True), tangent.ULPS, False),
    "atan": (torch.atan, lambda x: x.atan(), (1e-300, 1e300, True), arctangent.ULPS, False),
    "atan'": (arctangent._derivative, lambda x: 1 / (1 + x * x), (1e-300, 1e140, True), arctangent.ULPS, False),
    "tanh": (torch.tanh, lambda x: x.tanh(), (1e-300, 1e3, True), tanh.ULPS, False),
    "tanh'": (tanh._derivative, _sech_squared, (1e-300, 300.0, True), tanh.ULPS, False),
    "exp": (torch.exp, lambda x: x.exp(), (1e-300, 700.0, True), exponential.ULPS, False),
    "expm1": (elu._curve(1.0).value, lambda x: x if x > 0 else x.expm1(), (1e-290, 700.0, True), elu.ULPS, False),
    "log": (torch.log, lambda x: x.log(), (1e-300, 1e300, False), logarithm.ULPS, False),
    "sqrt": (torch.sqrt, lambda x: x.sqrt(), (1e-300, 1e300, False), square_root.ULPS, False),
    "sqrt'": (square_root._derivative, lambda x: 1 / (2 * x.sqrt()), (1e-239, 1e300, False), square_root.ULPS, False),
    "reciprocal'": (reciprocal._derivative, lambda x: -1 / (x * x), (1e-140, 1e140, True), reciprocal.ULPS, False),
    "softplus": (softplus._value, _softplus, (1e-300, 600.0, True), softplus.ULPS, False),
    "softplus'": (softplus._derivative, _logistic, (1e-300, 600.0, True), softplus.ULPS, False),
    "silu": (silu._value, lambda x: x * _logistic(x), (1e-290, 600.0, True), silu.ULPS, False),
    "silu'": (
        silu._derivative,
        lambda x: _logistic(x) + x * _logistic(x) * _logistic(-x),
        (1e-300, 600.0, True),
        silu.ULPS * silu.CURVE.derivative_floor,
        True,
    ),
    "erf": (torch.erf, lambda x: x.erf(), (1e-300, 30.0, True), error_function.ULPS, False),
    "erf'": (
        error_function._derivative,
        lambda x: 2 * (-x * x).exp() / arb.pi().sqrt(),
        (1e-300, 30.0, True),
        error_function.ULPS * error_function.CURVE.derivative_floor,
        True,
    ),
    "mish": (mish._value, _mish, (1e-290, 600.0, True), mish.ULPS, False),
    "mish'": (mish._derivative, lambda x: _mish_slope(x), (1e-300, 600.0, True), mish.ULPS, True),
    "softsign": (softsign._value, lambda x: x / (1 + abs(x)), (1e-300, 1e300, True), softsign.ULPS, False),
    "softsign'": (
        softsign._derivative,
        lambda x: 1 / (1 + abs(x)) ** 2,
        (1e-300, 1e140, True),
        2 * softsign.ULPS,
        False,
    ),
    "hardswish": (
        hardswish._value,
        lambda x: x * arb.min(arb.max(x + 3, arb(0)), arb(6)) / 6,
        (1e-290, 1e3, True),
        hardswish.ULPS,
        False,
    ),
    "gelu'": (gelu._derivative, lambda x: _gelu_slope(x), (1e-300, 40.0, True), gelu.ULPS, True),
    "gelu tanh'": (gelu._tanh_derivative, lambda x: _gelu_tanh_slope(x), (1e-300, 40.0, True), gelu.ULPS, True),
    **{
        f"pow {n}": (lambda x, n=n: torch.pow(x, n), lambda x, n=n: x**n, (1e-30, 1e30, True), power.ULPS, False)
        for n in (-3, -2, -1, 2, 3, 4, 7, 9)
    },
    **{
        f"pow {n}": (
            lambda x, n=n: torch.pow(x, n),
            lambda x, n=n: x ** arb(n),
            (1e-30, 1e30, False),
            power.ULPS,
            False,
        )
        for n in (0.3, 1.5, -0.7)
    },
}


@pytest.mark.parametrize("name", FORMULAS)
def test_a_formula_is_within_its_margin(name):
    computed, exact, (smallest, largest, negative), ulps, absolute = FORMULAS[name]
    x = _sample(smallest, largest, negative=negative)
    assert worst_ulps(computed(x), exact, x, absolute=absolute) <= ulps
    # One by one torch takes another path than for whole vectors.
    few = x[:: COUNT // 300]
    assert worst_ulps(torch.stack([computed(v) for v in few]), exact, few, absolute=absolute) <= ulps


def test_the_inflections_and_the_minimum_of_silu_are_right_to_rounding():
    with flint_precision(200):
        for sign in (1, -1):
            before, after = (arb(silu.INFLECTION + sign * d) for d in (-1e-15, 1e-15))
            assert (before * (before / 2).tanh() - 2) * (after * (after / 2).tanh() - 2) < 0
        slopes = [
            _logistic(x) + x * _logistic(x) * _logistic(-x) for x in (arb(silu.LOWEST + d) for d in (-1e-15, 1e-15))
        ]
        assert slopes[0] < 0 < slopes[1]


@pytest.mark.parametrize(
    ("computed", "exact"),
    [(gelu._value, lambda x: x * _normal(x)), (gelu._tanh_value, _gelu_tanh)],
    ids=["erf", "tanh"],
)
def test_gelu_is_within_its_margin_and_what_does_not_depend_on_its_size(computed, exact):
    x = _sample(1e-290, 100.0, negative=True)
    for values, arguments in ((computed(x), x), (torch.stack([computed(v) for v in x[::20]]), x[::20])):
        with flint_precision(200):
            for value, argument in zip(values.tolist(), arguments.tolist(), strict=True):
                truth = exact(arb(argument))
                assert abs(arb(value) - truth) <= gelu.ULPS * arb(2) ** -52 * abs(truth) + gelu.FLOOR


@pytest.mark.parametrize(
    ("slope", "points"),
    [
        (_gelu_slope, (gelu.LOWEST, -gelu.INFLECTION, gelu.INFLECTION)),
        (_gelu_tanh_slope, (gelu.TANH_LOWEST, -gelu.TANH_INFLECTION, gelu.TANH_INFLECTION)),
        (_mish_slope, (mish.LOWEST, *mish.INFLECTIONS)),
    ],
    ids=["gelu", "gelu tanh", "mish"],
)
def test_the_minimum_and_the_inflections_are_right_to_rounding(slope, points):
    h = arb(2) ** -60
    with flint_precision(300):
        lowest, *inflections = points
        assert slope(arb(lowest - 1e-15)) < 0 < slope(arb(lowest + 1e-15))
        for i, point in enumerate(inflections):
            bends = [slope(x + h) - slope(x - h) for x in (arb(point - 3e-15), arb(point + 3e-15))]
            bends = bends if i == 0 else [-b for b in bends]
            assert bends[0] < 0 < bends[1]


def test_the_formulas_of_nn_modules_are_those_that_are_enclosed():
    x = torch.linspace(-30, 30, 601, dtype=torch.float64)
    torch.testing.assert_close(nn.SiLU()(x), silu._value(x), rtol=1e-14, atol=1e-300)
    torch.testing.assert_close(nn.Softplus()(x), softplus._value(x), rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(nn.ELU()(x), elu._curve(1.0).value(x), rtol=1e-14, atol=1e-300)
    for module, value in (
        (nn.GELU(), gelu._value),
        (nn.GELU("tanh"), gelu._tanh_value),
        (nn.Mish(), mish._value),
        (nn.Softsign(), softsign._value),
        (nn.Hardswish(), hardswish._value),
    ):
        torch.testing.assert_close(module(x), value(x), rtol=1e-13, atol=1e-15)
