"""A network as data: layers on vectors, evaluated in torch.

What an ONNX file says about tensors of any shape becomes a short list of layers on vectors
(:mod:`sagemp_cli.loop.onnx_format.lowering`). The list is plain data, so that an artifact can carry it; the numbers are
float64 and taken as exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError

MOST_NUMBERS = 2**24
"""Weights and entries of a network at most: far more than can be bounded."""

SOFTPLUS_THRESHOLD = 50.0
"""Where softplus is taken as its argument, which differs from it by less than 2e-22."""

FUNCTIONS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "relu": (0, torch.relu),
    "leaky_relu": (1, nn.functional.leaky_relu),
    "tanh": (0, torch.tanh),
    "sigmoid": (0, torch.sigmoid),
    "elu": (0, nn.functional.elu),
    "softplus": (0, lambda a: nn.functional.softplus(a, 1.0, SOFTPLUS_THRESHOLD)),
    "clamp": (2, torch.clamp),
    "elu_of": (1, lambda a, alpha: nn.functional.elu(a, alpha)),
    "gelu": (0, nn.functional.gelu),
    "gelu_tanh": (0, lambda a: nn.functional.gelu(a, approximate="tanh")),
    "mish": (0, nn.functional.mish),
    "hardswish": (0, nn.functional.hardswish),
    "softsign": (0, nn.functional.softsign),
    "erf": (0, torch.erf),
    "exp": (0, torch.exp),
    "sqrt": (0, torch.sqrt),
    "abs": (0, torch.abs),
    "neg": (0, torch.neg),
    "sin": (0, torch.sin),
    "cos": (0, torch.cos),
    "floor": (0, torch.floor),
    "ceil": (0, torch.ceil),
    "round": (0, torch.round),
    "sign": (0, torch.sign),
    "softmax": (0, lambda a: torch.softmax(a, -1)),
}
"""Of one vector, entry by entry or (softmax) as a whole: how many numbers it has of its own, and what it does."""

OPERATORS: Mapping[str, Callable[[Any, Any], Any]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
}
"""Of two vectors of the same length, entry by entry."""


@dataclass(frozen=True)
class Layer:
    """What makes one vector.

    Attributes:
        kind: ``linear``, ``constant``, ``pick``, or one of :data:`FUNCTIONS` and :data:`OPERATORS`.
        size: entries of the result.
        reads: which vectors: 0 is the network's input, i the result of layer i - 1.
        numbers: slope of a leaky ReLU, alpha of an ELU that has another than 1, limits of a clamp (infinite where there
            is none).
        entries: which are picked.
    """

    kind: str
    size: int
    reads: tuple[int, ...] = ()
    numbers: tuple[float, ...] = ()
    entries: tuple[int, ...] = ()

    def as_data(self) -> dict[str, Any]:
        """As plain data that JSON can hold."""
        numbers = [n if math.isfinite(n) else None for n in self.numbers]
        return {"kind": self.kind, "size": self.size, "reads": [*self.reads], "numbers": numbers} | (
            {"entries": [*self.entries]} if self.entries else {}
        )

    @classmethod
    def of(cls, data: Any, where: str) -> Layer:
        """Back from data that anybody may have written; whether it fits its network is that one's to say.

        Raises:
            ConfigError: it is no layer.
        """
        known = {"kind": str, "size": int, "reads": list, "numbers": list, "entries": list}
        if not isinstance(data, Mapping) or not {"kind", "size", "reads", "numbers"} <= set(data) <= set(known):
            raise ConfigError(f"{where} must have {', '.join(known)}, found {str(data)[:80]}")
        if any(not isinstance(value, known[key]) or isinstance(value, bool) for key, value in data.items()):
            raise ConfigError(f"{where} must have a kind, a size and lists, found {str(data)[:80]}")
        whole = [*data["reads"], *data.get("entries", [])]
        if any(not isinstance(v, int) or isinstance(v, bool) for v in whole):
            raise ConfigError(f"{where} must read whole numbers, found {str(whole)[:80]}")
        numbers = data["numbers"]
        if any(v is not None and (not isinstance(v, int | float) or isinstance(v, bool)) for v in numbers):
            raise ConfigError(f"{where} must have numbers, found {str(numbers)[:80]}")
        # None is where a clamp has no limit: the lower one comes first.
        filled = [(-math.inf, math.inf)[min(i, 1)] if v is None else float(v) for i, v in enumerate(numbers)]
        return cls(data["kind"], data["size"], tuple(data["reads"]), tuple(filled), tuple(data.get("entries", [])))


class Network(nn.Module):
    """Layers one after the other; the last one's result is the output. The arithmetic is that of the input's type.

    Args:
        inputs: entries of the input.
        layers: see :class:`Layer`; at least one.
        constants: by name: ``layer1_weight`` and ``layer1_bias`` of a linear layer that is the first, ``layer2_value``
            of a constant that is the second, and so on; zeros if they are loaded later.

    Raises:
        ConfigError: it is no network, or a larger one than may be.
    """

    def __init__(self, inputs: int, layers: Sequence[Layer], constants: Mapping[str, Tensor] | None = None) -> None:
        super().__init__()
        self.inputs, self.layers = inputs, tuple(layers)
        sizes, numbers = [inputs], 0
        shapes: dict[str, tuple[int, ...]] = {}
        for i, layer in enumerate(self.layers, start=1):
            _check(layer, sizes, f"network: layer {i}")
            own = _shapes(layer, sizes)
            numbers += layer.size + sum(math.prod(shape) for shape in own.values())
            if numbers > MOST_NUMBERS:
                raise ConfigError(f"network: it has more than {MOST_NUMBERS} numbers, far more than can be bounded")
            shapes |= {f"layer{i}_{name}": shape for name, shape in own.items()}
            sizes.append(layer.size)
        if len(sizes) == 1:
            raise ConfigError("network: it has no layers")
        self.outputs = sizes[-1]
        for name, shape in shapes.items():
            value = torch.zeros(shape, dtype=torch.float64) if constants is None else constants[name]
            if value.shape != shape or not bool(torch.isfinite(value).all()):
                raise ConfigError(f"network: {name} must be {shape} finite numbers, found {tuple(value.shape)}")
            self.register_buffer(name, value)

    def constant(self, i: int, name: str) -> Tensor:
        """A constant of layer i: ``weight`` and ``bias``, or ``value``."""
        return getattr(self, f"layer{i}_{name}")

    def _of_type(self, i: int, name: str, kind: torch.dtype) -> Tensor:
        value = self.constant(i, name)
        if kind is value.dtype:
            return value
        found = value.to(kind)
        if not torch.equal(found.to(value.dtype), value):
            raise ConfigError(
                f"network: {name} of layer {i} has numbers that are not of float32, as a float64 file has or a 'Gemm' "
                f"with a factor; it cannot be evaluated in float32"
            )
        return found

    def forward(self, x: Any) -> Any:
        """Outputs ``(..., outputs)`` from inputs ``(..., inputs)``."""
        values = [x]
        for i, layer in enumerate(self.layers, start=1):
            values.append(self._layer(i, layer, [values[r] for r in layer.reads], x.dtype))
        return values[-1]

    def _layer(self, i: int, layer: Layer, reads: Sequence[Any], kind: torch.dtype) -> Any:
        if layer.kind == "linear":
            weight, bias = (self._of_type(i, name, kind) for name in ("weight", "bias"))
            return nn.functional.linear(reads[0], weight, bias)
        if layer.kind == "constant":
            return self._of_type(i, "value", kind)
        if layer.kind == "pick":
            return torch.index_select(reads[0], -1, torch.tensor(layer.entries))
        if layer.kind in OPERATORS:
            return OPERATORS[layer.kind](*reads)
        return FUNCTIONS[layer.kind][1](*reads, *layer.numbers)


def _shapes(layer: Layer, sizes: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Shapes of a layer's constants by name."""
    if layer.kind == "linear":
        return {"weight": (layer.size, sizes[layer.reads[0]]), "bias": (layer.size,)}
    return {"value": (layer.size,)} if layer.kind == "constant" else {}


def _check(layer: Layer, sizes: Sequence[int], where: str) -> None:
    """Refuse a layer that does not fit those before it, which have these sizes."""
    counts = {"linear": (1, 0), "constant": (0, 0), "pick": (1, 0)}
    counts |= {name: (1, numbers) for name, (numbers, _) in FUNCTIONS.items()}
    counts |= dict.fromkeys(OPERATORS, (2, 0))
    if layer.kind not in counts:
        raise ConfigError(f"{where}: '{layer.kind[:40]}' is none of {', '.join(counts)}")
    reads, numbers = counts[layer.kind]
    if len(layer.reads) != reads or len(layer.numbers) != numbers:
        raise ConfigError(f"{where}: {layer.kind} reads {reads} vectors and has {numbers} numbers")
    if not 0 < layer.size <= MOST_NUMBERS or any(not 0 <= r < len(sizes) for r in layer.reads):
        raise ConfigError(f"{where}: it must read earlier vectors and have a size of at least 1")
    read = [sizes[r] for r in layer.reads]
    if layer.kind == "pick":
        if len(layer.entries) != layer.size or any(not 0 <= e < read[0] for e in layer.entries):
            raise ConfigError(f"{where}: it picks entries that are not there")
    elif layer.entries or (layer.kind not in ("linear", "constant") and set(read) != {layer.size}):
        raise ConfigError(f"{where}: {layer.kind} makes {layer.size} entries of {read}")
    if any(math.isnan(n) for n in layer.numbers) or (layer.kind == "leaky_relu" and not -1 <= layer.numbers[0] <= 1):
        raise ConfigError(f"{where}: {layer.kind} cannot have {list(layer.numbers)}")
    if layer.kind == "elu_of" and not 0 < layer.numbers[0] < math.inf:
        raise ConfigError(f"{where}: {layer.kind} cannot have {list(layer.numbers)}")
