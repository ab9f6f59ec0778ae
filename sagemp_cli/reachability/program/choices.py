"""Comparisons, truth values and choices between values.

A truth value is 1 or 0: ``a > b`` is ``positive(a - b)``, and so are all others made of it. A choice keeps what it
compares, ``where(c; a, b)``: a where c is positive, else b. Both are real functions with a jump; what a set makes of
one is the hull of both branches where the set may be on either side, and the branch itself where it is not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.program.arithmetic import add, clamp, elementwise, maximum, minimum, multiply, subtract
from sagemp_cli.reachability.program.value import ANSWERS, Traced, answers, exact, ids_of, recorder_of

_PARTIAL = ("sqrt", "log", "reciprocal", "div", "pow", "tan")
"""Functions that are not defined everywhere."""


def _positive(x: Any) -> Traced:
    return elementwise("positive", x)


def _not(x: Any) -> Traced:
    return subtract(1.0, x)


def _less_than(a: Any, b: Any) -> Traced:
    return _positive(subtract(b, a))


_COMPARED: dict[str, Callable[[Any, Any], Traced]] = {
    "lt less __lt__": _less_than,
    "gt greater __gt__": lambda a, b: _less_than(b, a),
    "ge greater_equal __ge__": lambda a, b: _not(_less_than(a, b)),
    "le less_equal __le__": lambda a, b: _not(_less_than(b, a)),
    "ne not_equal __ne__": lambda a, b: _positive(elementwise("abs", subtract(a, b))),
    "eq __eq__": lambda a, b: _not(_positive(elementwise("abs", subtract(a, b)))),
}
for _names, _comparison in _COMPARED.items():
    for _name in _names.split():
        ANSWERS[_name] = _comparison


@answers("logical_not", "bitwise_not", "__invert__")
def negation(x: Traced) -> Traced:
    """Not."""
    return _not(x)


@answers("logical_and", "bitwise_and", "__and__", "__rand__")
def conjunction(a: Any, b: Any) -> Traced:
    """And."""
    return minimum(_number(a), _number(b))


@answers("logical_or", "bitwise_or", "__or__", "__ror__")
def disjunction(a: Any, b: Any) -> Traced:
    """Or."""
    return maximum(_number(a), _number(b))


@answers("logical_xor", "bitwise_xor", "__xor__", "__rxor__")
def exclusion(a: Any, b: Any) -> Traced:
    """One of both."""
    return elementwise("abs", subtract(_number(a), _number(b)))


def _number(value: Any) -> Any:
    """Constants that are truth values as numbers."""
    return value.double() if isinstance(value, Tensor) and not isinstance(value, Traced) else value


@answers("where")
def where(condition: Any, a: Any, b: Any) -> Traced:
    """The first value where the condition is true, else the second.

    A branch with a function that is not defined everywhere is computed of what is compared, cut to where the branch
    counts: with ``x > k``, ``sqrt(x)`` of ``max(x, k)``, which is the same there. Every entry has a condition of its
    own, so a branch whose entries depend on what is compared for others is left as it is.
    """
    if _is_truth(a) and not _is_truth(condition):  # as a method
        condition, a = a, condition
    condition, a, b = (Traced(v.recorder, v.ids) if isinstance(v, Traced) else v for v in (condition, a, b))
    if not isinstance(condition, Traced):
        recorder = recorder_of(a, b)
        chosen = torch.as_tensor(condition)
        return Traced(recorder, torch.where(chosen, ids_of(recorder, a, "where"), ids_of(recorder, b, "where")))
    recorder = condition.recorder
    found = recorder.condition_of(condition.ids)
    if found is None:
        return elementwise("where", subtract(condition, 0.5), a, b)
    ids, negated = found
    c, yes, no = condition._like(ids), *((b, a) if negated else (a, b))
    cut = _cut(c)
    olds = torch.cat([v.ids.reshape(-1) for v in (c, *cut[:1])])
    for_yes = torch.cat([v.ids.reshape(-1) for v in (elementwise("relu", c), *cut[1:2])])
    for_no = torch.cat([v.ids.reshape(-1) for v in (clamp(c, None, 0.0), *cut[2:])])
    return elementwise("where", c, _within(yes, c, olds, for_yes), _within(no, c, olds, for_no))


def _is_truth(value: Any) -> bool:
    return isinstance(value, Tensor) and value.dtype is torch.bool


def _cut(c: Traced) -> tuple[Traced, ...]:
    """Of a condition ``x - k > 0`` or ``k - x > 0``: x, and x where it is true and where it is not; else nothing."""
    recorder, olds, levels, signs = c.recorder, [], [], []
    for id_ in c.ids.reshape(-1).tolist():
        made, place = recorder.instruction_of(id_)
        old, level, sign = id_, 0.0, 1.0
        if made.kind in ("sub", "add"):
            parts = [recorder.ids_of_slot(o) for o in made.operands]
            parts = [int(p[place if len(p) > 1 else 0]) for p in parts]
            fixed = [bool(f) for f in recorder.constant_entries(torch.tensor(parts))]
            if any(fixed):
                at = fixed.index(True)
                level = float(recorder.example(torch.tensor(parts[at])))
                old, sign = parts[1 - at], -1.0 if made.kind == "sub" and at == 0 else 1.0
                level = -level if made.kind == "add" else level
        elif made.kind == "neg":
            old, sign = int(recorder.ids_of_slot(made.operands[0])[place]), -1.0
        olds.append(old)
        levels.append(level)
        signs.append(sign)
    if len(set(olds)) != len(olds) or len(set(signs)) != 1:
        return ()
    x = c._like(torch.tensor(olds, dtype=torch.int64).reshape(c.ids.shape))
    limits = torch.tensor(levels, dtype=torch.float64).reshape(c.ids.shape)
    above, below = clamp(x, limits), clamp(x, None, limits)
    return (x, above, below) if signs[0] > 0 else (x, below, above)


def _within(value: Any, condition: Traced, olds: Tensor, news: Tensor) -> Any:
    """A branch computed of other values, if it has a function that is not defined everywhere."""
    if not isinstance(value, Traced):
        return value
    shape = torch.broadcast_shapes(value.shape, condition.shape)
    ids, own = value.ids.expand(shape), condition.ids.expand(shape)
    of = condition.ids.reshape(-1).repeat(len(olds) // condition.numel())
    found = value.recorder.replaced(ids, olds, news, own=own, of=of)
    return value._like(found[0]) if found is not None and set(found[1]) & set(_PARTIAL) else value


@answers("masked_fill")
def masked_fill(x: Any, mask: Any, value: Any) -> Traced:
    """A number where the mask is true."""
    return where(mask, exact(value, operation="masked_fill") if not isinstance(value, Traced) else value, x)


@answers("heaviside")
def heaviside(x: Traced, values: Any) -> Traced:
    """0 below, 1 above, and at 0 the value given."""
    if not isinstance(x, Traced):
        raise UnsupportedOperationError("torch operation 'heaviside' is supported of a value and constants at 0")
    at_0 = subtract(1.0, _positive(elementwise("abs", x)))
    return add(_positive(x), multiply(at_0, values))


@answers("threshold", "_threshold")
def threshold(x: Traced, threshold: float, value: float, inplace: bool = False) -> Traced:
    """The value above the threshold, else a number."""
    return where(_less_than(threshold, x), x, exact(value, operation="threshold"))


@answers("hardshrink")
def hardshrink(x: Traced, lambd: float = 0.5) -> Traced:
    """0 within the limits, else the value."""
    outside = where(_less_than(lambd, x), x, exact(0.0, operation="hardshrink"))
    return where(_less_than(x, -lambd), x, outside)
