"""Softmax and its kin, and what normalises: shares of exponentials, layers divided by their own spread.

A softmax is written so that nothing overflows: ``sigmoid(x_i - log sum_{j != i} exp x_j)``, with the logarithm of a sum
of exponentials as one operation that grows no faster than its operands. Every entry is there once in a formula, so the
range is exact over a box, and within (0, 1) whatever the set.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.program.arithmetic import add, clamp, divide, elementwise, multiply, square, subtract
from sagemp_cli.reachability.program.conversions import same_type
from sagemp_cli.reachability.program.matrices import mean
from sagemp_cli.reachability.program.value import Traced, answers, exact


@answers("logaddexp")
def log_of_sum(a: Any, b: Any) -> Traced:
    """``log(exp(a) + exp(b))``."""
    return elementwise("logaddexp", a, b)


@answers("logsumexp", "special_logsumexp")
def log_of_sums(x: Traced, dim: Any, keepdim: bool = False) -> Traced:
    """``log(sum exp(x))`` over some dimensions, halves together until one is left."""
    dims = [d % x.dim() for d in ([dim] if isinstance(dim, int) else dim)] if x.dim() else []
    kept = [d for d in range(x.dim()) if d not in dims]
    shape = torch.zeros(x.shape).sum(dims, keepdim).shape if dims else x.shape
    ids = x.ids.permute(*kept, *dims).reshape(math.prod(x.shape[d] for d in kept), -1)
    while ids.shape[1] > 1:
        half = ids.shape[1] // 2
        sums = log_of_sum(x._like(ids[:, :half]), x._like(ids[:, half : 2 * half])).ids
        ids = torch.cat([sums, ids[:, 2 * half :]], dim=1)
    return x._like(ids.reshape(shape).clone())


def _less_others(x: Traced, dim: int | None) -> Traced:
    """Every entry less the logarithm of the sum of the exponentials of all others along a dimension."""
    if dim is None:  # as torch guesses it
        dim = 0 if x.dim() in (0, 1, 3) else 1
    count = x.shape[dim] if x.dim() else 1
    window, width, others, known = x.ids.roll(-1, dim), 1, None, 0  # of so many neighbours that follow, around the ends
    while known < count - 1:
        if (count - 1) & width:
            part = window.roll(-known, dim)
            others = part if others is None else log_of_sum(x._like(others), x._like(part)).ids
            known += width
        if known < count - 1:
            window = log_of_sum(x._like(window), x._like(window.roll(-width, dim))).ids
            width *= 2
    assert others is not None
    return subtract(x, x._like(others))


def _alone(x: Traced, dim: int | None) -> bool:
    """Whether there is only one entry along the dimension."""
    return x.dim() == 0 or x.shape[(0 if x.dim() in (1, 3) else 1) if dim is None else dim] == 1


@answers("softmax", "special_softmax")
def softmax(x: Traced, dim: int | None = None, _stacklevel: int = 3, dtype: Any = None) -> Traced:
    """Shares of exponentials."""
    same_type(dtype)
    return add(multiply(x, 0.0), 1.0) if _alone(x, dim) else elementwise("sigmoid", _less_others(x, dim))


@answers("log_softmax", "special_log_softmax")
def log_softmax(x: Traced, dim: int | None = None, _stacklevel: int = 3, dtype: Any = None) -> Traced:
    """Logarithms of shares of exponentials, as torch finds them: rounded as the entries are and not as the result."""
    same_type(dtype)
    if dim is None:
        dim = 0 if x.dim() in (0, 1, 3) else 1
    return clamp(subtract(x, log_of_sums(x, dim, keepdim=True)), None, 0.0)


@answers("softmin")
def softmin(x: Traced, dim: int | None = None, _stacklevel: int = 3, dtype: Any = None) -> Traced:
    """Softmax of the negative."""
    return softmax(elementwise("neg", x), dim, dtype=dtype)


def _divided(x: Traced, dims: list[int], eps: float, most: float) -> Traced:
    """Values over the root of the mean of their squares, which together allow no larger one than ``most``.

    Raises:
        UnsupportedOperationError: a negative ``eps``, which takes the limit away.
    """
    if not eps >= 0:
        raise UnsupportedOperationError(f"a layer that normalises needs an eps of at least 0, found {eps}")
    size = elementwise("sqrt", add(mean(square(x), dims, keepdim=True), eps))
    return clamp(divide(x, size), -most, most)


def _normalised(x: Traced, dims: list[int], eps: float) -> Traced:
    """Values less their mean over their deviation; of n none is above the root of n - 1."""
    count = math.prod(x.shape[d] for d in dims)
    most = math.nextafter(math.sqrt(count - 1), math.inf)
    return _divided(subtract(x, mean(x, dims, keepdim=True)), dims, eps, most)


def _scaled(x: Traced, weight: Any, bias: Any) -> Traced:
    x = x if weight is None else multiply(x, weight)
    return x if bias is None else add(x, bias)


@answers("layer_norm")
def layer_norm(
    x: Traced, normalized_shape: Any, weight: Any = None, bias: Any = None, eps: float = 1e-5, cudnn_enable: bool = True
) -> Traced:
    """Layer normalisation."""
    dims = list(range(x.dim() - len(tuple(normalized_shape)), x.dim()))
    return _scaled(_normalised(x, dims, eps), weight, bias)


@answers("group_norm")
def group_norm(
    x: Traced, num_groups: int, weight: Any = None, bias: Any = None, eps: float = 1e-5, cudnn_enabled: bool = True
) -> Traced:
    """The same within groups of channels."""
    groups = x._like(x.ids.reshape(x.shape[0], num_groups, -1))
    found = _normalised(groups, [2], eps)
    return _scaled(x._like(found.ids.reshape(x.shape)), *(_of_channels(v, x) for v in (weight, bias)))


@answers("rms_norm")
def rms_norm(x: Traced, normalized_shape: Any, weight: Any = None, eps: float | None = None) -> Traced:
    """Values over the root of the mean of their squares."""
    dims = list(range(x.dim() - len(tuple(normalized_shape)), x.dim()))
    most = math.nextafter(math.sqrt(math.prod(x.shape[d] for d in dims)), math.inf)
    return _scaled(_divided(x, dims, torch.finfo(torch.float64).eps if eps is None else eps, most), weight, None)


@answers("batch_norm")
def batch_norm(
    x: Traced,
    running_mean: Any,
    running_var: Any,
    weight: Any = None,
    bias: Any = None,
    training: bool = False,
    momentum: float = 0.1,
    eps: float = 1e-5,
    cudnn_enabled: bool = True,
) -> Traced:
    """In evaluation mode: linear, with the scale that torch computes from constants alone."""
    if training or running_mean is None or running_var is None:
        raise UnsupportedOperationError(
            "batch_norm depends on the other rows of a batch in training mode; call .eval() on the module first"
        )
    scale = torch.rsqrt(exact(running_var, operation="batch_norm") + eps)
    scale = scale if weight is None else scale * exact(weight, operation="batch_norm")
    return _scaled(subtract(x, _of_channels(running_mean, x)), _of_channels(scale, x), _of_channels(bias, x))


def _of_channels(value: Any, x: Traced) -> Any:
    """Numbers of channels, which are the second dimension."""
    return value.reshape(-1, *[1] * (x.dim() - 2)) if isinstance(value, Tensor) else value
