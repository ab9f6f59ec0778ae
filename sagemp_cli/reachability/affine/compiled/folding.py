"""A step of a loop as a short list of nonlinear operations, with all that is linear between them folded into matrices.

Most operations of a step are linear: errors of a lookahead, layers, scales, ``x + dt (...)``. Evaluated on a set, each
costs several tensor operations on a few numbers. So a loop whose steps differ in given numbers only
(:class:`~sagemp_cli.reachability.affine.compiled.foldable_loop.FoldableLoop`)
is evaluated once on :class:`FoldedForm`, values that are known as fixed combinations of the
step's *basic* values: 1, the given numbers, the states, the disturbances, and the results of the nonlinear operations
before. What comes out, the :class:`Plan`, says which nonlinear operations there are and which combinations go into
them; :mod:`sagemp_cli.reachability.affine.compiled.run` evaluates them.

Rounding. A coefficient as computed differs from the exact one by at most ``error`` times its entry in ``sizes``, which
obeys the same recurrences with absolute values: as for :mod:`~sagemp_cli.reachability.affine.form`, entry by entry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.affine.compiled.foldable_loop import FoldableLoop, NotFoldable
from sagemp_cli.reachability.form import ANGLE, Form, Operation, registers
from sagemp_cli.sets.rounding import TINY, UNIT

Kind = Literal["scalar", "product", "quotient", "angle"]


class Combination(NamedTuple):
    """Vectors ``(rows,)`` of values as combinations of the basic ones.

    Attributes:
        matrix, sizes: ``(rows, columns)``; columns are 1, given numbers, states, disturbances, results.
        error: of an entry of the matrix, relative to that of ``sizes``.
    """

    matrix: Tensor
    sizes: Tensor
    error: float


class Node(NamedTuple):
    """A nonlinear operation.

    Attributes:
        kind: "scalar", a function of one variable; "product"; "quotient", whose third operand is the reciprocal of
            the second; or "angle", whose operands are y and x.
        operands: its operands, one after the other.
        size: entries of its result.
        name, operation, parameters: of a function of one variable.
    """

    kind: Kind
    operands: Combination
    size: int
    name: str = ""
    operation: Operation | None = None
    parameters: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Plan:
    """A step.

    Attributes:
        numbers, states, disturbances: how many there are.
        nodes: in the order of evaluation.
        state: the next state.
        control: the control, if the loop says what it is.
    """

    numbers: int
    states: int
    disturbances: int
    nodes: tuple[Node, ...]
    state: Combination
    control: Combination | None

    def split(self, matrix: Tensor) -> tuple[Tensor, ...]:
        """A combination's columns: of 1, given numbers, states, disturbances, and each result that it may read."""
        sizes = [1, self.numbers, self.states, self.disturbances]
        for node in self.nodes:
            if sum(sizes) < matrix.shape[-1]:
                sizes.append(node.size)
        return matrix.split(sizes, dim=-1)


def plan_of(loop: FoldableLoop, given: torch.Size, states: int, disturbances: int) -> Plan:
    """The plan of a loop's steps.

    Args:
        loop: the loop.
        given: shape of a step's numbers, without batch.
        states, disturbances: how many.

    Raises:
        NotFoldable: there is none.
    """
    numbers = math.prod(given)
    width = 1 + numbers + states + disturbances
    noted = _Noted([], width)
    unit = torch.eye(width, dtype=torch.float64)[1:]

    def basic(first: int, *shape: int) -> FoldedForm:
        rows = unit[first : first + math.prod(shape)].reshape(1, *shape, width)  # a batch of one stands for any batch
        return FoldedForm(noted, rows, rows, 0.0)

    after, control = loop.step_given(basic(0, *given), basic(numbers, states), basic(numbers + states, disturbances))
    if not isinstance(after, FoldedForm) or after.shape != (1, states):
        raise NotFoldable
    return Plan(
        numbers,
        states,
        disturbances,
        tuple(noted.nodes),
        after.combination(),
        None if control is None else control.combination(),
    )


@dataclass
class _Noted:
    """The operations so far, and how many basic values there are."""

    nodes: list[Node]
    columns: int

    def result(self, node: Node, shape: torch.Size) -> FoldedForm:
        """Note an operation; its result is basic from here on."""
        self.nodes.append(node)
        self.columns += node.size
        rows = torch.eye(self.columns, dtype=torch.float64)[-node.size :].reshape(*shape, -1)
        return FoldedForm(self, rows, rows, 0.0)


class FoldedForm(Form):
    """An array of fixed combinations of a step's basic values, a batch of one in front.

    Attributes:
        noted: the operations so far.
        rows, sizes, error: as for :class:`Combination`, ``(*shape, columns)``; columns to come are 0.
    """

    __slots__ = ("error", "noted", "rows", "sizes")

    def __init__(self, noted: _Noted, rows: Tensor, sizes: Tensor, error: float) -> None:
        self.noted, self.rows, self.sizes, self.error = noted, rows, sizes, error

    @property
    def shape(self) -> torch.Size:
        """Shape, the batch of one first."""
        return self.rows.shape[:-1]

    def dim(self) -> int:
        """Number of dimensions."""
        return self.rows.dim() - 1

    @property
    def dtype(self) -> torch.dtype:
        """Always float64."""
        return self.rows.dtype

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.rows.device

    def combination(self) -> Combination:
        """All entries as one vector."""
        if self.shape[:1] != (1,):
            raise NotFoldable
        return Combination(self.rows.flatten(0, -2), self.sizes.flatten(0, -2), self.error)

    def moved_by(self, map_: Callable[[Tensor], Tensor]) -> FoldedForm:
        """What a map of tensors that have the columns as one more dimension does to the entries (exact)."""
        return FoldedForm(self.noted, map_(self.rows), map_(self.sizes), self.error)

    def relaxed(self, name: str, operation: Operation, *parameters: Any) -> FoldedForm:
        """The function's result."""
        flat = tuple(p.expand(self.shape).flatten() if isinstance(p, Tensor) else p for p in parameters)
        node = Node("scalar", self.combination(), math.prod(self.shape), name, operation, flat)
        return self.noted.result(node, self.shape)

    def angle(self, x: FoldedForm) -> FoldedForm:
        """The angle of a point."""
        return _of_several("angle", self, x, name="atan2", operation=ANGLE)

    def __getitem__(self, index: Any) -> FoldedForm:
        index = index if isinstance(index, tuple) else (index,)
        if index[:1] != (Ellipsis,) or sum(i is not None for i in index[1:]) >= self.dim():
            raise NotFoldable  # the batch in front is any batch, not this one
        return self.moved_by(lambda t: t[(*index, slice(None))])


FoldedForm.handlers = {}
handles = registers(FoldedForm.handlers)


def _same(*values: Any) -> list[FoldedForm]:
    """Forms and constants as forms with as many columns."""
    noted = next(v.noted for v in values if isinstance(v, FoldedForm))
    width = max(v.rows.shape[-1] for v in values if isinstance(v, FoldedForm))
    forms = []
    for v in values:
        if isinstance(v, FoldedForm):
            forms.append(v.moved_by(lambda t: torch.nn.functional.pad(t, (0, width - t.shape[-1]))))
        else:
            value = torch.as_tensor(v, dtype=torch.float64)[..., None]
            rows = torch.nn.functional.pad(value, (0, width - 1))
            forms.append(FoldedForm(noted, rows, rows.abs(), 0.0))
    return forms


def _tiny(sizes: Tensor) -> Tensor:
    """What absorbs underflow, where there is an entry at all."""
    return TINY * (sizes > 0)


@handles(torch.add, torch.Tensor.add, torch.Tensor.__add__, torch.Tensor.__radd__)
def add(a: Any, b: Any, *, alpha: float = 1) -> FoldedForm:
    """Sum of forms and constants."""
    if alpha != 1:
        b = multiply(b, alpha) if isinstance(b, FoldedForm) else torch.as_tensor(b, dtype=torch.float64) * alpha
    x, y = _same(a, b)
    # Two units: the second is for the rounding of alpha times a constant.
    return FoldedForm(x.noted, x.rows + y.rows, x.sizes + y.sizes, max(x.error, y.error) + 2 * UNIT)


@handles(torch.sub, torch.Tensor.sub, torch.Tensor.__sub__)
def subtract(a: Any, b: Any, *, alpha: float = 1) -> FoldedForm:
    """Difference."""
    return add(a, b, alpha=-alpha)


@handles(torch.rsub, torch.Tensor.__rsub__)
def reverse_subtract(a: Any, b: Any) -> FoldedForm:
    """``b - a``."""
    return add(b, a, alpha=-1)


@handles(torch.neg, torch.Tensor.neg, torch.Tensor.__neg__)
def negate(a: FoldedForm) -> FoldedForm:
    """Negation (exact)."""
    return FoldedForm(a.noted, -a.rows, a.sizes, a.error)


@handles(torch.mul, torch.Tensor.mul, torch.Tensor.__mul__, torch.Tensor.__rmul__)
def multiply(a: Any, b: Any) -> FoldedForm:
    """Product with a constant, or of two forms."""
    if isinstance(a, FoldedForm) and isinstance(b, FoldedForm):
        return _of_several("product", a, b)
    a, b = (a, b) if isinstance(a, FoldedForm) else (b, a)
    value = torch.as_tensor(b, dtype=torch.float64)[..., None]
    return FoldedForm(a.noted, a.rows * value, a.sizes * value.abs() + _tiny(a.sizes), a.error + UNIT)


@handles(torch.div, torch.Tensor.div, torch.true_divide, torch.Tensor.__truediv__)
def divide(a: Any, b: Any) -> FoldedForm:
    """Quotient with a constant denominator, or of two forms."""
    if isinstance(b, FoldedForm):
        reciprocal = torch.reciprocal(b)
        return _of_several("quotient", a, b, reciprocal) if isinstance(a, FoldedForm) else multiply(reciprocal, a)
    value = torch.as_tensor(b, dtype=torch.float64)[..., None]
    return FoldedForm(a.noted, a.rows / value, a.sizes / value.abs() + _tiny(a.sizes), a.error + 2 * UNIT)


def _of_several(kind: Kind, *operands: FoldedForm, **made_of: Any) -> FoldedForm:
    """The result of an operation whose operands are broadcast to one shape."""
    forms = _same(*operands)
    shape = np.broadcast_shapes(*(f.shape for f in forms))
    parts = [f.moved_by(lambda t: t.expand(*shape, -1)).combination() for f in forms]
    matrix, sizes = (torch.cat([part[i] for part in parts]) for i in range(2))
    node = Node(kind, Combination(matrix, sizes, max(f.error for f in forms)), math.prod(shape), **made_of)
    return forms[0].noted.result(node, shape)


@handles(torch.nn.functional.linear)
def linear(x: FoldedForm, weight: Tensor, bias: Tensor | None = None) -> FoldedForm:
    """``x W^T + b``."""
    if x.dim() == 1:
        raise NotFoldable
    sizes = weight.abs() @ x.sizes
    y = FoldedForm(x.noted, weight @ x.rows, sizes + _tiny(sizes), x.error + (weight.shape[-1] + 2) * UNIT)
    return y if bias is None else add(y, bias)


@handles(torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__)
def matrix_product(x: Any, y: Any) -> FoldedForm:
    """``x @ W`` for a constant matrix."""
    if isinstance(y, FoldedForm) or y.dim() != 2:
        raise UnsupportedOperationError("torch.matmul is supported as x @ W with a constant two-dimensional W")
    return linear(x, y.transpose(0, 1))


@handles(torch.sum, torch.Tensor.sum)
def total(x: FoldedForm, dim: Any = None, keepdim: bool = False) -> FoldedForm:
    """Sum over one event dimension."""
    if not isinstance(dim, int):
        raise UnsupportedOperationError(f"torch operation 'sum' is supported over one dimension, found dim={dim}")
    summed = x.moved_by(lambda t: t.sum(_of_columns(dim, x.dim()), keepdim))
    return FoldedForm(x.noted, summed.rows, summed.sizes, x.error + x.shape[dim] * UNIT)


def _of_columns(dim: int, dims: int) -> int:
    """A dimension, counted from the end and behind the batch, where there is one more, the columns.

    Raises:
        NotFoldable: it is counted from the front, or is the batch.
    """
    if not -dims < dim < 0:
        raise NotFoldable
    return dim - 1


@handles(torch.stack)
def stack(values: Sequence[Any], dim: int = 0) -> FoldedForm:
    """Stack forms and constants."""
    return _joined(torch.stack, values, dim)


@handles(torch.cat, torch.concat, torch.concatenate)
def cat(values: Sequence[Any], dim: int = 0) -> FoldedForm:
    """Concatenate forms and constants."""
    return _joined(torch.cat, values, dim)


def _joined(join: Callable[..., Tensor], values: Sequence[Any], dim: int) -> FoldedForm:
    most = max(len(v.shape) for v in values if isinstance(v, FoldedForm))
    forms = [f if f.dim() == most else f.moved_by(lambda t: t[None]) for f in _same(*values)]  # constants lack a batch
    at = _of_columns(dim, most + (join is torch.stack))
    rows, sizes = (join([getattr(f, part) for f in forms], at) for part in ("rows", "sizes"))
    return FoldedForm(forms[0].noted, rows, sizes, max(f.error for f in forms))


@handles(torch.unbind, torch.Tensor.unbind)
def unbind(x: FoldedForm, dim: int = 0) -> tuple[FoldedForm, ...]:
    """Slices along one dimension."""
    at = _of_columns(dim, x.dim())
    return tuple(x.moved_by(lambda t, i=i: t.select(at, i)) for i in range(x.shape[dim]))


@handles(torch.flatten, torch.Tensor.flatten)
def flatten(x: FoldedForm, start_dim: int = 0, end_dim: int = -1) -> FoldedForm:
    """Merge event dimensions."""
    first, last = (_of_columns(dim, x.dim()) for dim in (start_dim, end_dim))
    return x.moved_by(lambda t: t.flatten(first, last))


@handles(torch.unsqueeze, torch.Tensor.unsqueeze)
def unsqueeze(x: FoldedForm, dim: int) -> FoldedForm:
    """Insert a dimension."""
    return x.moved_by(lambda t: t.unsqueeze(_of_columns(dim, x.dim() + 1)))


@handles(torch.squeeze, torch.Tensor.squeeze)
def squeeze(x: FoldedForm, dim: int) -> FoldedForm:
    """Remove a dimension of size one."""
    return x.moved_by(lambda t: t.squeeze(_of_columns(dim, x.dim())))
