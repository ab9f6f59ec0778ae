"""Whatever only moves entries of traced values, repeats them, drops them, or puts constants beside them."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.program.conversions import same_type
from sagemp_cli.reachability.program.recorder import Recorder
from sagemp_cli.reachability.program.value import (
    ANSWERS,
    ANSWERS_OF_MOVES,
    Traced,
    answers,
    ids_of,
    recorder_of,
    refuse_traced_index,
    unsupported,
)

MOVES = """
    adjoint atleast_1d atleast_2d atleast_3d broadcast_to chunk clone contiguous detach diag diag_embed
    diagflat diagonal expand flatten flip fliplr flipud gather hsplit index_select moveaxis movedim narrow
    permute positive ravel repeat repeat_interleave reshape roll rot90 select split split_with_sizes squeeze
    swapaxes swapdims t take take_along_dim tensor_split tile transpose tril triu unbind unflatten unfold
    unsqueeze view vsplit
"""
"""Torch functions of one value that move its entries, repeat them, drop them, or put zeros beside them."""

JOINS = "block_diag broadcast_tensors cat column_stack concat concatenate dstack hstack row_stack stack vstack"
"""Torch functions that put several values together."""


def _moved(name: str, x: Any, *args: Any, **kwargs: Any) -> Any:
    if not isinstance(x, Traced) or any(isinstance(a, Traced) for a in (*args, *kwargs.values())):
        raise UnsupportedOperationError(
            f"torch operation '{name}' is supported with indices that do not depend on the state"
        )
    if any(isinstance(a, torch.dtype) for a in (*args, *kwargs.values())):
        raise unsupported(f"{name}(dtype)")
    function = getattr(torch.Tensor, name, None) or getattr(torch, name)
    return _rewrapped(x.recorder, function(x.ids, *args, **kwargs))


def _joined(name: str, *values: Any, **kwargs: Any) -> Any:
    # Either one sequence of tensors (and perhaps a dimension), or the tensors themselves.
    sequence, rest = (values[0], values[1:]) if isinstance(values[0], (list, tuple)) else (values, ())
    recorder = recorder_of(*sequence)
    bad = next((v for v in sequence if not isinstance(v, (Traced, Tensor))), None)
    if bad is not None:
        raise UnsupportedOperationError(f"torch operation '{name}' takes tensors, found {type(bad).__name__}")
    ids = [ids_of(recorder, v, name) for v in sequence]
    function = getattr(torch, name)
    joined = function(ids, *rest, **kwargs) if isinstance(values[0], (list, tuple)) else function(*ids, **kwargs)
    return _rewrapped(recorder, joined)


def _rewrapped(recorder: Recorder, result: Any) -> Any:
    if isinstance(result, Tensor):
        return Traced(recorder, result)
    return type(result)([Traced(recorder, r) for r in result])


ANSWERS_OF_MOVES.update(MOVES.split(), JOINS.split())
for _word in MOVES.split():
    ANSWERS[_word] = functools.partial(_moved, _word)
for _word in JOINS.split():
    ANSWERS[_word] = functools.partial(_joined, _word)


@answers("expand_as", "view_as", "reshape_as")
def shaped_as(x: Any, other: Any) -> Any:
    """The value in the shape of another one."""
    name = (
        "expand" if isinstance(x, Traced) and x.shape != other.shape and x.numel() != other.shape.numel() else "reshape"
    )
    if not isinstance(x, Traced):
        return x.expand(other.shape)
    return _moved(name, x, other.shape)


@answers("pad")
def pad(x: Traced, pad: Any, mode: str = "constant", value: float | None = None) -> Traced:
    """Zeros beside the value."""
    if mode != "constant" or value not in (None, 0):
        raise unsupported(f"pad(mode='{mode}', value={value})")
    return x._like(torch.nn.functional.pad(x.ids, pad, value=Recorder.zero))


def _filled(name: str, *, like: bool, number: float | None) -> None:
    @answers(name)
    def fill(x: Traced, *args: Any, **kwargs: Any) -> Traced:
        same_type(kwargs.pop("dtype", None))
        for ignored in ("device", "layout", "requires_grad", "pin_memory", "memory_format"):
            kwargs.pop(ignored, None)
        values = [*args, *kwargs.values()]
        value = values.pop() if name.endswith("full_like") or name == "new_full" else number
        shape = x.shape if like else torch.Size(values[0] if isinstance(values[0], (list, tuple)) else values)
        if value is None:
            return x._like(torch.full(shape, Recorder.unwritten))
        return x._like(ids_of(x.recorder, value, name).expand(shape).clone())


for _word, _value in (("zeros", 0.0), ("ones", 1.0), ("full", None), ("empty", None)):
    _filled(f"{_word}_like", like=True, number=_value)
    _filled(f"new_{_word}", like=False, number=_value)


@answers("new_tensor")
def new_tensor(x: Traced, data: Any, **kwargs: Any) -> Traced:
    """A constant."""
    same_type(kwargs.get("dtype"))
    return x._like(ids_of(x.recorder, torch.tensor(data, dtype=torch.float64), "new_tensor"))


@answers("__getitem__")
def entries_of_a_constant(constant: Any, index: Any) -> Any:
    """Refused: a plain tensor indexed by a value."""
    refuse_traced_index(index)


@answers("__setitem__")
def written_into_a_constant(constant: Any, index: Any, value: Any) -> None:
    """Refused: a plain tensor that shall hold a value."""
    refuse_traced_index(index)
    raise UnsupportedOperationError(
        "assignment into a plain tensor, which cannot hold a set; start from torch.zeros_like(x) or use torch.stack"
    )
