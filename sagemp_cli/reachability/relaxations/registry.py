"""Which torch function uses which relaxation: one line per function, and the few that are made of others."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.form import SHARED, Form, Operation, registers
from sagemp_cli.reachability.relaxations import absolute as _absolute
from sagemp_cli.reachability.relaxations import arctangent as _arctangent
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

handles = registers(SHARED)


def _of(module: ModuleType) -> Operation:
    return Operation(module.band, module.lines, module.value_range)


def _scalar(name: str, operation: Operation, *functions: Any) -> None:
    """Register a function of one variable without parameters."""

    @handles(*functions)
    def relax(x: Form, inplace: bool = False) -> Form:
        return x.relaxed(name, operation)


_SINE = Operation(_sine.sine_band, _sine.sine_lines, _sine.sine_range, arrays=True)
_COSINE = Operation(_sine.cosine_band, _sine.cosine_lines, _sine.cosine_range, arrays=True)
_LEAKY_RELU = Operation(_leaky_relu.band, _leaky_relu.lines, _leaky_relu.value_range, arrays=True)
_RECIPROCAL = Operation(_reciprocal.band, _reciprocal.lines, _reciprocal.value_range, arrays=True)
_SOFTPLUS, _ELU, _POWER, _CLAMP = map(_of, (_softplus, _elu, _power, _clamp))

_scalar("sin", _SINE, torch.sin, torch.Tensor.sin)
_scalar("cos", _COSINE, torch.cos, torch.Tensor.cos)
_scalar("tan", _of(_tangent), torch.tan, torch.Tensor.tan)
_scalar("atan", _of(_arctangent), torch.atan, torch.arctan, torch.Tensor.atan, torch.Tensor.arctan)
_scalar("tanh", _of(_tanh), torch.tanh, torch.Tensor.tanh)
_scalar("sigmoid", _of(_sigmoid), torch.sigmoid, torch.Tensor.sigmoid, torch.special.expit)
_scalar("silu", _of(_silu), nn.functional.silu)
_scalar("exp", _of(_exponential), torch.exp, torch.Tensor.exp)
_scalar("log", _of(_logarithm), torch.log, torch.Tensor.log)
_scalar("sqrt", _of(_square_root), torch.sqrt, torch.Tensor.sqrt)
_scalar("abs", _of(_absolute), torch.abs, torch.absolute, torch.Tensor.abs, torch.Tensor.absolute, torch.Tensor.__abs__)
_scalar("reciprocal", _RECIPROCAL, torch.reciprocal, torch.Tensor.reciprocal)


@handles(torch.relu, torch.Tensor.relu, nn.functional.relu)
def relu(x: Form, inplace: bool = False) -> Form:
    """ReLU."""
    return x.relaxed("relu", _LEAKY_RELU, 0.0)


@handles(nn.functional.leaky_relu)
def leaky_relu(x: Form, negative_slope: float = 0.01, inplace: bool = False) -> Form:
    """Leaky ReLU."""
    if not negative_slope <= 1:
        raise UnsupportedOperationError(
            f"leaky_relu is supported with a negative_slope of at most 1, found {negative_slope}"
        )
    return x.relaxed("leaky_relu", _LEAKY_RELU, negative_slope)


@handles(nn.functional.softplus)
def softplus(x: Form, beta: float = 1.0, threshold: float = 20.0) -> Form:
    """Softplus."""
    if not beta > 0:
        raise UnsupportedOperationError(f"softplus is supported with a positive beta, found {beta}")
    return x.relaxed("softplus", _SOFTPLUS, float(beta), float(threshold))


@handles(nn.functional.elu)
def elu(x: Form, alpha: float = 1.0, inplace: bool = False) -> Form:
    """ELU."""
    if alpha != 1:
        raise UnsupportedOperationError(f"elu is supported with alpha 1, found {alpha}")
    return x.relaxed("elu", _ELU)


@handles(torch.square, torch.Tensor.square)
def square(x: Form) -> Form:
    """Square."""
    return power(x, 2)


@handles(torch.pow, torch.Tensor.pow, torch.Tensor.__pow__)
def power(x: Any, exponent: Any) -> Form:
    """Integer powers and the square root."""
    if isinstance(exponent, Tensor) and exponent.numel() == 1:
        exponent = exponent.item()
    if not isinstance(x, Form) or not isinstance(exponent, (int, float)):
        raise UnsupportedOperationError("torch operation 'pow' is supported with a number as exponent")
    if exponent == 0.5:
        return torch.sqrt(x)
    if exponent != int(exponent):
        raise UnsupportedOperationError(f"torch operation 'pow' is supported with integers and 0.5, found {exponent}")
    if exponent == 1:
        return x
    if exponent == 0:
        return x * 0.0 + 1.0
    return x.relaxed(f"pow({int(exponent)})", _POWER, int(exponent))


@handles(torch.clamp, torch.clip, torch.Tensor.clamp, torch.Tensor.clip)
def clamp(x: Any, min: Any = None, max: Any = None) -> Form:  # noqa: A002  (torch's names)
    """Clamp; limits that are forms themselves go through maximum and minimum."""
    if not isinstance(x, Form) or isinstance(min, Form) or isinstance(max, Form):
        x = x if min is None else torch.maximum(x, _tensor(min))
        return x if max is None else torch.minimum(x, _tensor(max))
    low, high = _limit(min, -math.inf), _limit(max, math.inf)
    if isinstance(low, Tensor) or isinstance(high, Tensor):
        shape = np.broadcast_shapes(x.shape, *(v.shape for v in (low, high) if isinstance(v, Tensor)))
        if shape != x.shape:
            x = x + torch.zeros(shape, dtype=torch.float64)
    return x.relaxed("clamp", _CLAMP, low, high)


@handles(torch.clamp_min, torch.Tensor.clamp_min)
def clamp_min(x: Form, min: Any) -> Form:  # noqa: A002
    """Clamp from below."""
    return clamp(x, min)


@handles(torch.clamp_max, torch.Tensor.clamp_max)
def clamp_max(x: Form, max: Any) -> Form:  # noqa: A002
    """Clamp from above."""
    return clamp(x, None, max)


@handles(nn.functional.hardtanh)
def hardtanh(x: Form, min_val: float = -1.0, max_val: float = 1.0, inplace: bool = False) -> Form:
    """Clamp to fixed limits."""
    return clamp(x, min_val, max_val)


@handles(nn.functional.relu6)
def relu6(x: Form, inplace: bool = False) -> Form:
    """Clamp to [0, 6]."""
    return clamp(x, 0.0, 6.0)


@handles(torch.maximum, torch.fmax, torch.Tensor.maximum, torch.Tensor.fmax)
def maximum(a: Any, b: Any) -> Form:
    """``b + relu(a - b)``: what the operands share cancels in the difference."""
    if not isinstance(a, Form):
        a, b = b, a
    return b + relu(a - b) if isinstance(b, Form) else clamp(a, b)


@handles(torch.minimum, torch.fmin, torch.Tensor.minimum, torch.Tensor.fmin)
def minimum(a: Any, b: Any) -> Form:
    """``a - relu(a - b)``."""
    if not isinstance(a, Form):
        a, b = b, a
    return a - relu(a - b) if isinstance(b, Form) else clamp(a, None, b)


@handles(torch.max, torch.Tensor.max)
def larger(a: Form, b: Any = None, **options: Any) -> Form:
    """Torch's two-operand form of max; along a dimension it is not supported."""
    return maximum(a, _operand(b, options, "max"))


@handles(torch.min, torch.Tensor.min)
def smaller(a: Form, b: Any = None, **options: Any) -> Form:
    """Torch's two-operand form of min; along a dimension it is not supported."""
    return minimum(a, _operand(b, options, "min"))


@handles(torch.atan2, torch.arctan2, torch.Tensor.atan2, torch.Tensor.arctan2)
def arctangent2(y: Any, x: Any) -> Form:
    """Angle of the point (x, y)."""
    zero = 0.0 * (y if isinstance(y, Form) else x)
    y, x = (v if isinstance(v, Form) else zero + _tensor(v) for v in (y, x))
    if y.shape != x.shape:
        y, x = y + 0.0 * x, x + 0.0 * y
    return y.angle(x)


def _tensor(value: Any) -> Any:
    return value if isinstance(value, Form) else torch.as_tensor(value, dtype=torch.float64)


def _limit(value: Any, missing: float) -> float | Tensor:
    if value is None:
        return missing
    return value.to(torch.float64) if isinstance(value, Tensor) else float(value)


def _operand(value: Any, options: dict[str, Any], name: str) -> Any:
    if options or not isinstance(value, (Form, Tensor)):
        raise UnsupportedOperationError(
            f"torch operation '{name}' is supported with two operands (torch.{name}imum), not along a dimension"
        )
    return value
