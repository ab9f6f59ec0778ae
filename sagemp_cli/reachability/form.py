"""What all value types have in common that stand for a set and answer torch's operations.

A propagator evaluates ``loop.step`` once on such values. A type brings its own linear operations (``handlers``) and
one method, :meth:`Form.relaxed`, for what is not linear; the nonlinear functions themselves are written once for all
types, in :mod:`sagemp_cli.reachability.relaxations.registry`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.relaxations import arctangent2 as _arctangent2
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.functions import on_tensors
from sagemp_cli.reachability.relaxations.lines import Lines

Handler = Callable[..., Any]


class Operation(NamedTuple):
    """The relaxations of one scalar function; every one takes the ends of the interval and the function's parameters.

    Attributes:
        band: around one line.
        lines: one below and one above.
        value_range: of the values.
        arrays: whether the band takes numpy's arrays too.
    """

    band: Callable[..., Band]
    lines: Callable[..., Lines]
    value_range: Callable[..., tuple[Tensor, Tensor]]
    arrays: bool = False

    def band_of_arrays(self, lower: np.ndarray, upper: np.ndarray, *parameters: Any) -> Band:
        """The band, of arrays and as arrays."""
        if self.arrays:
            return self.band(lower, upper, *parameters)
        given = [p for p in parameters if isinstance(p, np.ndarray)]
        rest = parameters[len(given) :]
        return on_tensors(lambda low, high, *arrays: self.band(low, high, *arrays, *rest), lower, upper, *given)


ANGLE = Operation(_arctangent2.band, _arctangent2.lines, _arctangent2.value_range)
"""``atan2``, the one function of two operands; its range is of these."""


class Form:
    """A set of values of one shape. Final types have ``shape`` and ``dim()`` as tensors do, batch first.

    There are no bounds to be asked for here, so that what is made of other functions cannot choose them by bounds: a
    step is the same operations whatever the sets, and what is known of an operation in one pass holds in the next.
    """

    __slots__ = ()

    handlers: ClassVar[dict[Any, Handler]]
    """Torch function to its implementation on this type; it goes before :data:`SHARED`."""

    def relaxed(self, name: str, operation: Operation, *parameters: Any) -> Form:
        """What encloses ``f(self)``, entry by entry."""
        raise NotImplementedError

    def angle(self, x: Any) -> Form:
        """What encloses ``atan2(self, x)``, entry by entry; x is of the same type and shape."""
        raise NotImplementedError

    def _call(self, function: Any, *args: Any) -> Any:
        return self.handlers[function](*args)

    def __add__(self, other: Any) -> Any:
        return self._call(torch.add, self, other)

    __radd__ = __add__

    def __neg__(self) -> Any:
        return self._call(torch.neg, self)

    def __sub__(self, other: Any) -> Any:
        return self._call(torch.add, self, -other)

    def __rsub__(self, other: Any) -> Any:
        return self._call(torch.add, -self, other)

    def __mul__(self, other: Any) -> Any:
        return self._call(torch.mul, self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        return torch.div(self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return torch.div(other, self)

    def __pow__(self, exponent: Any) -> Any:
        return torch.pow(self, exponent)

    def __rpow__(self, base: Any) -> Any:
        return torch.pow(base, self)

    def __abs__(self) -> Any:
        return torch.abs(self)

    def __matmul__(self, other: Any) -> Any:
        return torch.matmul(self, other)

    def _write(self, *_: Any) -> Any:
        raise UnsupportedOperationError(
            "a step may not write into a value in place (+=, x[...] = ...): whoever else holds it would keep the old "
            "set; write x = x + y, torch.stack or torch.cat"
        )

    __iadd__ = __isub__ = __imul__ = __itruediv__ = __ipow__ = __setitem__ = _write

    def __bool__(self) -> bool:
        raise UnsupportedOperationError(
            "a step may not branch on a value: the truth of a set is not one of True and False; "
            "use torch.clamp, torch.minimum, torch.maximum or torch.relu"
        )

    def _compare(self, other: Any) -> bool:
        return self.__bool__()

    __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = _compare
    __hash__ = object.__hash__

    def __getattr__(self, name: str) -> Any:
        method = getattr(torch.Tensor, name, None)
        if method is None or name.startswith("__"):
            raise AttributeError(name)
        if not callable(method):
            raise unsupported(name)
        return lambda *args, **kwargs: type(self)._dispatch(method, (self, *args), kwargs)

    @classmethod
    def __torch_function__(
        cls, function: Callable[..., Any], types: Sequence[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        return cls._dispatch(function, args, kwargs or {})

    @classmethod
    def _dispatch(cls, function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        handler = cls.handlers.get(function) or SHARED.get(function)
        name = getattr(function, "__name__", str(function))
        if kwargs.get("inplace") or (handler is None and name.endswith("_") and not name.endswith("__")):
            raise UnsupportedOperationError(
                f"torch operation '{name}' writes into a value in place: whoever else holds it would keep the old set; "
                f"use the operation that gives a new value"
            )
        if handler is None:
            raise unsupported(name)
        return handler(*args, **kwargs)


SHARED: dict[Any, Handler] = {}
"""Torch function to what it does on every type; one line per function."""


def registers(table: dict[Any, Handler]) -> Callable[..., Callable[[Handler], Handler]]:
    """A decorator ``@...(functions)`` that enters an implementation into a table of handlers."""

    def handles(*functions: Any) -> Callable[[Handler], Handler]:
        def register(implementation: Handler) -> Handler:
            for f in functions:
                table[f] = implementation
            return implementation

        return register

    return handles


def unsupported(name: str) -> UnsupportedOperationError:
    """The error for a torch operation that nothing is known of."""
    return UnsupportedOperationError(
        f"torch operation '{name}' has no relaxation in the native propagators (affine, crown, interval); "
        f"add one in sagemp_cli/reachability/relaxations and register it in its registry.py"
    )
