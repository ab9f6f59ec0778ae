"""Which torch function uses which relaxation: one line per function, and the few that are made of others."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.affine_form import AffineForm, handles
from sagemp_cli.reachability.relaxations import absolute as _absolute
from sagemp_cli.reachability.relaxations import arctangent as _arctangent
from sagemp_cli.reachability.relaxations import arctangent2 as _arctangent2
from sagemp_cli.reachability.relaxations import clamp as _clamp
from sagemp_cli.reachability.relaxations import elu as _elu
from sagemp_cli.reachability.relaxations import exponential as _exponential
from sagemp_cli.reachability.relaxations import leaky_relu as _leaky_relu
from sagemp_cli.reachability.relaxations import logarithm as _logarithm
from sagemp_cli.reachability.relaxations import power as _power
from sagemp_cli.reachability.relaxations import reciprocal as _reciprocal
from sagemp_cli.reachability.relaxations import sigmoid as _sigmoid
from sagemp_cli.reachability.relaxations import silu as _silu
from sagemp_cli.reachability.relaxations import sine as _sine
from sagemp_cli.reachability.relaxations import softplus as _softplus
from sagemp_cli.reachability.relaxations import square_root as _square_root
from sagemp_cli.reachability.relaxations import tangent as _tangent
from sagemp_cli.reachability.relaxations import tanh as _tanh
from sagemp_cli.reachability.relaxations.band import Band


def _scalar(name: str, band: Callable[[Tensor, Tensor], Band], *functions: Any) -> None:
    """Register the relaxation of a function of one variable without parameters."""

    @handles(*functions)
    def relax(x: AffineForm, inplace: bool = False) -> AffineForm:
        return x.relaxed(name, band(*x.bounds()))


_scalar("sin", _sine.sine_band, torch.sin, torch.Tensor.sin)
_scalar("cos", _sine.cosine_band, torch.cos, torch.Tensor.cos)
_scalar("tan", _tangent.band, torch.tan, torch.Tensor.tan)
_scalar("atan", _arctangent.band, torch.atan, torch.arctan, torch.Tensor.atan, torch.Tensor.arctan)
_scalar("tanh", _tanh.band, torch.tanh, torch.Tensor.tanh)
_scalar("sigmoid", _sigmoid.band, torch.sigmoid, torch.Tensor.sigmoid, torch.special.expit)
_scalar("silu", _silu.band, nn.functional.silu)
_scalar("exp", _exponential.band, torch.exp, torch.Tensor.exp)
_scalar("log", _logarithm.band, torch.log, torch.Tensor.log)
_scalar("sqrt", _square_root.band, torch.sqrt, torch.Tensor.sqrt)
_scalar("abs", _absolute.band, torch.abs, torch.absolute, torch.Tensor.abs, torch.Tensor.absolute, torch.Tensor.__abs__)
_scalar("reciprocal", _reciprocal.band, torch.reciprocal, torch.Tensor.reciprocal)


@handles(torch.relu, torch.Tensor.relu, nn.functional.relu)
def relu(x: AffineForm, inplace: bool = False) -> AffineForm:
    """ReLU."""
    return x.relaxed("relu", _leaky_relu.band(*x.bounds(), 0.0))


@handles(nn.functional.leaky_relu)
def leaky_relu(x: AffineForm, negative_slope: float = 0.01, inplace: bool = False) -> AffineForm:
    """Leaky ReLU."""
    if not negative_slope <= 1:
        raise UnsupportedOperationError(f"leaky_relu is supported with a negative_slope of at most 1, found {negative_slope}")
    return x.relaxed("leaky_relu", _leaky_relu.band(*x.bounds(), negative_slope))


@handles(nn.functional.softplus)
def softplus(x: AffineForm, beta: float = 1.0, threshold: float = 20.0) -> AffineForm:
    """Softplus."""
    if not beta > 0:
        raise UnsupportedOperationError(f"softplus is supported with a positive beta, found {beta}")
    return x.relaxed("softplus", _softplus.band(*x.bounds(), float(beta), float(threshold)))


@handles(nn.functional.elu)
def elu(x: AffineForm, alpha: float = 1.0, inplace: bool = False) -> AffineForm:
    """ELU."""
    if alpha != 1:
        raise UnsupportedOperationError(f"elu is supported with alpha 1, found {alpha}")
    return x.relaxed("elu", _elu.band(*x.bounds()))


@handles(torch.square, torch.Tensor.square)
def square(x: AffineForm) -> AffineForm:
    """Square."""
    return power(x, 2)


@handles(torch.pow, torch.Tensor.pow, torch.Tensor.__pow__)
def power(x: Any, exponent: Any) -> AffineForm:
    """Integer powers and the square root."""
    if isinstance(exponent, Tensor) and exponent.numel() == 1:
        exponent = exponent.item()
    if not isinstance(x, AffineForm) or not isinstance(exponent, (int, float)):
        raise UnsupportedOperationError("torch operation 'pow' is supported with a number as exponent, not with a tensor")
    if exponent == 0.5:
        return torch.sqrt(x)
    if exponent != int(exponent):
        raise UnsupportedOperationError(f"torch operation 'pow' is supported with integers and 0.5, found {exponent}")
    if exponent == 1:
        return x
    if exponent == 0:
        return x * 0.0 + 1.0
    return x.relaxed(f"pow({int(exponent)})", _power.band(*x.bounds(), int(exponent)))


@handles(torch.clamp, torch.clip, torch.Tensor.clamp, torch.Tensor.clip)
def clamp(x: Any, min: Any = None, max: Any = None) -> AffineForm:  # noqa: A002  (torch's names)
    """Clamp; limits that are forms themselves go through maximum and minimum."""
    if not isinstance(x, AffineForm) or isinstance(min, AffineForm) or isinstance(max, AffineForm):
        x = x if min is None else torch.maximum(x, _tensor(min))
        return x if max is None else torch.minimum(x, _tensor(max))
    low, high = _limit(min, -math.inf), _limit(max, math.inf)
    if isinstance(low, Tensor) or isinstance(high, Tensor):
        shape = torch.broadcast_shapes(x.shape, *(v.shape for v in (low, high) if isinstance(v, Tensor)))
        if shape != x.shape:
            x = x + torch.zeros(shape, dtype=torch.float64)
    return x.relaxed("clamp", _clamp.band(*x.bounds(), low, high))


@handles(torch.clamp_min, torch.Tensor.clamp_min)
def clamp_min(x: AffineForm, min: Any) -> AffineForm:  # noqa: A002
    """Clamp from below."""
    return clamp(x, min)


@handles(torch.clamp_max, torch.Tensor.clamp_max)
def clamp_max(x: AffineForm, max: Any) -> AffineForm:  # noqa: A002
    """Clamp from above."""
    return clamp(x, None, max)


@handles(nn.functional.hardtanh)
def hardtanh(x: AffineForm, min_val: float = -1.0, max_val: float = 1.0, inplace: bool = False) -> AffineForm:
    """Clamp to fixed limits."""
    return clamp(x, min_val, max_val)


@handles(nn.functional.relu6)
def relu6(x: AffineForm, inplace: bool = False) -> AffineForm:
    """Clamp to [0, 6]."""
    return clamp(x, 0.0, 6.0)


@handles(torch.maximum, torch.fmax, torch.Tensor.maximum, torch.Tensor.fmax)
def maximum(a: Any, b: Any) -> AffineForm:
    """``b + relu(a - b)``: what the operands share cancels in the difference."""
    if not isinstance(a, AffineForm):
        a, b = b, a
    return b + relu(a - b) if isinstance(b, AffineForm) else clamp(a, b)


@handles(torch.minimum, torch.fmin, torch.Tensor.minimum, torch.Tensor.fmin)
def minimum(a: Any, b: Any) -> AffineForm:
    """``a - relu(a - b)``."""
    if not isinstance(a, AffineForm):
        a, b = b, a
    return a - relu(a - b) if isinstance(b, AffineForm) else clamp(a, None, b)


@handles(torch.max, torch.Tensor.max)
def larger(a: AffineForm, b: Any = None, **options: Any) -> AffineForm:
    """Torch's two-operand form of max; along a dimension it is not supported."""
    return maximum(a, _operand(b, options, "max"))


@handles(torch.min, torch.Tensor.min)
def smaller(a: AffineForm, b: Any = None, **options: Any) -> AffineForm:
    """Torch's two-operand form of min; along a dimension it is not supported."""
    return minimum(a, _operand(b, options, "min"))


@handles(torch.atan2, torch.arctan2, torch.Tensor.atan2, torch.Tensor.arctan2)
def arctangent2(y: Any, x: Any) -> AffineForm:
    """Angle of the point (x, y)."""
    frame_of = y if isinstance(y, AffineForm) else x
    zero = 0.0 * frame_of
    y, x = y + zero if isinstance(x, AffineForm) else y, x + zero if isinstance(y, AffineForm) else x
    y, x = (v if isinstance(v, AffineForm) else zero + v for v in (y, x))
    form = _arctangent2.quadrant(*y.bounds(), *x.bounds())
    known, upright = form.known.double(), form.upright.double()
    sideways = known * (1.0 - upright)
    quotient = (y * sideways + x * upright) / (x * sideways + y * upright + (1.0 - known))
    return torch.atan(quotient).relaxed("atan2", form.turned)


def _tensor(value: Any) -> Any:
    return value if isinstance(value, AffineForm) else torch.as_tensor(value, dtype=torch.float64)


def _limit(value: Any, missing: float) -> float | Tensor:
    if value is None:
        return missing
    return value.to(torch.float64) if isinstance(value, Tensor) else float(value)


def _operand(value: Any, options: dict[str, Any], name: str) -> Any:
    if options or not isinstance(value, (AffineForm, Tensor)):
        raise UnsupportedOperationError(
            f"torch operation '{name}' is supported with two operands (torch.{name}imum), not along a dimension"
        )
    return value
