"""Conversions of traced values, and what a set cannot be asked for."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability.program.value import ANSWERS, Traced, answers


def same_type(dtype: Any) -> None:
    """Refuse all types but float64."""
    if dtype not in (None, torch.float64, torch.double):
        raise UnsupportedOperationError(
            f"conversion to {dtype}: rounding to it is not enclosed; leave the conversion out, or compute in float32 "
            f"from x.float() on, which is enclosed (float32 weights are exact numbers in either case)"
        )


@answers("to", "type", "type_as")
def converted(x: Traced, *args: Any, **kwargs: Any) -> Traced:
    """The value itself, or rounded to float32; on the CPU."""
    rounded = False
    for target in (*args, *kwargs.values()):
        kind = target.dtype if isinstance(target, (Tensor, Traced)) else target
        if isinstance(kind, torch.dtype):
            rounded |= kind is torch.float32
            same_type(None if rounded else kind)
        elif isinstance(target, (torch.device, str)) and str(target) not in ("cpu", "torch.DoubleTensor"):
            raise UnsupportedOperationError(f"conversion to {target}: a step is bounded on the CPU")
    return to_float32(x) if rounded else x._like(x.ids)


@answers("float")
def to_float32(x: Traced) -> Traced:
    """The value rounded to float32; itself, if it is."""
    if x.float32 or not x.numel():
        return x._like(x.ids)
    recorder = x.recorder
    ids = recorder.write("float32", [recorder.operand(x.ids, full=True)])
    return x._like(ids.reshape(x.shape))


@answers("double", "cpu")
def same(x: Traced) -> Traced:
    """The value itself."""
    return x._like(x.ids)


_TYPES = {
    "half": torch.float16,
    "bfloat16": torch.bfloat16,
    "int": torch.int32,
    "long": torch.int64,
}
_CHOICES = """
    all allclose any bucketize count_nonzero equal isclose isfinite isinf isnan masked_select nonzero searchsorted
    signbit unique
"""
_PLACES = "argmax argmin argsort argwhere cummax cummin kthvalue median mode msort nanmedian quantile sort topk"
_NUMBERS = "__bool__ __float__ __index__ __int__ item numpy tolist"

for _word, _type in _TYPES.items():
    ANSWERS[_word] = lambda x, _type=_type: same_type(_type)
for _word in _CHOICES.split():
    ANSWERS[_word] = lambda *_, _word=_word, **__: _refuse_choice(_word)
for _word in _PLACES.split():
    ANSWERS[_word] = lambda *_, _word=_word, **__: _refuse_place(_word)
for _word in _NUMBERS.split():
    ANSWERS[_word] = lambda x, *_, **__: x._number()


def _refuse_choice(name: str) -> None:
    raise UnsupportedOperationError(
        f"torch operation '{name}' chooses by a value, which on a set is neither True nor False; "
        f"use torch.where, torch.clamp, torch.minimum, torch.maximum or torch.relu"
    )


def _refuse_place(name: str) -> None:
    raise UnsupportedOperationError(
        f"torch operation '{name}' depends on which entry is the larger one, which a set does not say; "
        f"use torch.amax and torch.amin for the values, torch.maximum and torch.minimum of neighbours to sort, or "
        f"sagemp_cli.reachability.decisions.choose(scores, values) for the value of the largest score"
    )
