"""The kinds of instructions of a step program, and what each does to tensors (``docs/program.md`` specifies them).

A vector is the last dimension of a tensor; any batch is in front.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

INPUTS = ("state", "disturbance", "numbers")
"""What a step is given, in the order in which a program begins."""

Function = Callable[..., Any]

OF_ONE: Mapping[str, Function] = {
    "neg": torch.neg,
    "sin": torch.sin,
    "cos": torch.cos,
    "tan": torch.tan,
    "atan": torch.atan,
    "tanh": torch.tanh,
    "sigmoid": torch.sigmoid,
    "silu": nn.functional.silu,
    "gelu": nn.functional.gelu,
    "gelu_tanh": lambda a: nn.functional.gelu(a, approximate="tanh"),
    "mish": nn.functional.mish,
    "softsign": nn.functional.softsign,
    "hardswish": nn.functional.hardswish,
    "erf": torch.erf,
    "exp": torch.exp,
    "log": torch.log,
    "sqrt": torch.sqrt,
    "abs": torch.abs,
    "reciprocal": torch.reciprocal,
    "relu": torch.relu,
    "leaky_relu": lambda a, slope: nn.functional.leaky_relu(a, float(slope)),
    "elu": lambda a, alpha: nn.functional.elu(a, float(alpha)),
    "softplus": lambda a, beta, threshold: nn.functional.softplus(a, float(beta), float(threshold)),
    "pow": lambda a, exponent: torch.pow(a, int(exponent) if exponent == int(exponent) else float(exponent)),
    "clamp": torch.clamp,
    "floor": torch.floor,
    "ceil": torch.ceil,
    "round": torch.round,
    "trunc": torch.trunc,
    "sign": torch.sign,
    "positive": lambda a: (a > 0).to(a),
    "remainder": lambda a, period: torch.remainder(a, float(period)),
    "fmod": lambda a, period: torch.fmod(a, float(period)),
    "wrap": lambda a: torch.atan2(torch.sin(a), torch.cos(a)),
    "identity": lambda a: a,
    "float32": lambda a: _rounded(a),
    "float32_near": lambda a: _rounded(a),
}
"""Functions of one vector, entry by entry, with their constants."""

OF_TWO: Mapping[str, Function] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
    "maximum": torch.maximum,
    "minimum": torch.minimum,
    "atan2": torch.atan2,
    "logaddexp": torch.logaddexp,
}
"""Functions of two vectors, entry by entry; a vector of one entry goes with every entry of the other."""

OF_THREE: Mapping[str, Function] = {"where": lambda c, a, b: torch.where(c > 0, a, b)}
"""Functions of three vectors, entry by entry; the same of vectors of one entry."""

MATRICES = ("linear", "float32_linear")
"""What has a matrix: exact, and as float32 arithmetic computes it, in whatever order it sums."""

FLOAT32 = ("float32", "float32_near", "float32_linear")
"""What stands for float32 arithmetic: a set, of which tensors get one number."""

CONSTANTS: Mapping[str, tuple[str, ...]] = {
    "constant": ("the vector",),
    **dict.fromkeys(MATRICES, ("matrix", "bias")),
    "leaky_relu": ("slope",),
    "elu": ("alpha",),
    "softplus": ("beta", "threshold"),
    "pow": ("exponent",),
    "remainder": ("period",),
    "fmod": ("period",),
    "clamp": ("lower", "upper"),
}
"""The constants of the kinds that have any: vectors as long as the result, the matrix ``(r, c)``, else one number."""

KINDS = (*INPUTS, "constant", "pick", "join", *MATRICES, *OF_THREE, *OF_TWO, *OF_ONE)
"""All of them."""


def linear(value: Tensor, matrix: Tensor, bias: Tensor) -> Tensor:
    """``M a + b``."""
    return torch.nn.functional.linear(value, matrix, bias)


def float32_linear(value: Tensor, matrix: Tensor, bias: Tensor) -> Tensor:
    """The same, rounded to float32 once: one of the numbers that float32 arithmetic may give."""
    return _rounded(linear(value, matrix, bias))


def _rounded(value: Tensor) -> Tensor:
    return value.float().to(value.dtype)


def pick(value: Tensor, entries: Sequence[int]) -> Tensor:
    """Entries of a vector; neighbours as a slice, which costs nothing."""
    first, stop = entries[0], entries[0] + len(entries)
    if tuple(entries) == tuple(range(first, stop)):
        return value[..., first:stop]
    return value.index_select(-1, torch.tensor(entries))


def join(parts: Sequence[Tensor]) -> Tensor:
    """Vectors one after the other; those without a batch are repeated for the batch of the others."""
    batch = max((p.shape[:-1] for p in parts), key=len)
    return torch.cat([p if len(p.shape) > len(batch) else p.expand(*batch, p.shape[-1]) for p in parts], dim=-1)
