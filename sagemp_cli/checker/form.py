"""Affine forms with ball coefficients: the value type on which the checker evaluates a robot's own formulas.

Within one step of the loop every number is a row of balls (see :mod:`~sagemp_cli.checker.zonotope`) over the states,
the disturbances and one variable for each recorded relaxation. Linear operations act on rows. A nonlinear one takes
the next recorded relaxation, *proves* that the recorded line and radius enclose the function over the operand's own
bounds, and gives its variable the radius that it found itself. So the record is never trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from sagemp_cli.checker.balls import Unproved, arb, arb_mat, ball, balls
from sagemp_cli.checker.functions import FUNCTIONS, Function, clamp, elu, integer_power, leaky_relu, softplus
from sagemp_cli.checker.zonotope import Zonotope
from sagemp_cli.errors import UnsupportedOperationError

_UNDERFLOW = 2.0**-800  # a recorded radius may be 0 instead; what goes on is the radius found here

_ZERO = arb(0)

Entry = tuple[float, float, float]
"""A recorded relaxation: slope (of a product the scale), offset and radius."""


class Scalar:
    """One number of a form; its row ends where only zeros would follow."""

    __slots__ = ("row",)

    def __init__(self, row: arb_mat) -> None:
        self.row = row

    def __add__(self, other: Scalar) -> Scalar:
        width = max(self.row.ncols(), other.row.ncols())
        return Scalar(_padded(self.row, width) + _padded(other.row, width))

    def times(self, factor: arb) -> Scalar:
        """The multiple by a number."""
        return Scalar(self.row * factor)


class Step:
    """The variables of one step and the relaxations recorded for it.

    Args:
        states: the set at the beginning of the step; None evaluates at a point, without relaxations.
        lower, upper: W, exact.
        record: recorded operations in order: name and entries.
        matrices: constant matrices of the steps before, by the tensor's id.
    """

    def __init__(
        self,
        states: Zonotope | None,
        lower: Sequence[arb],
        upper: Sequence[arb],
        record: Sequence[tuple[str, Sequence[Entry]]] = (),
        matrices: dict[int, tuple[torch.Tensor, arb_mat]] | None = None,
    ) -> None:
        self.states = states
        self._matrices = {} if matrices is None else matrices
        self._record = iter(record)
        begin = 1 if states is None else 1 + len(states.center)
        self._first = self._next = begin + len(lower)  # column of the first relaxation, of the next one
        self._width = self._next + sum(len(entries) for _, entries in record)
        scalars = []
        for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
            scalar = self.constant((a + b) / 2)
            scalar.row[0, begin + i] = (b - a) / 2
            scalars.append(scalar)
        self.disturbance = Form(self, array_of(scalars))

    def constant(self, value: arb) -> Scalar:
        """A number that depends on nothing."""
        row = arb_mat(1, self._first)
        row[0, 0] = value
        return Scalar(row)

    def state(self) -> Form:
        """The state as a form."""
        assert self.states is not None
        scalars = []
        for i, c in enumerate(self.states.center):
            scalar = self.constant(c)
            scalar.row[0, 1 + i] = 1
            scalars.append(scalar)
        return Form(self, array_of(scalars))

    def bounds(self, rows: arb_mat) -> list[tuple[arb, arb]]:
        """Lower and upper bound of the value of every row."""
        assert self.states is not None
        radii = self.states.radii(rows)
        return [((rows[i, 0] - r).lower(), (rows[i, 0] + r).upper()) for i, r in enumerate(radii)]

    def relax(self, name: str, function: Function, rows: arb_mat) -> arb_mat:
        """``function`` of the value of every row."""
        if self.states is None:
            return self.joined([self.constant(function.value(rows[i, 0])) for i in range(rows.nrows())])
        slopes, found = [], []
        entries = self._take(name, rows.nrows())
        for (lower, upper), entry in zip(self.bounds(rows), entries, strict=True):
            slopes.append(ball(entry[0]))
            found.append(function.excess(slopes[-1], lower, upper))
        flat, width, wider = rows.entries(), rows.ncols(), self._next + rows.nrows()
        scaled: list[arb] = []
        for i, slope in enumerate(slopes):
            scaled += [a * slope for a in flat[i * width : (i + 1) * width]]
            scaled += [_ZERO] * (wider - width)
        out = arb_mat(len(slopes), wider, scaled)
        for i, ((least, most), entry) in enumerate(zip(found, entries, strict=True)):
            self._put(name, out, i, least, most, entry)
        return out

    def apply(self, name: str, function: Function, x: Form) -> Form:
        """``function`` of every entry of a form."""
        return self.split(self.relax(name, function, x.rows()), x.shape)

    def product(self, a: Form, b: Form) -> Form:
        """Product of forms whose deviations X and Y may be correlated: ``X Y = (P^2 - M^2) / 4`` with
        ``P = l X + Y / l`` and ``M = l X - Y / l``, for the recorded scale l as for any other.
        """
        left, right = np.broadcast_arrays(a.values, b.values)
        pairs = list(zip(left.flat, right.flat, strict=True))
        if self.states is None:
            products = [self.constant(x.row[0, 0] * y.row[0, 0]) for x, y in pairs]
            return Form(self, array_of(products, left.shape))
        entries = self._take("product", len(pairs))
        pairs = [tuple(Scalar(_padded(s.row, self._next)) for s in pair) for pair in pairs]
        both = []
        for (x, y), (scale, _, _) in zip(pairs, entries, strict=True):
            if not scale > 0:
                raise Unproved(f"the scale of a product must be positive, found {scale}")
            scaled, other = x.times(ball(scale)), y.times(1 / ball(scale))
            both += [scaled + other, scaled + other.times(arb(-1))]
        radii = self.states.radii(self.joined(both))
        new, wider = [], self._next + len(pairs)
        for i, ((x, y), entry) in enumerate(zip(pairs, entries, strict=True)):
            c, d = x.row[0, 0], y.row[0, 0]
            row = _padded((x.times(d) + y.times(c)).row, wider)
            row[0, 0] = c * d
            self._put("product", row, 0, -(radii[2 * i + 1] ** 2) / 4, radii[2 * i] ** 2 / 4, entry)
            new.append(Scalar(row))
        return Form(self, array_of(new, left.shape))

    def matrix(self, weight: torch.Tensor) -> arb_mat:
        """A constant matrix, exact; the same one at every step."""
        if id(weight) not in self._matrices:
            exact = arb_mat(*weight.shape, balls(weight.detach().double().flatten().tolist()))
            self._matrices[id(weight)] = weight, exact  # the tensor is kept, and with it its id
        return self._matrices[id(weight)][1]

    def finish(self, after: Form) -> arb_mat:
        """The next state's rows over all variables, once every recorded relaxation was used."""
        left = next(self._record, None)
        if left is not None:
            raise Unproved(f"a relaxation of '{left[0]}' is recorded that the loop does not use")
        return _padded(after.rows(), self._width)

    def joined(self, scalars: Sequence[Scalar]) -> arb_mat:
        """Rows as one matrix."""
        if len(scalars) == 1:
            return scalars[0].row
        width = max(s.row.ncols() for s in scalars)
        flat: list[arb] = []
        for s in scalars:
            flat += s.row.entries()
            flat += [_ZERO] * (width - s.row.ncols())
        return arb_mat(len(scalars), width, flat)

    def split(self, rows: arb_mat, shape: tuple[int, ...]) -> Form:
        """A matrix's rows as a form."""
        return Form(self, rows=rows, shape=shape)

    def scalars(self, rows: arb_mat) -> list[Scalar]:
        """A matrix's rows one by one."""
        flat, width = rows.entries(), rows.ncols()
        return [Scalar(arb_mat(1, width, flat[i : i + width])) for i in range(0, len(flat), width)]

    def _take(self, name: str, count: int) -> Sequence[Entry]:
        found, entries = next(self._record, ("nothing", ()))
        if found != name or len(entries) != count:
            raise Unproved(f"the loop has {count} x '{name}' where {len(entries)} x '{found}' is recorded")
        return entries

    def _put(self, name: str, rows: arb_mat, i: int, least: arb, most: arb, entry: Entry) -> None:
        """Add what lies in ``[least, most]`` to row i: the recorded offset and a new variable around it."""
        offset = ball(entry[1])
        radius = (most - offset).max(offset - least).upper()
        if not (radius <= ball(entry[2]) or radius <= ball(_UNDERFLOW)):
            raise Unproved(
                f"a recorded relaxation of '{name}' is wrong: its radius is {float(radius):.9g}, not {entry[2]:.9g}"
            )
        rows[i, 0] = rows[i, 0] + offset
        rows[i, self._next] = radius
        self._next += 1


class Form:
    """An array of :class:`Scalar` that answers torch's operations; no batch dimensions."""

    def __init__(
        self,
        step: Step,
        values: np.ndarray | None = None,
        *,
        rows: arb_mat | None = None,
        shape: tuple[int, ...] | None = None,
    ) -> None:
        self.step, self._values, self._rows = step, values, rows  # either may be made of the other
        self.shape: tuple[int, ...] = values.shape if shape is None else shape

    @property
    def values(self) -> np.ndarray:
        """All entries one by one."""
        if self._values is None:
            self._values = array_of(self.step.scalars(self._rows), self.shape)
        return self._values

    def dim(self) -> int:
        """Number of dimensions."""
        return len(self.shape)

    def rows(self) -> arb_mat:
        """All entries as one matrix."""
        if self._rows is None:
            self._rows = self.step.joined(list(self.values.flat))
        return self._rows

    def __getitem__(self, index: Any) -> Form:
        return Form(self.step, _array(self.values[index]))

    def __add__(self, other: Any) -> Form:
        return Form(self.step, _array(self.values + _values(self.step, other)))

    __radd__ = __add__

    def __neg__(self) -> Form:
        return self * -1.0

    def __sub__(self, other: Any) -> Form:
        return self + -other

    def __rsub__(self, other: Any) -> Form:
        return -self + other

    def __mul__(self, other: Any) -> Form:
        if isinstance(other, Form):
            return self.step.product(self, other)
        return self._scaled(other, lambda factor: factor)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Form:
        if isinstance(other, Form):
            return self._quotient(other)
        return self._scaled(other, lambda factor: 1 / factor)

    def __rtruediv__(self, other: Any) -> Form:
        return self.step.apply("reciprocal", FUNCTIONS["reciprocal"], self) * other

    def __pow__(self, exponent: Any) -> Form:
        if exponent == 0.5:
            return self.step.apply("sqrt", FUNCTIONS["sqrt"], self)
        if not isinstance(exponent, int | float) or exponent != int(exponent):
            raise UnsupportedOperationError(f"the checker knows integer powers and 0.5, found {exponent}")
        p = int(exponent)
        if p in (0, 1):
            return self if p else self * 0.0 + 1.0
        return self.step.apply(f"pow({p})", integer_power(p), self)

    def _quotient(self, other: Form) -> Form:
        """``a / b = q + (a - q b) (1 / b)``, for q near the centres' quotient as for any other."""
        if self.step.states is None:
            return self * self.step.apply("reciprocal", FUNCTIONS["reciprocal"], other)
        left, right = np.broadcast_arrays(self.values, other.values)
        quotients = [float((a.row[0, 0] / b.row[0, 0]).mid()) for a, b in zip(left.flat, right.flat, strict=True)]
        q = np.nan_to_num(np.array(quotients).reshape(left.shape), nan=0.0, posinf=0.0, neginf=0.0)
        rest = self - Form(self.step, right)._scaled(q, lambda factor: factor)
        return rest * self.step.apply("reciprocal", FUNCTIONS["reciprocal"], other) + q

    def _scaled(self, other: Any, change: Callable[[arb], arb]) -> Form:
        factors = _numbers(other)
        left, right = np.broadcast_arrays(self.values, factors)
        scalars = [x.times(change(ball(c))) for x, c in zip(left.flat, right.flat, strict=True)]
        return Form(self.step, array_of(scalars, left.shape))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *args, **kwargs: _handler(name)(self, *args, **kwargs)

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        return _handler(getattr(function, "__name__", str(function)))(*args, **(kwargs or {}))


def _handler(name: str) -> Callable[..., Any]:
    handler = _HANDLERS.get(name.strip("_"))
    if handler is None:
        raise UnsupportedOperationError(
            f"torch operation '{name}' is unknown to the checker; add it in sagemp_cli/checker/form.py"
        )
    return handler


def _padded(rows: arb_mat, width: int) -> arb_mat:
    """Rows with zeros up to that width."""
    old = rows.ncols()
    if old == width:
        return rows
    flat, wider = rows.entries(), []
    for i in range(rows.nrows()):
        wider += flat[i * old : (i + 1) * old]
        wider += [_ZERO] * (width - old)
    return arb_mat(rows.nrows(), width, wider)


def array_of(scalars: Sequence[Scalar], shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Scalars as an array."""
    out = np.empty(len(scalars), dtype=object)
    out[:] = scalars
    return out if shape is None else out.reshape(shape)


def _array(value: Any) -> np.ndarray:
    """An array also where numpy has taken a single scalar out of its array."""
    return value if isinstance(value, np.ndarray) else array_of([value], ())


def _numbers(value: Any) -> np.ndarray:
    return np.asarray(value.detach().double().numpy() if isinstance(value, torch.Tensor) else value, dtype=float)


def _values(step: Step, value: Any) -> np.ndarray:
    """A form's scalars, or exact constants as scalars."""
    if isinstance(value, Form):
        return value.values
    numbers = _numbers(value)
    return array_of([step.constant(ball(v)) for v in numbers.flat], numbers.shape)


def _joined(join: Callable[..., np.ndarray]) -> Callable[..., Form]:
    def joined(values: Sequence[Any], dim: int = 0) -> Form:
        step = next(v.step for v in values if isinstance(v, Form))
        return Form(step, join([_values(step, v) for v in values], axis=dim))

    return joined


def _linear(x: Form, weight: torch.Tensor, bias: torch.Tensor | None = None) -> Form:
    if x.dim() != 1:
        raise UnsupportedOperationError("the checker knows linear layers on vectors only")
    rows = x.step.matrix(weight) * x.rows()
    for i, value in enumerate([] if bias is None else bias.detach().double().tolist()):
        rows[i, 0] = rows[i, 0] + ball(value)
    return x.step.split(rows, (weight.shape[0],))


def _clamp(x: Form, min: float | None = None, max: float | None = None) -> Form:  # noqa: A002  (torch's names)
    if isinstance(min, Form | torch.Tensor) or isinstance(max, Form | torch.Tensor):
        raise UnsupportedOperationError("the checker knows clamp with numbers as limits only")
    return x.step.apply("clamp", clamp(min, max), x)


def _scalar(name: str) -> Callable[..., Form]:
    return lambda x, inplace=False: x.step.apply(name, FUNCTIONS[name], x)


def _leaky_relu(x: Form, negative_slope: float = 0.01, inplace: bool = False) -> Form:
    return x.step.apply("leaky_relu", leaky_relu(negative_slope), x)


def _softplus(x: Form, beta: float = 1.0, threshold: float = 20.0) -> Form:
    return x.step.apply("softplus", softplus(beta, threshold), x)


def _elu(x: Form, alpha: float = 1.0, inplace: bool = False) -> Form:
    return x.step.apply("elu", elu(alpha), x)


_HANDLERS: dict[str, Callable[..., Any]] = {
    **{name: _scalar(name) for name in FUNCTIONS},
    "leaky_relu": _leaky_relu,
    "softplus": _softplus,
    "elu": _elu,
    "clamp": _clamp,
    "hardtanh": lambda x, min_val=-1.0, max_val=1.0, inplace=False: _clamp(x, min_val, max_val),
    "maximum": lambda a, b: b + _scalar("relu")(a - b),
    "minimum": lambda a, b: a - _scalar("relu")(a - b),
    "square": lambda x: x**2,
    "pow": lambda x, exponent: x**exponent,
    "linear": _linear,
    "stack": _joined(np.stack),
    "cat": _joined(np.concatenate),
    "neg": lambda x: -x,
    "add": lambda a, b: a + b if isinstance(a, Form) else b + a,
    "sub": lambda a, b: a - b if isinstance(a, Form) else -b + a,
    "rsub": lambda a, b: b - a,
    "mul": lambda a, b: a * b if isinstance(a, Form) else b * a,
    "div": lambda a, b: a / b if isinstance(a, Form) else b.__rtruediv__(a),
}
"""Torch's functions by name; methods of tensors with a form on the other side arrive under the same names."""
