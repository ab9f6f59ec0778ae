"""Values that stand in for tensors while a stranger's step is recorded, and mean exactly what torch's tensors mean.

A :class:`Traced` value is a tensor of ids (:class:`~sagemp_cli.reachability.program.recorder.Recorder`). Whatever only
moves entries (indexing, reshaping, stacking, views, assignment in place) is done by torch itself on the ids, so that
shapes, views and aliases are torch's own. Arithmetic and the functions that have a relaxation are written into the
program. All else is an error that names the operation; above all, nothing may ask for the number that a value has: a
set has none.

Constants are taken as the exact numbers they are: float32 weights are not rounded, nor is anything else.

Longer than other files: one class has to answer all that a tensor is asked.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, SagempError, UnsupportedOperationError, UsageError
from sagemp_cli.reachability.program import float32, truth
from sagemp_cli.reachability.program.memory import Example
from sagemp_cli.reachability.program.recorder import Recorder
from sagemp_cli.reachability.program.tape import asked

_CLAMPS = ("clamp", "clip", "clamp_min", "clamp_max", "maximum", "minimum", "fmax", "fmin", "max", "min", "hardtanh")
"""Functions whose limits may be infinite."""

_RESHAPES = ("t_", "transpose_", "swapaxes_", "swapdims_", "squeeze_", "unsqueeze_", "resize_", "resize_as_", "set_")
"""Methods that change a tensor's shape and not its entries."""


def unsupported(name: str) -> UnsupportedOperationError:
    """The error for a torch operation that nothing is known of."""
    return UnsupportedOperationError(
        f"torch operation '{name}' has no relaxation in the native propagators (affine, crown, interval); "
        f"add one in sagemp_cli/reachability/relaxations and register it in its registry.py"
    )


def exact(value: Any, *, operation: str) -> Tensor:
    """A constant as float64 tensor, none of its numbers changed.

    Raises:
        NonFiniteError: NaN, or infinity where it is no limit of a clamp.
        UnsupportedOperationError: no real number, or one that float64 cannot hold.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        if value.dtype.kind not in "biuf" or value.dtype.itemsize > 8 or value.dtype == np.uint64:
            raise UnsupportedOperationError(
                f"constant of '{operation}' has numpy type {value.dtype}, allowed are real numbers"
            )
        value = torch.tensor(value)
    elif isinstance(value, int) and int(float(value)) != value:
        raise UnsupportedOperationError(f"constant {value} of '{operation}' cannot be held in float64")
    tensor = torch.as_tensor(value, dtype=None if isinstance(value, Tensor) else torch.float64).cpu()
    if not torch.is_grad_enabled():  # where it is, a tube is differentiated by the constants, the weights among them
        tensor = tensor.detach()
    if tensor.layout is not torch.strided or tensor.dtype.is_complex or tensor.is_quantized:
        raise UnsupportedOperationError(
            f"constant of '{operation}' is {tensor.dtype} {tensor.layout}, allowed are dense real tensors"
        )
    double = tensor.to(torch.float64)
    if not tensor.dtype.is_floating_point and not torch.equal(double.to(tensor.dtype), tensor):
        raise UnsupportedOperationError(f"constant of '{operation}' has integers that float64 cannot hold")
    bad = torch.isnan(double) if operation in _CLAMPS else ~torch.isfinite(double)
    if bool(bad.any()):
        where = torch.nonzero(bad)[0].tolist()
        raise NonFiniteError(
            f"constant of '{operation}', shape {tuple(double.shape)}, is {double[tuple(where)].item()} at {where}; "
            f"it must be finite"
        )
    return double


class Traced(Tensor):
    """A value of a recorded step; see the module.

    It is a tensor of torch's own kind, of the right shape and strides, so that code which takes its class at its word
    finds what it expects. Whatever does not ask ``__torch_function__`` (constructors such as ``torch.tensor``,
    transforms, compiled code) ends in ``__torch_dispatch__``, which refuses it; and what goes past that too reads NaN,
    which no program may hold.
    """

    ids: Tensor
    recorder: Recorder
    truth: bool
    float32: bool  # whether torch computes with it in float32

    @staticmethod
    def __new__(cls, recorder: Recorder, ids: Tensor, *, truth: bool = False) -> Traced:
        """A value whose entries have these ids; of truth values, which are 1 and 0 in the program."""
        memory = torch.full((ids.untyped_storage().nbytes() // ids.element_size(),), torch.nan, dtype=torch.float64)
        value = Tensor._make_subclass(cls, memory.as_strided(ids.size(), ids.stride(), ids.storage_offset()))
        value.ids = ids
        value.recorder = recorder
        value.truth = truth
        value.float32 = False
        return value

    __hash__ = object.__hash__

    # -- what a tensor says of itself ---------------------------------------------------------------------------------

    if not TYPE_CHECKING:  # torch declares attributes, which it takes no property for
        shape = property(lambda self: self.ids.shape)
        ndim = property(lambda self: self.ids.dim())
        dtype = property(lambda self: _type(self))
        device = property(lambda self: self.ids.device)
        layout = property(lambda self: torch.strided)
        requires_grad = is_cuda = is_sparse = is_quantized = is_nested = property(lambda self: False)
        data = property(lambda self: self._moved("data", lambda ids: ids))
        T = property(lambda self: self._moved("T", lambda ids: ids.T))
        mT = property(lambda self: self._moved("mT", lambda ids: ids.mT))

    def dim(self) -> int:
        """Number of dimensions."""
        return self.ids.dim()

    ndimension = dim

    def size(self, dim: int | None = None) -> Any:
        """Shape, or one entry of it."""
        return self.ids.size() if dim is None else self.ids.size(dim)

    def stride(self, dim: int | None = None) -> Any:
        """Strides, or one of them."""
        return self.ids.stride() if dim is None else self.ids.stride(dim)

    def storage_offset(self) -> int:
        """Where the first entry lies."""
        return int(self.ids.storage_offset())

    def numel(self) -> int:
        """Number of entries."""
        return self.ids.numel()

    nelement = numel

    def is_floating_point(self) -> bool:
        """Whether it is no truth value."""
        return not self.truth

    is_contiguous = lambda self, *args, **kwargs: cast(Traced, self).ids.is_contiguous(*args, **kwargs)  # noqa: E731
    is_complex = lambda self: False  # noqa: E731

    def __len__(self) -> int:
        return len(self.ids) if self.ids.dim() else self._number()

    def __iter__(self) -> Iterator[Traced]:
        return iter(asked("iter", (self,), {}, lambda value: [value._like(part) for part in value.ids]))

    def __copy__(self) -> Traced:
        return self._moved("copy", lambda ids: ids)

    def __deepcopy__(self, memo: Any) -> Traced:
        return self._moved("deepcopy", lambda ids: copy.deepcopy(ids, memo))

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"Traced(shape={tuple(self.shape)})"

    def _like(self, ids: Tensor) -> Traced:
        found = cast(Any, Traced)(self.recorder, ids, truth=self.truth)
        found.float32 = self.float32
        return found

    def _moved(self, name: str, ids: Callable[[Tensor], Tensor]) -> Traced:
        return asked(name, (self,), {}, lambda value: value._like(ids(value.ids)))

    def _refuse(self, words: str) -> Any:
        error = UnsupportedOperationError(words)
        self.recorder.refusal = self.recorder.refusal or error
        raise error

    # -- entries ------------------------------------------------------------------------------------------------------

    def __getitem__(self, index: Any) -> Traced:
        refuse_traced_index(index)
        return asked("entries", (self, index), {}, lambda value, index: value._like(value.ids[index]))

    def __setitem__(self, index: Any, value: Any) -> None:
        if not (isinstance(index, Traced) and index.truth):  # assignment by a mask is a choice
            refuse_traced_index(index)
        asked("assignment", (self, index, value), {}, _assign)

    # -- what a set does not have -------------------------------------------------------------------------------------

    def _compared(self, *_: Any) -> Any:
        return self._refuse(
            "comparison: a step may not branch on a value, the truth of a set is not one of True and False; "
            "use torch.where, torch.clamp, torch.minimum, torch.maximum or torch.relu"
        )

    if not TYPE_CHECKING:  # torch declares what each of them gives
        __bool__ = __contains__ = _compared

    def _number(self, *_: Any, **__: Any) -> Any:
        return self._refuse(
            "float(), int(), item(), numpy, math.* and torch.tensor(...) ask for the number that a value has, "
            "a set has none; "
            "use torch's functions on the value itself, and torch.stack to put values together"
        )

    __float__ = __int__ = __index__ = __complex__ = __array__ = __round__ = __floor__ = __ceil__ = __trunc__ = _number
    item = tolist = numpy = __format__ = _number

    # -- operators ----------------------------------------------------------------------------------------------------

    def __getattr__(self, name: str) -> Any:
        method = getattr(torch.Tensor, name, None)
        if method is None or name.startswith("__"):
            raise AttributeError(f"neither torch.Tensor nor a recorded value has '{name}'")
        if not callable(method):
            return self._refuse(str(unsupported(name)))
        return lambda *args, **kwargs: _dispatch(method, (self, *args), kwargs)

    @classmethod
    def __torch_function__(
        cls, function: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        return _dispatch(function, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(
        cls, function: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Refused: what comes here has gone past ``__torch_function__``."""
        error = UnsupportedOperationError(
            "torch.tensor(...), torch.Tensor(...), torch.asarray(...), torch.func, compiled and scripted code ask for "
            f"the memory of a value ('{_plain_name(function)}'), a set has none; use torch's functions on the value "
            "itself, and torch.stack to put values together"
        )
        _note(error, (*args, *(kwargs or {}).values()))
        raise error

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        function = UFUNCS.get(ufunc.__name__)
        if function is None or method != "__call__" or options:
            return self._refuse(f"numpy operation '{ufunc.__name__}' does not work on sets; use torch.{ufunc.__name__}")
        return _dispatch(function, inputs, {})

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return self._refuse(f"numpy operation '{function.__name__}' does not work on sets; use torch's")


def _operator(function: Any, *, swapped: bool = False) -> Callable[[Traced, Any], Any]:
    def apply(self: Traced, *other: Any) -> Any:
        return _dispatch(function, (*other, self) if swapped else (self, *other), {})

    return apply


for _name, _function in {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "truediv": torch.div,
    "pow": torch.pow,
    "matmul": torch.matmul,
    "floordiv": torch.floor_divide,
    "mod": torch.remainder,
    "lt": torch.lt,
    "le": torch.le,
    "gt": torch.gt,
    "ge": torch.ge,
    "eq": torch.eq,
    "ne": torch.ne,
    "and": torch.bitwise_and,
    "or": torch.bitwise_or,
    "xor": torch.bitwise_xor,
}.items():
    setattr(Traced, f"__{_name}__", _operator(_function))
    setattr(Traced, f"__r{_name}__", _operator(_function, swapped=True))
    if hasattr(torch.Tensor, f"{_function.__name__}_"):  # x @= A is x = x @ A
        setattr(Traced, f"__i{_name}__", _operator(getattr(torch.Tensor, f"{_function.__name__}_")))
for _name, _function in {
    "neg": torch.neg,
    "pos": torch.positive,
    "abs": torch.abs,
    "invert": torch.bitwise_not,
}.items():
    setattr(Traced, f"__{_name}__", _operator(_function))


def _type(value: Traced) -> torch.dtype:
    if value.truth:
        return torch.bool
    return torch.float32 if value.float32 else torch.float64


UFUNCS = {
    "add": torch.add,
    "subtract": torch.sub,
    "multiply": torch.mul,
    "true_divide": torch.div,
    "divide": torch.div,
    "negative": torch.neg,
    "matmul": torch.matmul,
}
"""Numpy's functions that strangers reach by operators between arrays and tensors."""

ANSWERS: dict[Any, Callable[..., Any]] = {}
"""What torch functions and tensor methods do on traced values: by name, or the function itself."""

ANSWERS_OF_MOVES: set[str] = set()
"""Of these the names of those that only move entries, which do the same to values of any type."""


def answers(*functions: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register what torch functions do, given by their names or as they are."""

    def register(implementation: Callable[..., Any]) -> Callable[..., Any]:
        for function in functions:
            ANSWERS[function] = implementation
        return implementation

    return register


def _assign(value: Traced, index: Any, part: Any) -> None:
    if value.float32 and isinstance(part, Traced) and not part.float32:
        value._refuse(str(float32.mixed("assignment")))
    if value.float32 and not isinstance(part, Traced):
        part = float32.as_float32(part, "assignment")
    if value.truth:
        truth.require_truth("assignment", (part,), Traced)
    if isinstance(index, Traced) and index.truth:
        part = _answered(torch.where, (index, part, value), {})
        index = ...
    value.ids[index] = ids_of(value.recorder, part, "assignment")


def _dispatch(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return asked(function, args, kwargs, lambda *args: _done(function, args, kwargs))


def _done(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    try:
        return _answered(function, args, kwargs)
    except SagempError as error:
        # A step that catches the error must not go on with something else than what it does on tensors.
        _note(error, (*args, *kwargs.values()))
        raise


def _note(error: SagempError, values: Iterable[Any]) -> None:
    """Remember a refusal with the recorder of the values that it is about."""
    for value in values:
        if isinstance(value, Traced):
            value.recorder.refusal = value.recorder.refusal or error
        elif type(value) in (list, tuple, dict):
            _note(error, value.values() if isinstance(value, dict) else value)


def _plain_name(function: Any) -> str:
    """``aten.add.Tensor`` is ``add``."""
    return str(getattr(getattr(function, "overloadpacket", function), "__name__", function))


def _answered(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    name = getattr(function, "__name__", str(function))
    if name == "__get__":
        raise unsupported(str(getattr(function, "__self__", name)))
    if kwargs.get("out") is not None:
        raise UnsupportedOperationError(f"torch operation '{name}' is not supported with out=")
    kwargs = {key: value for key, value in kwargs.items() if key != "out"}
    if name in ("__getitem__", "__setitem__"):  # of a plain tensor: refused, before torch writes into it
        return ANSWERS[name](*args, **kwargs)
    answer = _in_place(name, args) if name.endswith("_") and not name.endswith("__") else _answer_of(function, name)
    # Torch goes first: what it refuses it must refuse before anything is written.
    narrow = float32.contains((args, kwargs), Traced, float32=True)
    native = narrow or name in float32.CONVERSIONS
    example = Example(Traced, native=native).run(function, args, kwargs)
    kwargs.pop("inplace", None)  # torch's functions hand it over by name
    narrow &= example.result_type in (torch.float32, torch.bool)
    before = args, kwargs
    if narrow:
        float32.require_known(name, ANSWERS_OF_MOVES)
        float32.require_one_type(name, (args, kwargs), Traced)
        args, kwargs = (float32.as_float32(given, name) for given in (args, kwargs))
    of_truth = name in float32.CONVERSIONS and isinstance(args[0], Traced) and args[0].truth
    if of_truth and example.result_type in (torch.float32, torch.float64):  # 1 and 0, which no rounding changes
        answer = _unchanged
    if name != "where":
        args, kwargs = _as_numbers(args), _as_numbers(kwargs)
    try:
        with _computing_in_float32(args, kwargs) if narrow else contextlib.nullcontext():
            found = answer(*args, **kwargs)
            if example.result_type is torch.bool:
                truth.require_logic(name, (*before[0], *before[1].values()), Traced, moves=ANSWERS_OF_MOVES)
            return example.settle(found, name)
    except TypeError as error:
        raise UnsupportedOperationError(
            f"torch operation '{name}' is not supported with these arguments: {error}"
        ) from error


def _unchanged(value: Traced, *_: Any, **__: Any) -> Traced:
    return value._like(value.ids)


def _as_numbers(value: Any) -> Any:
    """Arguments with truth values as the numbers 1 and 0."""
    if isinstance(value, Traced):
        return Traced(value.recorder, value.ids) if value.truth else value
    if type(value) in (list, tuple):
        return type(value)(map(_as_numbers, value))
    return {key: _as_numbers(one) for key, one in value.items()} if type(value) is dict else value


@contextlib.contextmanager
def _computing_in_float32(*arguments: Any) -> Iterator[None]:
    """What is recorded meanwhile is computed in float32."""
    recorder = _first(arguments).recorder
    before, recorder.float32 = recorder.float32, True
    try:
        yield
    finally:
        recorder.float32 = before


def _first(values: Any) -> Any:
    """The first recorded value among arguments."""
    for value in values.values() if isinstance(values, dict) else values:
        found = value if isinstance(value, Traced) else None
        if found is None and type(value) in (list, tuple, dict):
            found = _first(value)
        if found is not None:
            return found
    return None


def _answer_of(function: Any, name: str) -> Callable[..., Any]:
    answer = ANSWERS.get(name) or ANSWERS.get(function)
    if answer is None:
        raise unsupported(name)
    return answer


def _in_place(name: str, args: tuple[Any, ...]) -> Callable[..., Any]:
    """What is written in place; that it is, and where, is seen from what torch does."""
    if not isinstance(args[0], Traced):
        raise UnsupportedOperationError(
            f"torch operation '{name}' writes into a plain tensor, which cannot hold a set; "
            f"start from torch.zeros_like(x)"
        )
    if name in ("detach_", "requires_grad_"):
        return lambda target, *_, **__: target
    if name in ("copy_", "fill_", "zero_"):
        return lambda target, value=0.0, *_: target._like(
            ids_of(target.recorder, value, name).expand(target.shape).clone()
        )
    function = getattr(torch.Tensor, name[:-1], None)
    if function is None or name in _RESHAPES:
        raise unsupported(name)
    return _answer_of(function, name[:-1])


def refuse_traced_index(index: Any) -> None:
    """An index is a constant, or an error."""
    if any(isinstance(i, Traced) for i in (index if isinstance(index, (tuple, list)) else (index,))):
        raise UnsupportedOperationError(
            "indexing: a step may not look entries up by a value, a set names no single entry"
        )


def is_tensor(value: Any) -> bool:
    """Whether the value takes part in broadcasting, as Python numbers do not."""
    return isinstance(value, (Traced, Tensor, np.ndarray, np.generic))


def ids_of(recorder: Recorder, value: Any, operation: str) -> Tensor:
    """Ids of a value, or of a constant."""
    if isinstance(value, Traced):
        if value.recorder is not recorder:
            raise UsageError(
                "step uses a value of an earlier call; it must be a function of x and w only, with no state of its own"
            )
        return value.ids
    return recorder.constant(exact(value, operation=operation))


def recorder_of(*values: Any) -> Recorder:
    """The recorder of the traced value among these."""
    return next(v.recorder for v in values if isinstance(v, Traced))
