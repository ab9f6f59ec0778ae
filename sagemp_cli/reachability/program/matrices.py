"""Sums, means, norms and matrix products on traced values."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.program.arithmetic import (
    add,
    add_scaled,
    divide,
    elementwise,
    maximum,
    minimum,
    multiply,
    square,
)
from sagemp_cli.reachability.program.conversions import same_type
from sagemp_cli.reachability.program.value import Traced, answers, exact, is_tensor, unsupported

_LARGEST_MATRIX = 10_000_000
"""Most entries of the matrix that one linear operation may become."""


def _linear(x: Traced, matrix: Tensor, shape: Sequence[int], bias: Tensor | None = None) -> Traced:
    """``matrix @ flattened x + bias`` in the given shape."""
    if matrix.numel() > _LARGEST_MATRIX:
        raise UsageError(
            f"a linear operation of step becomes a matrix of {tuple(matrix.shape)} entries, which is too large"
        )
    operand = x.recorder.operand(x.ids, full=True)
    bias = matrix.new_zeros(len(matrix)) if bias is None else bias
    kind = "float32_linear" if x.recorder.float32 else "linear"
    if x.recorder.float32 and isinstance(operand, Tensor):
        raise UnsupportedOperationError("sums of constants alone are not known in float32; compute them before")
    return x._like(x.recorder.write(kind, [operand], [matrix, bias]).reshape(tuple(shape)))


def _dims(dim: Any, count: int) -> list[int]:
    chosen = range(count) if dim is None else ([dim] if isinstance(dim, int) else list(dim))
    return [d % count for d in (chosen or range(count))] if count else []


@answers("sum")
def total(
    x: Traced, dim: Any = None, keepdim: bool = False, *, axis: Any = None, keepdims: bool = False, dtype: Any = None
) -> Traced:
    """Sum over some dimensions, or all."""
    same_type(dtype)
    if isinstance(dim, (tuple, list)) and any(not isinstance(d, int) for d in dim):
        raise unsupported(f"sum(dim={dim})")
    dims = _dims(axis if dim is None else dim, x.dim())
    shape = torch.zeros(x.shape).sum(dims, keepdim or keepdims).shape if dims else x.shape
    kept = [d for d in range(x.dim()) if d not in dims]
    rows = (
        x.ids.permute(*kept, *dims).reshape(-1, math.prod(x.shape[d] for d in dims)) if x.dim() else x.ids.reshape(1, 1)
    )
    if rows.shape[1] == 1:
        return x._like(rows.reshape(shape).clone())
    matrix = torch.kron(torch.eye(len(rows), dtype=torch.float64), torch.ones(1, rows.shape[1], dtype=torch.float64))
    return _linear(x._like(rows), matrix, shape)


@answers("mean")
def mean(
    x: Traced, dim: Any = None, keepdim: bool = False, *, axis: Any = None, keepdims: bool = False, dtype: Any = None
) -> Traced:
    """Mean over some dimensions, or all."""
    result = total(x, dim, keepdim, axis=axis, keepdims=keepdims, dtype=dtype)
    return divide(result, max(x.numel() // max(result.numel(), 1), 1))


@answers("norm", "linalg_vector_norm", "vector_norm")
def norm(
    x: Traced, p: Any = 2, dim: Any = None, keepdim: bool = False, *, ord: Any = None, dtype: Any = None
) -> Traced:  # noqa: A002
    """Euclidean norm."""
    same_type(dtype)
    kind = p if ord is None else ord
    if kind is not None and kind not in (2, "fro"):
        raise unsupported(f"norm(p={kind})")
    return elementwise("sqrt", total(square(x), dim, keepdim))


@answers("linalg_norm")
def norm_of_vectors(x: Traced, ord: Any = None, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Traced:  # noqa: A002
    """Euclidean norm of vectors, Frobenius norm of matrices; the 2-norm of a matrix is another one."""
    over = (x.dim() if dim is None else 1) if not isinstance(dim, (tuple, list)) else len(dim)
    if over == 2 and ord not in (None, "fro"):
        raise unsupported(f"linalg.norm(ord={ord}) of a matrix")
    return norm(x, ord, dim, keepdim, dtype=dtype)


@answers("linear")
def linear(x: Any, weight: Any, bias: Any = None) -> Traced:
    """``x W^T + b``."""
    if not isinstance(x, Traced) or isinstance(weight, Traced) or isinstance(bias, Traced):
        result = matrix_product(x, weight.transpose(-1, -2) if weight.dim() == 2 else weight)
        return result if bias is None else add(result, bias)
    weight = exact(weight, operation="linear weight")
    shape = torch.nn.functional.linear(torch.zeros(x.shape, dtype=torch.float64), weight).shape
    rows = math.prod(x.shape[:-1])
    matrix = weight if weight.dim() == 2 else weight[None]
    if rows > 1:
        matrix = torch.kron(torch.eye(rows, dtype=torch.float64), matrix)
    offset = None if bias is None else exact(bias, operation="linear bias").expand(shape).reshape(-1)
    return _linear(x, matrix, shape, offset)


@answers("matmul", "mm", "mv", "bmm", "__matmul__", "__rmatmul__")
def matrix_product(a: Any, b: Any) -> Traced:
    """Matrix products, one or both of whose factors are values."""
    if isinstance(a, Traced) and isinstance(b, Traced):
        return _matrix_product(a, b)
    if not isinstance(a, Traced) and not isinstance(b, Traced):
        raise UnsupportedOperationError(
            "the product of two constant matrices is part of an operation; compute it before"
        )
    return _multilinear(torch.matmul, a, b)


def _matrix_product(a: Traced, b: Traced) -> Traced:
    shape = torch.matmul(torch.zeros(a.shape), torch.zeros(b.shape)).shape  # torch's own error if they do not fit
    left = a.ids[None, :] if a.dim() == 1 else a.ids
    right = b.ids[:, None] if b.dim() == 1 else b.ids
    products = multiply(a._like(left[..., :, :, None]), b._like(right[..., None, :, :]))
    return total(products, -2).reshape(shape)


@answers("dot", "inner", "vdot")
def inner(a: Any, b: Any) -> Traced:
    """Scalar products of vectors."""
    if a.ndim != 1 or b.ndim != 1 or len(a) != len(b):
        raise UnsupportedOperationError(
            f"scalar products are supported of two vectors of one length, found {tuple(a.shape)} and {tuple(b.shape)}"
        )
    return total(multiply(a, b))


@answers("outer", "ger")
def outer(a: Any, b: Any) -> Traced:
    """All products of two vectors' entries."""
    return multiply(a[:, None], b[None, :])


@answers("addmm", "addmv", "baddbmm")
def add_matrix_product(c: Any, a: Any, b: Any, *, beta: float = 1, alpha: float = 1) -> Traced:
    """``beta c + alpha a b``."""
    product = matrix_product(a, b)
    scaled = product if alpha == 1 else multiply(product, alpha)
    return scaled if beta == 0 else add_scaled("addmm", scaled, c, beta)


@answers("einsum")
def einsum(equation: Any, *operands: Any) -> Traced:
    """Einstein sums of one value, or of one value and one constant."""
    if len(operands) == 1 and isinstance(operands[0], (list, tuple)):
        operands = tuple(operands[0])
    if not isinstance(equation, str) or len(operands) > 2 or sum(isinstance(o, Traced) for o in operands) != 1:
        raise UnsupportedOperationError(
            "torch operation 'einsum' is supported of one value and at most one constant; "
            "use torch.matmul or products for two values"
        )
    return _multilinear(functools.partial(_einsum, equation), *operands)


def _einsum(equation: str, *operands: Tensor) -> Tensor:
    return torch.einsum(equation, *operands)


@answers("cross")
def cross(a: Any, b: Any, dim: int | None = None) -> Any:
    """Cross product of three-vectors, along the first dimension of three entries."""
    return cross_along(a, b, dim=next((i for i, n in enumerate(a.shape) if n == 3), -1) if dim is None else dim)


@answers("linalg_cross")
def cross_along(a: Any, b: Any, *, dim: int = -1) -> Any:
    """Cross product of three-vectors."""
    if a.shape[dim] != 3 or a.shape != b.shape:
        raise UnsupportedOperationError(
            f"cross products are supported of equal shapes, found {tuple(a.shape)} and {tuple(b.shape)}"
        )
    (a0, a1, a2), (b0, b1, b2) = a.unbind(dim), b.unbind(dim)
    parts = [a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0]
    return torch.stack(parts, dim)


@answers("cumsum")
def running_sum(x: Traced, dim: int, *, dtype: Any = None) -> Traced:
    """Running sums along a dimension."""
    same_type(dtype)
    return _multilinear(functools.partial(torch.cumsum, dim=dim), x)


@answers("diff")
def differences(x: Traced, n: int = 1, dim: int = -1, prepend: Any = None, append: Any = None) -> Traced:
    """Differences of neighbours along a dimension."""
    if n != 1 or prepend is not None or append is not None:
        raise unsupported("diff(n, prepend, append)")
    return _multilinear(functools.partial(torch.diff, dim=dim), x)


def _multilinear(function: Callable[..., Tensor], *operands: Any) -> Traced:
    """A function that is linear in its one value: its matrix has what it gives for the unit vectors as columns.

    Those are exact: each entry is one product with 1 and sums of zeros. Where entries of the constant are summed it is
    not, and refused.
    """
    name = getattr(function, "__name__", "einsum")
    (at,) = [i for i, o in enumerate(operands) if isinstance(o, Traced)]
    x = operands[at]
    fixed = [None if i == at else exact(o, operation=name) for i, o in enumerate(operands)]

    def of(value: Tensor) -> Tensor:
        return function(*(value if i == at else f for i, f in enumerate(fixed)))

    shape = of(torch.zeros(x.shape, dtype=torch.float64)).shape
    units = torch.eye(x.numel(), dtype=torch.float64).reshape(x.numel(), *x.shape)
    matrix = torch.stack([of(unit).reshape(-1) for unit in units], dim=-1)
    terms = [None if f is None else torch.ones_like(f) for f in fixed]
    counts = [function(*(unit if t is None else t for t in terms)) for unit in units] if len(terms) > 1 else []
    if any(bool((c > 1).any()) for c in counts):
        raise UnsupportedOperationError(
            f"torch operation '{name}' sums entries of a constant; sum them before, so that their rounding is part "
            f"of the step"
        )
    return _linear(x, matrix, shape)


def _extreme(name: str) -> None:
    pairwise = {"max": maximum, "min": minimum}[name]

    def fold(x: Traced, dims: list[int], keepdim: bool) -> Traced:
        shape = torch.zeros(x.shape).sum(dims, keepdim).shape if dims else x.shape
        kept = [d for d in range(x.dim()) if d not in dims]
        columns = x.ids.permute(*kept, *dims).reshape(math.prod(x.shape[d] for d in kept), -1).unbind(-1)
        folded = functools.reduce(pairwise, [x._like(c) for c in columns])
        return folded.reshape(shape)

    @answers(name)
    def of_all_or_two(x: Any, other: Any = None, **options: Any) -> Traced:
        if options or (other is not None and not is_tensor(other)):
            raise UnsupportedOperationError(
                f"torch operation '{name}' along a dimension gives indices, which a set does not have; "
                f"use torch.a{name}"
            )
        return fold(x, _dims(None, x.dim()), False) if other is None else pairwise(x, other)

    @answers(f"a{name}")
    def along(x: Traced, dim: Any = (), keepdim: bool = False) -> Traced:
        return fold(x, _dims(dim, x.dim()), keepdim)


_extreme("max")
_extreme("min")
