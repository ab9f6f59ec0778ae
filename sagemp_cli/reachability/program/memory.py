"""What torch itself does with the memory of a value: which results are views, which are copies, how entries lie.

Every operation on recorded values is also run by torch, on tensors that lie in memory exactly as the ids do and
hold the numbers of the example. What torch makes a view of an operand becomes a view of its ids, what torch writes in
place is written into the ids, and what it copies has the strides that torch gives it. So the next operation finds what
it would find, and writing into a result changes what it would change. The numbers are compared as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError

_CLOSE = 1e-10
"""How far the recorded result may be from torch's at the example, relative to 1 plus the largest number involved."""

_CLOSE_IN_FLOAT32 = 1e-4
"""The same in float32; its roundings are compared closely where the program is compared with the step."""

_NARROW = (torch.float32, torch.float16, torch.bfloat16)


def widened(value: Any) -> Any:
    """Tensors of narrow floating-point types as float64, exactly; all else as it is."""
    if isinstance(value, (list, tuple)) and not hasattr(value, "_fields"):
        return type(value)(map(widened, value)) if any(map(_contains_tensor, value)) else value
    return value.detach().to(torch.float64) if isinstance(value, Tensor) and value.dtype in _NARROW else value


def _contains_tensor(value: Any) -> bool:
    return isinstance(value, (Tensor, list, tuple))


class _Block:
    """One piece of memory: the ids in it, torch's numbers in their place, and how often torch has written there."""

    def __init__(self, ids: Tensor, numbers: Tensor) -> None:
        self.ids = ids
        self.numbers = numbers
        self.version = numbers._version

    @property
    def written(self) -> bool:
        return self.numbers._version != self.version


class Example:
    """Torch's own run of one operation.

    Args:
        kind: the type of recorded values.
        native: whether values and constants keep their types, as where values are float32; else all is float64.
    """

    def __init__(self, kind: type, *, native: bool = False) -> None:
        self._kind, self._native = kind, native
        self._blocks: dict[int, _Block] = {}
        self._constants: dict[int, Tensor] = {}
        self._largest: float | None = None  # number among the operands
        self._recorder: Any = None
        self.result: Any = None

    def run(self, function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Example:
        """Call torch. Its errors are the step's."""
        placed = [self._placed(a) for a in args]
        named = {key: self._placed(value) for key, value in kwargs.items()}
        with torch.no_grad():  # a weight may be among the constants
            self.result = function(*placed, **named)
        return self

    def _placed(self, value: Any) -> Any:
        """A value in the memory that it would have; constants as float64."""
        if isinstance(value, self._kind):
            return self._tensor(value)
        if isinstance(value, (list, tuple)) and not hasattr(value, "_fields") and any(map(_contains_tensor, value)):
            return type(value)([self._placed(v) for v in value])
        if isinstance(value, (np.ndarray, np.generic)):
            value = torch.as_tensor(value)
        value = value.detach() if self._native and isinstance(value, Tensor) else widened(value)
        if isinstance(value, Tensor):
            self._constants[value.untyped_storage()._cdata] = value
        return value

    def _tensor(self, value: Any) -> Tensor:
        ids, self._recorder = value.ids, value.recorder
        storage = ids.untyped_storage()
        block = self._blocks.get(storage._cdata)
        if block is None:
            flat = ids.as_strided((storage.nbytes() // ids.element_size(),), (1,), 0)
            numbers = self._recorder.example(flat).to(value.dtype)
            self._blocks[storage._cdata] = block = _Block(flat, numbers)
        return block.numbers.as_strided(ids.size(), ids.stride(), ids.storage_offset())

    @property
    def result_type(self) -> torch.dtype | None:
        """Type of what torch gave; of several tensors that of the first."""
        first = self.result
        while isinstance(first, (list, tuple)) and first:
            first = first[0]
        return first.dtype if isinstance(first, Tensor) else None

    def settle(self, answer: Any, name: str) -> Any:
        """The recorded result in the memory that torch gives it.

        Raises:
            UnsupportedOperationError: it is not what torch gives.
        """
        settled = self._settled(answer, self.result, name)
        for block in self._blocks.values():
            if block.written and not self._same(block.ids, block.numbers):
                raise _other(name, "writes something else in place")
        return settled

    def _settled(self, answer: Any, result: Any, name: str) -> Any:
        if isinstance(answer, (list, tuple)):
            if not isinstance(result, (list, tuple)) or len(result) != len(answer):
                raise _other(name, f"gives a {type(result).__name__}")
            return type(answer)([self._settled(a, r, name) for a, r in zip(answer, result, strict=True)])
        if not isinstance(answer, self._kind):
            return answer
        if not isinstance(result, Tensor) or result.shape != answer.shape:
            found = tuple(result.shape) if isinstance(result, Tensor) else type(result).__name__
            raise _other(name, f"gives shape {found}, recorded was {tuple(answer.shape)}")
        if self._is_constant(result):
            return result  # a view of a constant is that constant, and what is written into it is
        truth, narrow = result.dtype is torch.bool, self._native and result.dtype is torch.float32
        if not (result.dtype is torch.float64 or truth or narrow):
            raise _other(name, f"gives {result.dtype}")
        ids = self._in_memory(answer.ids, result, name)
        if not self._same(ids, result):
            raise _other(name, "gives another number")
        found = type(answer)(answer.recorder, ids, truth=truth)
        found.float32 = narrow
        return found

    def _in_memory(self, ids: Tensor, result: Tensor, name: str) -> Tensor:
        where = result.untyped_storage()._cdata
        for block in self._blocks.values():
            if block.numbers.untyped_storage()._cdata == where:
                view = block.ids.as_strided(result.size(), result.stride(), result.storage_offset())
                if block.written:
                    self._find_largest()
                    # Not copy_: torch may fill memory that several entries share, with the same for all of them.
                    block.ids[_places(block.ids, view)] = ids
                    if not torch.equal(view, ids):
                        raise _other(name, "writes several entries to one place")
                return view
        own = ids.untyped_storage()._cdata
        if any(block.ids.untyped_storage()._cdata == own for block in self._blocks.values()) or (
            ids.stride() != result.stride()
        ):
            if any(stride == 0 and size > 1 for stride, size in zip(result.stride(), result.size(), strict=True)):
                raise _other(name, "gives a view of what is no value of the step")
            return torch.empty_strided(result.size(), result.stride(), dtype=torch.int64).copy_(ids)
        return ids

    def _is_constant(self, result: Any) -> bool:
        return isinstance(result, Tensor) and result.untyped_storage()._cdata in self._constants

    def _find_largest(self) -> float:
        """1, or the largest size of a number among the operands before torch wrote into them."""
        if self._largest is None:
            before = (self._recorder.example(block.ids) for block in self._blocks.values() if block.ids.numel())
            self._largest = max([1.0, *(float(torch.nan_to_num(numbers).abs().amax()) for numbers in before)])
        return self._largest

    def _same(self, ids: Tensor, numbers: Tensor) -> bool:
        recorded, close = self._recorder.example(ids), _CLOSE
        if numbers.dtype is torch.float32:
            close = _CLOSE_IN_FLOAT32
        numbers = numbers.to(recorded.dtype)
        if torch.equal(recorded, numbers):  # the most frequent case by far, and quickly told
            return True
        off = (recorded - numbers).abs() > close * (self._find_largest() + numbers.abs())
        return not bool((off & (ids >= 0)).any())


def _places(block: Tensor, view: Tensor) -> Tensor:
    """Where the entries of a view lie in its block."""
    return torch.arange(len(block)).as_strided(view.size(), view.stride(), view.storage_offset())


def _other(name: str, how: str) -> UnsupportedOperationError:
    return UnsupportedOperationError(f"torch operation '{name}' is not supported in this form: torch {how}")
