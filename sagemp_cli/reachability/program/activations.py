"""What the activations of ``torch.nn`` and functions near them are made of."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.program.arithmetic import add, clamp, divide, elementwise, leaky_relu, multiply, subtract
from sagemp_cli.reachability.program.value import ANSWERS, Traced, answers, unsupported

_SELU_ALPHA, _SELU_SCALE = 1.6732632423543772848170429916717, 1.0507009873554804934193349852946

SOFTPLUS_THRESHOLD = 50.0
"""Where the softplus of a logarithm of a logistic function is its argument, which differs from it by 2e-22."""


def _function(kind: str, *names: str) -> None:
    """A function of one value without constants."""

    @answers(kind, *names)
    def answer(x: Traced, inplace: bool = False) -> Traced:
        return elementwise(kind, x)


_function("mish")
_function("softsign")
_function("hardswish")
_function("erf", "special_erf")


@answers("gelu")
def gelu(x: Traced, approximate: str = "none") -> Traced:
    """GELU, or its tanh form."""
    return elementwise("gelu_tanh" if approximate == "tanh" else "gelu", x, name="gelu")


@answers("elu")
def elu(x: Traced, alpha: float = 1.0, inplace: bool = False) -> Traced:
    """ELU."""
    if alpha == 0:
        return elementwise("relu", x)
    if not alpha > 0:
        raise UnsupportedOperationError(f"elu is supported with an alpha of at least 0, found {alpha}")
    return elementwise("elu", x, numbers=(alpha,))


@answers("selu")
def selu(x: Traced, inplace: bool = False) -> Traced:
    """A multiple of ELU."""
    return multiply(elu(x, _SELU_ALPHA), _SELU_SCALE)


@answers("celu")
def celu(x: Traced, alpha: float = 1.0, inplace: bool = False) -> Traced:
    """``a elu(x / a)``."""
    if not alpha > 0:
        raise UnsupportedOperationError(f"celu is supported with a positive alpha, found {alpha}")
    return multiply(elu(divide(x, alpha)), alpha)


@answers("prelu")
def prelu(x: Traced, weight: Any) -> Traced:
    """x above 0, a multiple below; of each channel its own."""
    if isinstance(weight, Tensor) and weight.numel() > 1 and x.dim() > 1:
        weight = weight.reshape(-1, *[1] * (x.dim() - 2))
    above = elementwise("relu", x)
    return add(above, multiply(subtract(x, above), weight))


@answers("rrelu")
def rrelu(
    x: Traced, lower: float = 1 / 8, upper: float = 1 / 3, training: bool = False, inplace: bool = False
) -> Traced:
    """Leaky ReLU of the mean slope, once the module is in evaluation mode."""
    if training:
        raise UnsupportedOperationError("rrelu is random in training mode; call .eval() on the module first")
    return leaky_relu(x, (lower + upper) / 2)


@answers("hardsigmoid")
def hardsigmoid(x: Traced, inplace: bool = False) -> Traced:
    """``clamp(x + 3, 0, 6) / 6``."""
    return divide(clamp(add(x, 3.0), 0.0, 6.0), 6.0)


@answers("log_sigmoid", "logsigmoid")
def log_sigmoid(x: Traced) -> Traced:
    """``-softplus(-x)``."""
    return elementwise("neg", elementwise("softplus", elementwise("neg", x), numbers=(1.0, SOFTPLUS_THRESHOLD)))


@answers("softshrink")
def softshrink(x: Traced, lambd: float = 0.5) -> Traced:
    """x less what lies within the limits."""
    return subtract(x, clamp(x, -lambd, lambd))


@answers("tanhshrink")
def tanhshrink(x: Traced) -> Traced:
    """``x - tanh(x)``."""
    return subtract(x, elementwise("tanh", x))


@answers("glu")
def glu(x: Traced, dim: int = -1) -> Traced:
    """The first half, each entry times the logistic function of the second's."""
    a, b = ANSWERS["chunk"](x, 2, dim)
    return multiply(a, elementwise("sigmoid", b))


@answers("erfc", "special_erfc")
def complementary_error(x: Traced) -> Traced:
    """``1 - erf(x)``."""
    return subtract(1.0, elementwise("erf", x))


@answers("expm1", "special_expm1")
def exponential_less_one(x: Traced) -> Traced:
    """``exp(x) - 1``."""
    return subtract(elementwise("exp", x), 1.0)


@answers("log1p", "special_log1p")
def logarithm_of_one_more(x: Traced) -> Traced:
    """``log(1 + x)``."""
    return elementwise("log", add(x, 1.0))


@answers("sinh")
def hyperbolic_sine(x: Traced) -> Traced:
    """``(exp(x) - exp(-x)) / 2``."""
    return divide(subtract(elementwise("exp", x), elementwise("exp", elementwise("neg", x))), 2.0)


@answers("cosh")
def hyperbolic_cosine(x: Traced) -> Traced:
    """``(exp(x) + exp(-x)) / 2``."""
    return divide(add(elementwise("exp", x), elementwise("exp", elementwise("neg", x))), 2.0)


@answers("rsqrt")
def inverse_root(x: Traced) -> Traced:
    """``1 / sqrt(x)``."""
    return elementwise("pow", x, numbers=(-0.5,), name="rsqrt")


# -- what rounds, and what whole periods are taken off -----------------------------------------------------------------

_function("floor")
_function("ceil")
_function("trunc", "fix")
_function("sign", "sgn")


@answers("round", "special_round")
def rounded(x: Traced, decimals: int = 0) -> Traced:
    """The nearest whole number."""
    if decimals:
        raise unsupported(f"round(decimals={decimals})")
    return elementwise("round", x)


@answers("frac")
def fraction(x: Traced) -> Traced:
    """``x - trunc(x)``."""
    return subtract(x, elementwise("trunc", x))


@answers("remainder", "__mod__")
def remainder(x: Any, period: Any) -> Traced:
    """``x - m floor(x / m)``."""
    return _by_period("remainder", x, period)


@answers("fmod")
def fmod(x: Any, period: Any) -> Traced:
    """``x - m trunc(x / m)``."""
    return _by_period("fmod", x, period)


@answers("floor_divide", "__floordiv__")
def floor_divide(x: Any, divisor: Any) -> Traced:
    """The quotient, rounded down."""
    return elementwise("floor", divide(x, divisor), name="floor_divide")


def _by_period(kind: str, x: Any, period: Any) -> Traced:
    if not isinstance(x, Traced) or isinstance(period, Traced):
        raise UnsupportedOperationError(f"torch operation '{kind}' is supported with a number as divisor")
    values = Tensor.tolist(period) if isinstance(period, Tensor) else period
    while isinstance(values, list) and values and all(v == values[0] for v in values):
        values = values[0]
    if not isinstance(values, (int, float)) or not values:
        raise UnsupportedOperationError(
            f"torch operation '{kind}' is supported with one number other than 0 as divisor, found {period}"
        )
    if isinstance(period, Tensor) and period.dim() > x.dim():
        raise unsupported(f"{kind} of a divisor of more dimensions")
    if kind == "fmod" or values > 0:
        return elementwise(kind, x, numbers=(abs(float(values)),))
    return elementwise("neg", elementwise(kind, elementwise("neg", x), numbers=(-float(values),)))
