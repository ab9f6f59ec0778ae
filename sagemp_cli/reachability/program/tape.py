"""Whether a later step is the earlier one over again, told by the operations that it asks for.

Recording a step costs some tenths of a millisecond for every operation, which a loop of a thousand steps need not pay a
thousand times. What a recording asked for is kept on a tape, in order, with copies of all constants. Another step is
then called on the same values, and every operation gets the answer of the recording without being done. If it asks for
the same operations on the same values and constants in the same order, and returns the same value, then it is the same
program. Constants that are only added to something, or put beside it, may be others: they can be numbers of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import SagempError, UnsupportedOperationError

_ADDED = frozenset(["add", "sub", "subtract", "rsub", "__add__", "__radd__", "__sub__", "__rsub__"])
_JOINED = frozenset(["cat", "concat", "concatenate", "stack"])
"""Functions whose constants may be numbers of the step: their operands, or what is in their first argument."""

Place = tuple[int, ...]
"""Where a constant is: number of the operation, then where among its arguments."""


@dataclass(frozen=True)
class _Named:
    """Stands for a value of the recording."""

    index: int


@dataclass(frozen=True, eq=False)
class _Operation:
    function: Any
    args: Any
    kwargs: Any
    result: Any


class Tape:
    """The operations of one recording.

    Args:
        kind: the type of recorded values.
        numbers: where constants are to be numbers of the step, and which of the recorder's, in what shape.
    """

    def __init__(self, kind: type, numbers: Mapping[Place, tuple[slice, torch.Size]] | None = None) -> None:
        self._kind, self._numbers = kind, dict(numbers or {})
        self._operations: list[_Operation] = []
        self._values: list[Any] = []  # kept alive, so that their identities stay theirs
        self._names: dict[int, int] = {}
        self._inputs: tuple[Any, ...] = ()
        self._result: Any = None
        self._unclear = False  # something was recorded that cannot be told again
        self._next: int | None = None  # the operation that is due, while a step is told again
        self._others: dict[Place, Any] = {}

    def run(self, call: Callable[..., Any], *inputs: Any) -> Any:
        """The recording itself: a step called on recorded values."""
        self._inputs = inputs
        self._name(inputs)
        with _Current(self):
            result = call(*inputs)
        self._result = self._copied(result)
        return result

    def again(self, call: Callable[..., Any]) -> dict[Place, Any] | None:
        """The constants of another step that are not the recording's; None if it may be another program."""
        self._next, self._others = 0, {}
        try:
            with _Current(self):
                result = call(*self._inputs)
            self._match(result, self._result, None)
            self._unclear |= self._next != len(self._operations) or self._inputs[0].recorder.refusal is not None
        except SagempError:  # told again, in full, by whoever records that step by itself
            return None
        finally:
            self._next = None
        return None if self._unclear else self._others

    def constant(self, place: Place) -> Any:
        """What the recording has there."""
        value: Any = self._operations[place[0]].args
        for i in place[1:]:
            value = value[i]
        return value

    def asked(self, function: Any, args: tuple[Any, ...], kwargs: Any, do: Callable[..., Any]) -> Any:
        """What an operation gives: done (``do(*args)``), or told again."""
        if self._next is not None:
            return self._told(self._next, function, args, kwargs)
        number = len(self._operations)
        args = self._placed(args, (number,))
        copies = self._copied(args), self._copied(kwargs)
        with _Current(None):  # operations may be made of others
            result = do(*args)
        self._name(result)
        self._operations.append(_Operation(function, *copies, result))
        return result

    def _told(self, number: int, function: Any, args: tuple[Any, ...], kwargs: Any) -> Any:
        if number >= len(self._operations) or function != self._operations[number].function:
            self._differs()
        operation = self._operations[number]
        name = getattr(function, "__name__", function)
        operands = len(args) if name in _ADDED else int(name in _JOINED)
        if len(args) != len(operation.args):
            self._differs()
        for i, (found, known) in enumerate(zip(args, operation.args, strict=True)):
            self._match(found, known, (number, i) if i < operands else None)
        self._match(kwargs, operation.kwargs, None)
        self._next = number + 1
        return list(operation.result) if isinstance(operation.result, list) else operation.result

    def _differs(self) -> NoReturn:
        self._unclear = True  # also where the step catches the error
        raise UnsupportedOperationError("this step does other operations than the one that was recorded")

    def _name(self, value: Any) -> None:
        if isinstance(value, (list, tuple)):
            for one in value:
                self._name(one)
        elif isinstance(value, self._kind):
            if id(value) not in self._names:
                self._names[id(value)] = len(self._values)
                self._values.append(value)
        elif value is not None:  # a constant that the step may write into
            self._unclear = True

    def _copied(self, value: Any) -> Any:
        """As it is now."""
        if isinstance(value, self._kind):
            name = self._names.get(id(value))
            self._unclear |= name is None
            return _Named(-1 if name is None else name)
        if isinstance(value, dict):
            return {key: self._copied(one) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            copies = [self._copied(one) for one in value]
            return copies if isinstance(value, list) else tuple(copies)
        if isinstance(value, Tensor):
            return value.detach().clone()
        return value.copy() if isinstance(value, np.ndarray) else value

    def _placed(self, value: Any, place: Place) -> Any:
        """Arguments with the step's numbers in their places."""
        if place in self._numbers:
            (entries, shape), any_value = self._numbers[place], self._inputs[0]
            return any_value._like(any_value.recorder.numbers[entries].reshape(shape).clone())
        if isinstance(value, (list, tuple)) and any(p[: len(place)] == place for p in self._numbers):
            return type(value)([self._placed(one, (*place, i)) for i, one in enumerate(value)])
        return value

    def _match(self, found: Any, known: Any, place: Place | None) -> None:
        """Refuse what is not as it was; with a place, note other constants."""
        if isinstance(found, self._kind):
            same = isinstance(known, _Named) and self._names.get(id(found)) == known.index
        elif isinstance(found, dict):
            same = isinstance(known, dict) and list(found) == list(known)
            for key in found if same else ():
                self._match(found[key], known[key], None)
        elif isinstance(found, (list, tuple)):
            kind = list if isinstance(found, list) else tuple
            same = isinstance(known, kind) and len(found) == len(known)
            for i, (one, other) in enumerate(zip(found, known, strict=True) if same else ()):
                self._match(one, other, None if place is None else (*place, i))
        elif isinstance(found, Tensor):
            same = isinstance(known, Tensor) and _alike(found, known)
            if same and not torch.equal(found, known):
                same = self._noted(place, found.detach().clone(), found.is_floating_point())
        elif isinstance(found, np.ndarray):
            same = isinstance(known, np.ndarray) and found.dtype == known.dtype and np.array_equal(found, known)
        else:
            same = type(found) is type(known) and bool(found == known)
            if not same and type(found) is type(known):
                same = self._noted(place, found, isinstance(found, (int, float)) and not isinstance(found, bool))
        if not same:
            self._differs()

    def _noted(self, place: Place | None, constant: Any, number: bool) -> bool:
        if place is None or not number:
            return False
        self._others[place] = constant
        return True


def _alike(a: Tensor, b: Tensor) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.stride() == b.stride()


_CURRENT: ContextVar[Tape | None] = ContextVar("tape", default=None)


class _Current:
    """The tape that operations go to, within this context."""

    def __init__(self, tape: Tape | None) -> None:
        self._tape = tape

    def __enter__(self) -> None:
        self._token = _CURRENT.set(self._tape)

    def __exit__(self, *_: Any) -> None:
        _CURRENT.reset(self._token)


def asked(function: Any, args: tuple[Any, ...], kwargs: Any, do: Callable[..., Any]) -> Any:
    """What an operation on recorded values gives, by way of the tape if there is one."""
    tape = _CURRENT.get()
    return do(*args) if tape is None else tape.asked(function, args, kwargs, do)
