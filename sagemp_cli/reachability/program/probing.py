"""How a stranger's step is called, and whether it is what it must be: a function of ``x`` and ``w`` only.

Calling a function a few times can refute, never prove. What is bounded in the end is a program recorded from one
call (:mod:`sagemp_cli.reachability.program.value`); the calls made here test that the program says what the step does.
"""

from __future__ import annotations

import contextlib
import functools
import random
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import get_default_nowrap_functions

from sagemp_cli.errors import NonFiniteError, SagempError, UnsupportedOperationError, UsageError
from sagemp_cli.reachability.program.float32 import contains
from sagemp_cli.reachability.program.loops import RecordedLoop, check_state, record, recorded_steps
from sagemp_cli.reachability.program.memory import widened
from sagemp_cli.reachability.program.value import UFUNCS, Traced
from sagemp_cli.sets import Box

TOLERANCE = 1e-9
"""How far two float64 evaluations of the same formulas may differ, relative to 1 plus the size of the result."""


IN_FLOAT32 = 1e-4
"""The same of steps that compute in float32, where a batch is summed in another order than a single state."""

_ROUNDED = [False]  # whether a step has computed in float32 since it was asked

_NOT_WRAPPED = get_default_nowrap_functions()


class _Exact(Tensor):
    """float64 tensors that meet float32 constants as the exact numbers those are, where torch would refuse or round.

    What ``.float()`` makes of them is float32, and computed by torch as it is.
    """

    __deepcopy__ = lambda self, memo: self.clone()  # noqa: E731

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        # Numpy would hand over its own results through a protocol that is on its way out.
        if ufunc.__name__ in UFUNCS and method == "__call__" and not options:
            return UFUNCS[ufunc.__name__](*(torch.as_tensor(i) if isinstance(i, np.ndarray) else i for i in inputs))
        plain = (i.detach().as_subclass(Tensor).numpy() if isinstance(i, Tensor) else i for i in inputs)
        return torch.as_tensor(getattr(ufunc, method)(*plain, **options))

    @classmethod
    def __torch_function__(cls, function: Any, types: Sequence[type], args: Any = (), kwargs: Any = None) -> Any:
        with torch._C.DisableTorchFunctionSubclass():
            kwargs = kwargs or {}
            if kwargs or not _wide(args):
                if contains((args, kwargs), cls, float32=True):
                    _ROUNDED[0] = True
                else:
                    args = widened(tuple(args))
                    kwargs = {key: widened(value) for key, value in kwargs.items()}
            if types == (cls,):  # what torch itself does then, without its detours
                result = function(*args, **kwargs)
                return result if function in _NOT_WRAPPED else cls._wrapped(result)
        return super().__torch_function__(function, types, args, kwargs)

    @classmethod
    def _wrapped(cls, result: Any) -> Any:
        if isinstance(result, Tensor):
            return result if isinstance(result, cls) else result.as_subclass(cls)
        if isinstance(result, (list, tuple)):
            return type(result)(cls._wrapped(one) for one in result)
        return result


def _wide(values: Sequence[Any]) -> bool:
    """Whether all tensors among arguments are float64: what most calls are, and quickly told."""
    for value in values:
        if isinstance(value, Tensor):
            if value.dtype is not torch.float64:
                return False
        elif isinstance(value, (list, tuple)):
            if not _wide(value):
                return False
        elif isinstance(value, dict):
            return False
    return True


@dataclass(frozen=True)
class Step:
    """One step of a stranger's loop as it wants to be called.

    Attributes:
        function: ``(k, x, w) -> x_next``.
        batched: whether it takes batches ``(B, n)`` and ``(B, d)`` only; else it takes ``(n,)`` and ``(d,)``.
        rowwise: whether it may be called on batches to save time, because it steps their rows one by one.
    """

    function: Callable[[int, Any, Any], Any]
    batched: bool = False
    rowwise: bool = False

    def all(self, k: int, xs: Tensor, ws: Tensor) -> Tensor:
        """The next states ``(B, n)`` from states ``(B, n)`` and disturbances ``(B, d)`` in plain float64."""
        if self.rowwise:
            xs, ws = (v.detach().clone().as_subclass(_Exact) for v in (xs, ws))
            return self._plain(self._called(k, xs, ws), xs.shape)
        return torch.stack([self.at(k, x, w) for x, w in zip(xs, ws, strict=True)])

    def differentiable(self, k: int, xs: Tensor, ws: Tensor) -> Tensor:
        """The next states ``(B, n)``, for autograd."""
        xs, ws = (v.as_subclass(_Exact) for v in (xs, ws))
        if self.rowwise:
            return self._called(k, xs * 1.0, ws * 1.0).as_subclass(Tensor)
        rows = [(x[None], w[None]) if self.batched else (x, w) for x, w in zip(xs * 1.0, ws * 1.0, strict=True)]
        return torch.stack([self._called(k, x, w).as_subclass(Tensor).reshape(-1) for x, w in rows])

    def at(self, k: int, x: Tensor, w: Tensor) -> Tensor:
        """The next state ``(n,)`` from a state ``(n,)`` and a disturbance ``(d,)`` in plain float64."""
        x, w = (v.detach().clone().as_subclass(_Exact) for v in (x, w))
        if self.batched:
            x, w = x[None], w[None]
        return self._plain(self._called(k, x, w), x.shape).reshape(-1)

    @torch.no_grad()
    def recorded(self, x: Tensor, w: Tensor, *, numbered: bool, numbers: bool) -> RecordedLoop:
        """The loop of K steps, recorded at one state ``(n,)`` and disturbances ``(K, d)``.

        Args:
            x, w: the example.
            numbered: whether steps may differ: whether the function uses ``k``.
            numbers: whether steps that differ in what they add may be one program with numbers.
        """
        if numbered:
            return recorded_steps(self._stepped, x, w, batched=self.batched, numbers=numbers)
        program = record(functools.partial(self._stepped, 0), x, w[0], batched=self.batched)
        return RecordedLoop((program,), torch.zeros(len(w), 0, dtype=torch.float64), len(w))

    def _stepped(self, k: int, x: Any, w: Any) -> Any:
        result = self._called(k, x, w)
        check_state(result, x.shape)  # a tuple is no state here
        return result

    def _plain(self, result: Any, shape: torch.Size) -> Tensor:
        if type(result) is _Exact:
            with torch._C.DisableTorchFunctionSubclass():  # reads no attribute by way of the class
                result = result.as_subclass(Tensor)
        check_state(result, shape)
        plain = result.detach().as_subclass(Tensor)
        if plain.dtype.is_complex or plain.dtype is torch.bool:
            raise UsageError(f"step returned numbers of type {plain.dtype}, expected real numbers")
        return plain.to(torch.float64).clone()

    def _called(self, k: int, x: Any, w: Any) -> Any:
        try:
            with _eagerly() if isinstance(x, Traced) else contextlib.nullcontext():
                return self.function(k, x, w)
        except SagempError as error:
            raise type(error)(f"{_line(error)}{error}") from error
        except Exception as error:  # a stranger's code may raise anything
            first = (str(error).strip().splitlines() or [""])[0]
            kind = UnsupportedOperationError if isinstance(x, Traced) else UsageError
            shapes = f"a state of shape {tuple(x.shape)} and a disturbance of shape {tuple(w.shape)}"
            manner = "on sets" if isinstance(x, Traced) else f"on {shapes}"
            raise kind(f"{_line(error)}step fails {manner} with {type(error).__name__}: {first}") from error


def _eagerly() -> Any:
    """Compiled functions run as they are written, once torch's compiler is there at all: it must not compile us."""
    return torch.compiler.set_stance("force_eager") if "torch._dynamo" in sys.modules else contextlib.nullcontext()


def probe(function: Callable[[int, Any, Any], Any], start: Box, disturbance: Box, *, batched: bool | None) -> Step:
    """The step, called the way it wants to be: tried on one state ``(n,)`` and on batches ``(B, n)``.

    Raises:
        UsageError: neither way gives states; or both do, but differ; or two calls with the same arguments differ.
        NonFiniteError: NaN or infinity at a state of the start box.
    """
    _ROUNDED[0] = False
    generator = torch.Generator().manual_seed(0)
    count = start.dim + disturbance.dim + 2  # unlike n, so that rows and columns cannot be taken for each other
    xs, ws = start.sample(count, generator), disturbance.sample(count, generator)
    unit = UsageError("not tried")
    single, why_single = (None, unit) if batched is True else _tried(Step(function), xs, ws)
    rows, why_rows = (None, unit) if batched is False else _tried(Step(function, batched=True), xs, ws)
    together = None if batched is False else _tried(Step(function, batched=True, rowwise=True), xs, ws)[0]
    if single is None and rows is None:
        if batched is None and type(why_single) is type(why_rows) and type(why_single) is not UsageError:
            raise why_single
        if batched is not None:
            raise why_rows if batched else why_single
        raise UsageError(f"step works neither on one state ({why_single}) nor on a batch ({why_rows})")
    first = rows if single is None else single
    assert first is not None
    reproduced(Step(function, batched=single is None), xs, ws, first)
    _same_on_plain_tensors(function, xs, ws, first, batched=single is None)
    # A batch means something only if its rows are stepped one by one: x[0] of a batch is a row, not a state's entry.
    rowwise = rows is not None and together is not None and agree(together, rows)
    if single is None and not rowwise:
        raise UsageError("step mixes the rows of a batch: a row's next state depends on the other rows")
    if rowwise and rows is not None and not agree(rows, first):
        raise UsageError(
            f"step means one thing for a state of shape ({start.dim},) and another for a batch ({count}, {start.dim}); "
            f"say which is meant with batched=False or batched=True"
        )
    return Step(function, batched=single is None, rowwise=rowwise)


def reproduced(step: Step, xs: Tensor, ws: Tensor, before: Tensor) -> None:
    """Refuse a step that gives other results than before; under autograd, too."""
    for grad in (False, True):
        try:
            with torch.set_grad_enabled(grad):
                after = step.all(0, xs, ws)
        except SagempError as error:
            raise UsageError(
                f"step works when it is called first and fails when it is called again ({error}); it must be a "
                f"function of x and w only, no state kept between calls"
            ) from error
        if not _same(after, before):
            difference = float((after - before).abs().nan_to_num(torch.inf).max())
            raise UsageError(
                f"step gives another result when it is called again with the same x and w (difference "
                f"{difference:.3g}); it must be a function of x and w only: no randomness "
                f"(dropout: call .eval()), no counters, no state kept between calls"
            )


def _same(a: Tensor, b: Tensor) -> bool:
    """Whether two results are the same; a root of less than 0 is no number twice, and no randomness."""
    return a.shape == b.shape and bool(((a == b) | (torch.isnan(a) & torch.isnan(b))).all())


REPEATED = (50, 200)
"""Calls at one state at the end: at least, and at most."""

SECONDS = 0.05
"""Time after which there are no more than at least."""


def steady(step: Step, x: Tensor, w: Tensor) -> None:
    """Refuse a step whose result at one state changes when it is called again and again."""
    began = time.perf_counter()
    with torch.no_grad():
        first = step.at(0, x, w)
        for calls in range(REPEATED[1]):
            if not _same(step.at(0, x, w), first):
                raise UsageError(
                    "step gives another result when it is called again with the same x and w; it must be a function "
                    "of x and w only: no randomness, no counters, no state kept between calls"
                )
            if calls >= REPEATED[0] and time.perf_counter() - began > SECONDS:
                break


class GlobalRandomness:
    """Whether random numbers were drawn, used or not, from the generators that torch, Python and numpy share."""

    def __init__(self) -> None:
        self._before = self._states()

    @staticmethod
    def _states() -> tuple[Any, ...]:
        shared = np.random.get_state(legacy=False)["state"]  # noqa: NPY002  (the one that a step may draw from)
        return torch.get_rng_state().numpy().tobytes(), random.getstate(), shared["key"].tobytes(), shared["pos"]

    def refuse(self) -> None:
        """Refuse the step if any were drawn since."""
        if self._states() != self._before:
            raise UsageError(
                "step draws random numbers; it must be a function of x and w only (dropout: call .eval(); constants "
                "of a seed: draw them once, outside)"
            )


def _same_on_plain_tensors(
    function: Callable[[int, Any, Any], Any], xs: Tensor, ws: Tensor, before: Tensor, *, batched: bool
) -> None:
    """Refuse a step that does something else on plain float64 tensors, where it runs on these at all.

    It often does not (float32 weights), or rounds to float32: hence the tolerance.
    """
    for x, w, expected in zip(xs, ws, before, strict=True):
        try:
            with torch.no_grad():
                result = function(0, x[None].clone(), w[None].clone()) if batched else function(0, x.clone(), w.clone())
            plain = result.to(torch.float64).reshape(expected.shape)
        except Exception:  # a stranger's code may raise anything
            return
        if not bool(((plain - expected).abs() <= 1e-4 * (1.0 + expected.abs())).all()):
            raise UsageError("step gives another result on plain float64 tensors; it must not look at their type")


def agree(a: Tensor, b: Tensor) -> bool:
    """Whether two float64 evaluations agree up to rounding."""
    close = IN_FLOAT32 if _ROUNDED[0] else TOLERANCE
    return a.shape == b.shape and bool(((a - b).abs() <= close * (1.0 + b.abs())).all())


def _tried(step: Step, xs: Tensor, ws: Tensor) -> tuple[Tensor | None, SagempError]:
    """Results ``(B, n)`` of single calls, or why there are none."""
    try:
        with torch.no_grad():
            states = step.all(0, xs, ws)
    except SagempError as error:
        return None, error
    finite = torch.isfinite(states).all(-1)
    if not bool(finite.all()):
        i = int(finite.long().argmin())
        return None, NonFiniteError(
            f"step gives NaN or infinity in state {int(torch.isfinite(states[i]).long().argmin())} "
            f"at x = {xs[i].tolist()}, w = {ws[i].tolist()} of the start and disturbance boxes"
        )
    return states, UsageError("it works")


def _line(error: BaseException) -> str:
    """``"file.py, line 7: "`` of the stranger's own code that led to the error."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if not {"torch", "sagemp_cli", "numpy"} & set(path.parts) and not frame.filename.startswith("<"):
            return f"{path.name}, line {frame.lineno}: "
    return ""
