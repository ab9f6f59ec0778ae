"""What goes into every operation of a step, by interval arithmetic: a second opinion for affine forms.

A form is a centre and what deviates from it, so a sum of squares or of exponentials may reach below 0 where its
interval does not, and a root, a logarithm or a quotient of it has no band. One step on these values gives bounds of all
operands, in the order and under the names that the other propagators evaluate them, to be handed on as hints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.form import Hint, Hints
from sagemp_cli.reachability.form import Form, Handler, Operation
from sagemp_cli.reachability.interval.form import HANDLERS, IntervalForm
from sagemp_cli.reachability.relaxations import registry
from sagemp_cli.sets import Box


class OperandForm(Form):
    """An interval that notes what is done with it.

    Attributes:
        interval: the values.
        noted: the operations so far, of all values of the step.
        batch: dimensions that are no entries.
    """

    __slots__ = ("batch", "interval", "noted")

    def __init__(self, interval: IntervalForm, noted: list[Hint], batch: int) -> None:
        self.interval, self.noted, self.batch = interval, noted, batch

    @property
    def shape(self) -> torch.Size:
        """Shape of either bound."""
        return self.interval.shape

    def dim(self) -> int:
        """Number of dimensions."""
        return self.interval.dim()

    @property
    def dtype(self) -> torch.dtype:
        """Always float64."""
        return self.interval.dtype

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.interval.device

    def relaxed(self, name: str, operation: Operation, *parameters: Any) -> OperandForm:
        """The range of a function's values."""
        self._note(name, self.shape, *self.interval.bounds())
        return self._with(self.interval.relaxed(name, operation, *parameters))

    def angle(self, x: OperandForm) -> OperandForm:
        """The range of the angles."""
        self._note("atan2", self.shape)
        return self._with(self.interval.angle(x.interval))

    def __getitem__(self, index: Any) -> OperandForm:
        return self._with(self.interval[index])

    def _with(self, interval: IntervalForm) -> OperandForm:
        return OperandForm(interval, self.noted, self.batch)

    def _note(self, name: str, shape: torch.Size, *bounds: Tensor) -> None:
        self.noted.append(Hint(name, torch.Size(shape[self.batch :]).numel(), *bounds))


def operands(
    step: Callable[[Any, Any], Any], state: tuple[Tensor, Tensor], disturbance: tuple[Tensor, Tensor]
) -> list[Hint]:
    """Bounds of what goes into every operation of one step, but of products and angles.

    Args:
        step: ``step(x, w)``.
        state: lower and upper bounds, ``(*batch, n)``.
        disturbance: the same, ``(d,)``.
    """
    noted: list[Hint] = []
    batch = state[0].shape[:-1]
    x, w = IntervalForm(*state), IntervalForm(*(side.expand(*batch, -1) for side in disturbance))
    step(OperandForm(x, noted, len(batch)), OperandForm(w, noted, len(batch)))
    return noted


@torch.no_grad()
def sharper(
    step: Callable[[Any, Any], Any],
    state: tuple[Tensor, Tensor],
    disturbance: Box,
    known: Hints | None,
    *,
    where: Tensor,
) -> list[Hint]:
    """What is known of a step's operations, and in some cells what :func:`operands` finds.

    Args:
        step, state: as there.
        disturbance: box ``(d,)``.
        known: from elsewhere.
        where: cells ``(*batch,)``; the others are not disturbed.
    """
    found = []
    for hint in operands(step, state, (disturbance.lower, disturbance.upper)):
        if hint.lower is not None and hint.upper is not None:
            here = where.reshape((*where.shape, *[1] * (hint.lower.dim() - where.dim())))
            lower, upper = torch.where(here, hint.lower, -torch.inf), torch.where(here, hint.upper, torch.inf)
            hint = hint._replace(lower=lower, upper=upper)
        found.append(hint)
    return found if known is None else [a.intersected(b) for a, b in zip(found, known, strict=True)]


def _plain(value: Any) -> Any:
    if isinstance(value, OperandForm):
        return value.interval
    return (
        type(value)(map(_plain, value)) if isinstance(value, (list, tuple)) and not hasattr(value, "numel") else value
    )


def _first(value: Any) -> OperandForm | None:
    if isinstance(value, OperandForm):
        return value
    found = (_first(v) for v in value) if isinstance(value, (list, tuple)) else iter(())
    return next((v for v in found if v is not None), None)


def _wrapped(handler: Handler) -> Handler:
    """What a handler of intervals does, with the notes handed on."""

    def handle(*args: Any, **kwargs: Any) -> Any:
        frame = _first([*args, *kwargs.values()])
        assert frame is not None
        result = handler(*map(_plain, args), **{key: _plain(value) for key, value in kwargs.items()})
        if isinstance(result, tuple):
            return tuple(map(frame._with, result))
        return frame._with(result)

    return handle


def _product(a: Any, b: Any) -> OperandForm:
    if isinstance(a, OperandForm) and isinstance(b, OperandForm):
        a._note("product", torch.Size(np.broadcast_shapes(a.shape, b.shape)))
    return _wrapped(HANDLERS[torch.mul])(a, b)


def _quotient(a: Any, b: Any) -> OperandForm:
    if isinstance(b, OperandForm):
        reciprocal = torch.reciprocal(b)
        if isinstance(a, OperandForm):
            b._note("product", torch.Size(np.broadcast_shapes(a.shape, reciprocal.shape)))
    return _wrapped(HANDLERS[torch.div])(a, b)


def _extreme(of_forms: Handler, of_intervals: Handler) -> Handler:
    """Both say what they are made of; intervals say it best."""

    def handle(a: Any, b: Any) -> OperandForm:
        of_forms(a, b)
        return _wrapped(of_intervals)(a, b)

    return handle


OperandForm.handlers = {function: _wrapped(handler) for function, handler in HANDLERS.items()}
for _function, _handler in HANDLERS.items():
    if _handler is HANDLERS[torch.mul]:
        OperandForm.handlers[_function] = _product
    elif _handler is HANDLERS[torch.div]:
        OperandForm.handlers[_function] = _quotient
    elif _handler is HANDLERS[torch.maximum]:
        OperandForm.handlers[_function] = _extreme(registry.maximum, _handler)
    elif _handler is HANDLERS[torch.minimum]:
        OperandForm.handlers[_function] = _extreme(registry.minimum, _handler)
