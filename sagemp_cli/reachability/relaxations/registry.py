"""Which instruction of a step program uses which relaxation: one line per kind."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from sagemp_cli.reachability.relaxations import absolute as _absolute
from sagemp_cli.reachability.relaxations import arctangent as _arctangent
from sagemp_cli.reachability.relaxations import arctangent2 as _arctangent2
from sagemp_cli.reachability.relaxations import choice as _choice
from sagemp_cli.reachability.relaxations import clamp as _clamp
from sagemp_cli.reachability.relaxations import elu as _elu
from sagemp_cli.reachability.relaxations import error_function as _error_function
from sagemp_cli.reachability.relaxations import exponential as _exponential
from sagemp_cli.reachability.relaxations import float32 as _float32
from sagemp_cli.reachability.relaxations import gelu as _gelu
from sagemp_cli.reachability.relaxations import hardswish as _hardswish
from sagemp_cli.reachability.relaxations import identity as _identity
from sagemp_cli.reachability.relaxations import leaky_relu as _leaky_relu
from sagemp_cli.reachability.relaxations import logarithm as _logarithm
from sagemp_cli.reachability.relaxations import mish as _mish
from sagemp_cli.reachability.relaxations import power as _power
from sagemp_cli.reachability.relaxations import reciprocal as _reciprocal
from sagemp_cli.reachability.relaxations import sawtooth as _sawtooth
from sagemp_cli.reachability.relaxations import sigmoid as _sigmoid
from sagemp_cli.reachability.relaxations import silu as _silu
from sagemp_cli.reachability.relaxations import sine as _sine
from sagemp_cli.reachability.relaxations import softplus as _softplus
from sagemp_cli.reachability.relaxations import softsign as _softsign
from sagemp_cli.reachability.relaxations import square_root as _square_root
from sagemp_cli.reachability.relaxations import staircase as _staircase
from sagemp_cli.reachability.relaxations import tangent as _tangent
from sagemp_cli.reachability.relaxations import tanh as _tanh
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.functions import on_tensors
from sagemp_cli.reachability.relaxations.lines import Lines


class Operation(NamedTuple):
    """The relaxations of one function; every one takes the ends of the interval and the function's parameters.

    Attributes:
        band: around one line.
        lines: one below and one above.
        value_range: of the values.
        arrays: whether the band takes numpy's arrays too.
        ranges: whether the value range does.
    """

    band: Callable[..., Band]
    lines: Callable[..., Lines]
    value_range: Callable[..., tuple[Tensor, Tensor]]
    arrays: bool = False
    ranges: bool = False

    def band_of(self, lower: Any, upper: Any, *parameters: Any) -> Band:
        """The band, of tensors as tensors and of arrays as arrays."""
        if self.arrays or isinstance(lower, Tensor):
            return self.band(lower, upper, *parameters)
        given = [p for p in parameters if isinstance(p, np.ndarray)]
        rest = parameters[len(given) :]
        return on_tensors(lambda low, high, *arrays: self.band(low, high, *arrays, *rest), lower, upper, *given)

    def range_of(self, lower: Any, upper: Any, *parameters: Any) -> tuple[Any, Any]:
        """Bounds of the values, of tensors as tensors and of arrays as arrays."""
        if self.ranges or isinstance(lower, Tensor):
            return self.value_range(lower, upper, *parameters)
        return on_tensors(lambda low, high: self.value_range(low, high, *parameters), lower, upper)


def _of(module: ModuleType, *, arrays: bool = False, ranges: bool = False) -> Operation:
    return Operation(module.band, module.lines, module.value_range, arrays, ranges)


def _steps(steps: _staircase.Staircase) -> Operation:
    return Operation(steps.band, steps.lines, steps.value_range)


OPERATIONS: dict[str, Operation] = {
    "sin": Operation(_sine.sine_band, _sine.sine_lines, _sine.sine_range, arrays=True, ranges=True),
    "cos": Operation(_sine.cosine_band, _sine.cosine_lines, _sine.cosine_range, arrays=True, ranges=True),
    "tan": _of(_tangent),
    "atan": _of(_arctangent),
    "tanh": _of(_tanh),
    "sigmoid": _of(_sigmoid),
    "silu": _of(_silu),
    "gelu": _of(_gelu),
    "gelu_tanh": Operation(_gelu.tanh_band, _gelu.tanh_lines, _gelu.tanh_value_range),
    "mish": _of(_mish),
    "softsign": _of(_softsign),
    "hardswish": _of(_hardswish),
    "erf": _of(_error_function),
    "exp": _of(_exponential),
    "log": _of(_logarithm),
    "sqrt": _of(_square_root),
    "abs": _of(_absolute),
    "reciprocal": _of(_reciprocal, arrays=True),
    "relu": _of(_leaky_relu, arrays=True, ranges=True),
    "leaky_relu": _of(_leaky_relu, arrays=True, ranges=True),
    "elu": _of(_elu),
    "softplus": _of(_softplus),
    "pow": _of(_power),
    "clamp": _of(_clamp, ranges=True),
    "floor": _steps(_staircase.FLOOR),
    "ceil": _steps(_staircase.CEIL),
    "round": _steps(_staircase.ROUND),
    "trunc": _steps(_staircase.TRUNC),
    "sign": _steps(_staircase.SIGN),
    "positive": _steps(_staircase.POSITIVE),
    "remainder": Operation(_sawtooth.remainder_band, _sawtooth.remainder_lines, _sawtooth.remainder_range),
    "fmod": Operation(_sawtooth.fmod_band, _sawtooth.fmod_lines, _sawtooth.fmod_range),
    "wrap": Operation(_sawtooth.wrap_band, _sawtooth.wrap_lines, _sawtooth.wrap_range),
    "identity": _of(_identity, arrays=True, ranges=True),
    "atan2": _of(_arctangent2),
    "where": _of(_choice),
    **dict.fromkeys(_float32.ERRORS, _of(_float32, arrays=True, ranges=True)),
    "float32_linear": Operation(
        _float32.band_within, _float32.lines_within, _float32.widened, arrays=True, ranges=True
    ),
}
"""Of every kind that is not linear, but products and quotients."""


class Relaxation(NamedTuple):
    """A function as an instruction has it.

    Attributes:
        name: under which a proof records it.
        operation: its relaxations.
        parameters: theirs, after the ends of the interval.
    """

    name: str
    operation: Operation
    parameters: tuple[Any, ...] = ()


def relaxation(kind: str, constants: tuple[Tensor, ...] = ()) -> Relaxation:
    """How a function of one vector, or an angle, is relaxed."""
    operation = OPERATIONS[kind]
    if kind == "relu":
        return Relaxation(kind, operation, (0.0,))
    if kind == "pow":
        exponent = float(constants[0])
        whole = int(exponent) if exponent == int(exponent) else exponent
        return Relaxation(f"pow({whole})", operation, (whole,))
    if kind in _float32.ERRORS:
        return Relaxation(kind, operation, _float32.ERRORS[kind])
    if kind == "float32_linear":
        return Relaxation(kind, operation, tuple(c.detach().abs() for c in constants))
    if kind == "clamp" and not all(bool((limit == limit[0]).all()) for limit in constants):
        return Relaxation(kind, operation, constants)
    return Relaxation(kind, operation, tuple(float(c.reshape(-1)[0]) for c in constants))
