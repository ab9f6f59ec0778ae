"""Finds auto_LiRPA, makes it run on today's torch, and keeps it away from the operations it gets wrong.

auto_LiRPA is never vendored. A release >= 0.6 that the user installed comes first; otherwise the 0.6 carried inside
the installed package ``neuralsat`` is loaded by file location under the name ``auto_LiRPA``. Release 0.3, the only
one on the package index, is refused: its interval bounds on a division are wrong.

Known faults of releases 0.6 and 0.7 and what is done here, so that a loop means the same to every propagator:

==========================================  ======================================================================
sine and cosine on wide intervals           its lines are shifted until they enclose the curve (closed form)
``x ** n``, ``torch.square``                rewritten as products (its relaxation is wrong on same-sign intervals)
``torch.tan``                               rewritten as sine over cosine (wrong beyond about 1 rad)
``torch.clamp``, ``torch.clip``             rewritten with ReLU (its own raises)
any operation not in :data:`CHECKED`        refused with its name
==========================================  ======================================================================
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import io
import logging
import math
import re
import sys
import types
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.sets import Box

OLDEST = (0, 6)
"""The oldest release whose bounds are right on everything in :data:`CHECKED`."""

INSTALL = "pip install --no-deps neuralsat==0.2.17 && pip install packaging appdirs pyyaml tqdm graphviz ninja"

METHODS = ("CROWN", "IBP")
"""The bounding methods offered here. Its alpha-CROWN crashes on loops that index single states (``x[..., 2]``)."""

_STRUCTURE = ("Input", "Params", "Buffers", "Constant", "PrimConstant", "Identity", "Cast", "Shape", "Gather", "Slice")
_SHAPES = ("Concat", "Split", "Reshape", "Flatten", "Unsqueeze", "Squeeze", "Transpose", "Expand", "ReduceSum")
_LINEAR = ("Add", "Sub", "Neg", "Linear", "MatMul", "Mul", "Sqr", "Div", "Reciprocal")
_CURVES = ("Relu", "LeakyRelu", "Tanh", "Sigmoid", "Atan", "Exp", "Log", "Sqrt", "Abs", "Min", "Max")
CHECKED = frozenset((*_STRUCTURE, *_SHAPES, *_LINEAR, *_CURVES, "SoundSin", "SoundCos"))
"""Graph nodes (auto_LiRPA's class names without ``Bound``) whose bounds hold, as far as sampling shows."""


@dataclass(frozen=True)
class Source:
    """Where an auto_LiRPA lies.

    Attributes:
        version: for instance ``"0.6.0"``.
        init: its ``__init__.py``.
        origin: ``"installed"`` or ``"neuralsat"``.
    """

    version: str
    init: Path
    origin: str


def _version(init: Path) -> str:
    found = re.search(r"__version__\s*=\s*['\"]([^'\"]+)", init.read_text(encoding="utf-8"))
    return found.group(1) if found else "0"


def _recent(version: str) -> bool:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:2]) >= OLDEST


def _installed() -> Source | None:
    spec = importlib.util.find_spec("auto_LiRPA")
    if spec is None or spec.origin is None:
        return None
    return Source(_version(Path(spec.origin)), Path(spec.origin), "installed")


def _carried() -> Source | None:
    try:
        init = Path(str(metadata.distribution("neuralsat").locate_file("src/abstractor/auto_LiRPA/__init__.py")))
    except metadata.PackageNotFoundError:
        return None
    return Source(_version(init), init, "neuralsat") if init.is_file() else None


def find() -> Source:
    """The auto_LiRPA that :func:`load` would load, without importing it.

    Raises:
        UsageError: there is none, or only a release that is too old; the message has the install command.
    """
    installed, carried = _installed(), _carried()
    for source in (installed, carried):
        if source is not None and _recent(source.version):
            return source
    why = (
        "auto_LiRPA is not installed"
        if installed is None
        else f"auto_LiRPA {installed.version} is refused, 0.6 or newer is needed (0.3 bounds a division wrongly)"
    )
    raise UsageError(f"{why}; install one with: {INSTALL}")


@functools.cache
def load() -> types.ModuleType:
    """The module ``auto_LiRPA`` (imported once), with the shims it needs on this torch.

    Raises:
        UsageError: see :func:`find`; also if an old release was imported already, or if the import fails.
    """
    present = sys.modules.get("auto_LiRPA")
    if present is not None:
        version = str(getattr(present, "__version__", "0"))
        if not _recent(version):
            raise UsageError(f"auto_LiRPA {version} is already imported, 0.6 or newer is needed")
        return present
    source = find()
    with _quiet():
        import torch.onnx.symbolic_helper
        import torch.onnx.utils

        # The exporter that auto_LiRPA reads the graph with was moved to a private place in torch 2.9.
        if not hasattr(torch.onnx.utils, "_optimize_graph"):
            private = importlib.import_module("torch.onnx._internal.torchscript_exporter.utils")
            torch.onnx.utils._optimize_graph = private._optimize_graph  # pyright: ignore[reportPrivateImportUsage]
        # neuralsat's copy imports Gurobi at the top for a solver that bounds never touch.
        if source.origin == "neuralsat" and importlib.util.find_spec("gurobipy") is None:
            sys.modules["gurobipy"] = types.ModuleType("gurobipy")
        spec = importlib.util.spec_from_file_location(
            "auto_LiRPA", source.init, submodule_search_locations=[str(source.init.parent)]
        )
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["auto_LiRPA"] = module
        try:
            spec.loader.exec_module(module)
        except ImportError as error:
            del sys.modules["auto_LiRPA"]
            raise UsageError(f"auto_LiRPA {source.version} cannot be imported ({error}); try: {INSTALL}") from error
    return module


@contextlib.contextmanager
def _quiet() -> Iterator[list[str]]:
    """No warnings, prints or log lines of the library; yields the list its log lines go to."""
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    log = logging.getLogger("auto_LiRPA")
    before = log.propagate
    log.addHandler(handler)
    log.propagate = False
    try:
        # Ignored, and recorded to be dropped where the library's own filter, set at its import, lets them through.
        with warnings.catch_warnings(record=True), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield lines
    finally:
        log.removeHandler(handler)
        log.propagate = before


@contextlib.contextmanager
def _double_by_default() -> Iterator[None]:
    """float64 for the tensors that the library makes without saying their type."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def _power(x: Tensor, exponent: Any) -> Tensor:
    value = float(exponent)
    if value != int(value) or not 1 <= value <= 16:
        raise UnsupportedOperationError(
            f"auto_lirpa: torch.pow with exponent {value:g}; only whole exponents 1..16 are rewritten as products"
        )
    return functools.reduce(lambda a, b: a * b, [x] * int(value))


def _clamp(x: Tensor, min: Any = None, max: Any = None) -> Tensor:  # noqa: A002 (torch's argument names)
    if min is not None:
        x = min + torch.relu(x - min)
    if max is not None:
        x = max - torch.relu(max - x)
    return x


_REWRITES: dict[str, Callable[..., Tensor]] = {
    "pow": _power,
    "__pow__": _power,
    "square": lambda x: x * x,
    "tan": lambda x: torch.sin(x) / torch.cos(x),
    "clamp": _clamp,
    "clip": _clamp,
    "clamp_min": lambda x, min: _clamp(x, min=min),
    "clamp_max": lambda x, max: _clamp(x, max=max),
}


class _Rewriting(TorchFunctionMode):
    """Replaces operations that auto_LiRPA gets wrong by equal ones, and weights by constants, while tracing."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        # A captured nn.Parameter would be taken for one of the traced module's own weights, and a trace takes no
        # constant that requires a gradient.
        def plain(a: Any) -> Any:
            return a.data if isinstance(a, Tensor) and (a.requires_grad or isinstance(a, nn.Parameter)) else a

        args = tuple(plain(a) for a in args)
        kwargs = {key: plain(a) for key, a in (kwargs or {}).items()}
        rewritten: Callable[..., Any] = _REWRITES.get(getattr(func, "__name__", "")) or func
        return rewritten(*args, **kwargs)


class _Traced(nn.Module):
    def __init__(self, function: Callable[..., Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, *inputs: Tensor) -> Tensor:
        with _Rewriting():
            return self.function(*inputs)


def _shortfall(slope: Tensor, offset: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """``min(0, min of sin(y) - slope y - offset over [lower, upper])``.

    The minimum lies at an end or where the derivative vanishes from below, ``y = 2 pi m - arccos(slope)``; along m
    the values are linear, so the first and the last such point decide.
    """
    angle = torch.arccos(slope.clamp(-1, 1))
    first = 2 * math.pi * torch.ceil((lower + angle) / (2 * math.pi)) - angle
    last = 2 * math.pi * torch.floor((upper + angle) / (2 * math.pi)) - angle
    least = torch.zeros_like(slope * lower)
    for y in (lower, upper, first.clamp(lower, upper), last.clamp(lower, upper)):
        least = torch.minimum(least, torch.sin(y) - slope * y - offset)
    return least


def _sound(base: type, phase: float, name: str) -> type:
    """auto_LiRPA's relaxation of ``sin(x + phase)``, its two lines moved apart until they enclose the curve."""

    def bound_relax(self: Any, x: Any, init: bool = False, dim_opt: Any = None) -> None:
        base.bound_relax(self, x, init=init, dim_opt=dim_opt)
        low, high = x.lower + phase, x.upper + phase
        self.lb = self.lb + _shortfall(self.lw, self.lb - self.lw * phase, low, high)
        self.ub = self.ub - _shortfall(self.uw, self.uw * phase - self.ub, -high, -low)

    return type(name, (base,), {"bound_relax": bound_relax})


@functools.cache
def _operations() -> dict[str, type]:
    operations = importlib.import_module(f"{load().__name__}.bound_ops")
    return {
        "onnx::Sin": _sound(operations.BoundSin, 0.0, "BoundSoundSin"),
        "onnx::Cos": _sound(operations.BoundCos, 0.5 * math.pi, "BoundSoundCos"),
    }


def _build(function: Callable[..., Tensor], centers: tuple[Tensor, ...], log: list[str]) -> Any:
    """The graph of ``function`` with a relaxation for every node, refused unless all are in :data:`CHECKED`."""
    # Sparse bounds would make a cell's result depend on which other cells share its batch.
    options = {"sparse_intermediate_bounds": False}
    try:
        module = load().BoundedModule(_Traced(function), centers, bound_opts=options, custom_ops=_operations())
    except NotImplementedError as error:
        named = sorted({n for line in log for n in re.findall(r"Name: \w+::(\w+)", line)})
        what = ", ".join(named) or str(error) or "an operation"
        raise UnsupportedOperationError(
            f"auto_lirpa: auto_LiRPA has no relaxation for {what}; use the affine propagator"
        ) from error
    except RuntimeError as error:
        # What went wrong inside the loop is the context of the library's own complaint.
        why = str(error.__context__ or error).splitlines()[0]
        raise UnsupportedOperationError(f"auto_lirpa: auto_LiRPA cannot trace the loop: {why}") from error
    kinds = {type(node).__name__.removeprefix("Bound") for node in module.nodes()}
    if kinds - CHECKED:
        raise UnsupportedOperationError(
            f"auto_lirpa: auto_LiRPA's relaxation of {', '.join(sorted(kinds - CHECKED))} has not been checked; "
            "use the affine propagator"
        )
    expected, found = function(*centers), module(*centers)
    if not torch.allclose(expected, found, rtol=1e-9, atol=1e-9, equal_nan=True):
        raise UnsupportedOperationError("auto_lirpa: auto_LiRPA reads the loop as another function than it is")
    return module


def _compute(module: Any, boxes: Sequence[Box], method: str) -> tuple[Tensor, Tensor]:
    library = load()
    inputs = tuple(
        library.BoundedTensor(
            box.center, library.PerturbationLpNorm(norm=math.inf, x_L=box.lower.clone(), x_U=box.upper.clone())
        )
        for box in boxes
    )
    try:
        return module.compute_bounds(x=inputs, method=method)
    except AssertionError:
        # Its way to say that a denominator may be zero or negative; one such cell must not spoil the others.
        count = boxes[0].lower.shape[0]
        if count == 1:
            shape = module(*(box.center for box in boxes)).shape
            return torch.full(shape, -math.inf), torch.full(shape, math.inf)
        cells = [[Box(b.lower[i : i + 1], b.upper[i : i + 1]) for b in boxes] for i in range(count)]
        parts = [_compute(module, cell, method) for cell in cells]
        return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])


def bound(function: Callable[..., Tensor], boxes: Sequence[Box], *, method: str = "CROWN") -> Box:
    """A box ``(cells, m)`` around every value of ``function`` on the product of ``boxes``, one per cell.

    Sound in exact arithmetic only: auto_LiRPA computes in plain float64. Where a bound overflows or a denominator may
    be zero or negative, the cell's bounds are infinite.

    Args:
        function: torch code from tensors ``(cells, n_i)`` to one tensor ``(cells, m)``.
        boxes: one box ``(cells, n_i)`` for each argument; they vary independently.
        method: one of :data:`METHODS`.

    Raises:
        UsageError: no usable auto_LiRPA.
        UnsupportedOperationError: an operation that it cannot bound or bounds wrongly; the message names it.
    """
    if method not in METHODS:
        raise UsageError(f"auto_lirpa: method must be one of {', '.join(METHODS)}, found '{method}'")
    load()
    with _quiet() as log, _double_by_default(), torch.no_grad():
        module = _build(function, tuple(box.center for box in boxes), log)
        lower, upper = _compute(module, boxes, method)
    low = torch.where(torch.isnan(lower), -math.inf, lower)
    high = torch.where(torch.isnan(upper), math.inf, upper)
    # Rounding may cross the two bounds of a set that is a point.
    return Box(torch.minimum(low, high), torch.maximum(low, high))
