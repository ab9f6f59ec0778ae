"""From the nodes of an ONNX file to layers on vectors: what is supported, and what is refused by name.

A network is read as the real function that it describes: weights are the exact (float32 or float64) numbers that are
stored, sums and products are exact, activations are the real ones. Casts between float32 and float64 are therefore the
identity. An inference engine that computes in float32 differs by its own rounding, of which only a proof speaks that
calls the layers in float32 (:mod:`.layers`).

Longer than other files, since every operator that is supported is here, and no other is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.loop.onnx_format.layers import MOST_NUMBERS, Layer, Network
from sagemp_cli.reading.reader import read_onnx

OPSETS = range(6, 26)
"""Versions of the operators that are read; their meaning did not change."""

_FLOATS = {1: "FLOAT", 11: "DOUBLE"}


def read_network(path: Path) -> Network:
    """The network of an ONNX file, on vectors: its input and its output flattened, without the batch.

    Raises:
        ArtifactError: it is no ONNX file, or it has what is not supported; the message names it.
    """
    graph = read_onnx(path)
    try:
        return _Lowering(graph).network()
    except (_RefusedError, ConfigError) as e:
        raise ArtifactError(f"{path}: {e}") from None


class _RefusedError(Exception):
    """A network that is not read, and why."""


@dataclass(frozen=True)
class _Vector:
    """A value that depends on the input: which vector it is, and the shape that it has in the file."""

    index: int
    shape: tuple[int, ...]


@dataclass
class _Lowering:
    """Values by name: arrays of constants, vectors of the rest; the layers so far and their constants."""

    graph: Mapping[str, Any]
    values: dict[str, Any] = field(default_factory=dict)
    layers: list[Layer] = field(default_factory=list)
    constants: dict[str, torch.Tensor] = field(default_factory=dict)
    written: set[str] = field(default_factory=set)
    numbers: int = 0

    def network(self) -> Network:
        graph = self.graph
        if graph["opset"] not in OPSETS:
            raise _RefusedError(
                f"uses operators of version {graph['opset']}, supported are {OPSETS[0]} to {OPSETS[-1]}"
            )
        if len(graph["inputs"]) != 1 or len(graph["outputs"]) != 1:
            found = f"{len(graph['inputs'])} and {len(graph['outputs'])}"
            raise _RefusedError(f"must have one input and one output, found {found}")
        made = {name for node in graph["nodes"] for name in node["outputs"] if node["op"] == "Constant"}
        for name, array in graph["arrays"].items():
            if not np.isfinite(array).all():
                raise _RefusedError(f"has NaN or infinity among the weights '{name}'")
            if name not in made:
                self._define(name, array)
        given = graph["inputs"][0]
        shape = _static(given)
        self._define(given["name"], _Vector(0, shape))
        for node in graph["nodes"]:
            self._node(node)
        result = self.values.get(graph["outputs"][0]["name"])
        if not isinstance(result, _Vector):
            raise _RefusedError("has an output that does not depend on its input")
        if result.index != len(self.layers):  # the last layer's result is the network's
            size = math.prod(result.shape)
            self._layer(Layer("pick", size, (result.index,), entries=tuple(range(size))), result.shape)
        if not self.layers:
            raise _RefusedError("has no layers")
        return Network(math.prod(shape), self.layers, self.constants)

    def _node(self, node: Mapping[str, Any]) -> None:
        op, inputs, outputs = node["op"], node["inputs"], node["outputs"]
        if op not in _OPS:
            raise _RefusedError(f"uses '{op}', which is not supported; supported are {', '.join(_OPS)}")
        if len(outputs) != 1:
            raise _RefusedError(f"has a '{op}' with {len(outputs)} results, one is supported")
        for name in inputs:
            if name and name not in self.values:
                raise _RefusedError(f"has a '{op}' that reads '{name}' before there is such a value")
        least, most, known, make = _OPS[op]
        if not least <= len(inputs) <= most or not all(inputs[:least]):
            raise _RefusedError(f"has a '{op}' with {len(inputs)} inputs, {least} to {most} are supported")
        unknown = sorted(set(node["attributes"]) - set(known))
        if unknown:
            raise _RefusedError(f"has a '{op}' with '{unknown[0]}', which is not supported")
        # Before version 7 the second operand was repeated only if 'broadcast' said so; since then it always may be.
        attributes = {key: value for key, value in node["attributes"].items() if key != "broadcast"}
        operands = [self.values[name] if name else None for name in inputs]
        self._define(outputs[0], make(self, op, operands, attributes))

    def _define(self, name: str, value: Any) -> None:
        if not name or name in self.written:
            raise _RefusedError(f"defines '{name}' twice")
        self.written.add(name)
        self.values[name] = value

    def _layer(self, layer: Layer, shape: Sequence[int], **constants: np.ndarray) -> _Vector:
        self.numbers += layer.size + sum(c.size for c in constants.values())
        if self.numbers > MOST_NUMBERS:
            raise _RefusedError(f"has more than {MOST_NUMBERS} numbers, far more than can be bounded")
        self.layers.append(layer)
        for name, array in constants.items():
            copied = np.array(array, dtype=np.float64)
            self.constants[f"layer{len(self.layers)}_{name}"] = torch.from_numpy(copied)
        return _Vector(len(self.layers), tuple(shape))

    # -- what the operators do ---------------------------------------------------------------------------------------

    def constant(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """A constant, which is read with the file."""
        if set(attributes) == {"value"}:
            return self.graph["arrays"][attributes["value"]]
        for key, kind in (("value_float", np.float32), ("value_floats", np.float32)):
            if set(attributes) == {key}:
                return _finite(op, np.array(attributes[key], dtype=kind))
        for key in ("value_int", "value_ints"):
            if set(attributes) == {key}:
                return np.array(attributes[key], dtype=np.int64)
        raise _RefusedError("has a 'Constant' of a kind that is not supported")

    def same(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """The value itself."""
        if op == "Cast" and attributes.get("to") not in _FLOATS:
            raise _RefusedError(f"has a 'Cast' to another type than {' and '.join(_FLOATS.values())}")
        if op == "Cast" and not isinstance(operands[0], _Vector):
            wide = _weights(op, operands[0])
            kind = np.float32 if attributes["to"] == 1 else np.float64
            if not np.array_equal(wide.astype(kind).astype(np.float64), wide.astype(np.float64)):
                raise _RefusedError("has a 'Cast' that rounds a constant")
            return wide.astype(kind)
        return operands[0]

    def affine(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """``alpha A B + beta C`` (Gemm), ``A B`` (MatMul)."""
        if attributes.get("transA", 0):
            raise _RefusedError("has a 'Gemm' with transA, which is not supported")
        vector, matrix = operands[0], operands[1]
        if not isinstance(vector, _Vector) or isinstance(matrix, _Vector):
            raise _RefusedError(f"has a '{op}' that does not multiply a value by constant weights from the right")
        matrix = _weights(op, matrix)
        if matrix.ndim != 2:
            raise _RefusedError(f"has a '{op}' with weights of shape {list(matrix.shape)}, two dimensions are needed")
        weight = matrix if attributes.get("transB", 0) else matrix.T
        rows, columns = weight.shape
        *lead, last = vector.shape or (0,)
        if last != columns or (op == "Gemm" and math.prod(lead) != 1 and len(lead) != 1):
            raise _RefusedError(f"has a '{op}' of shape {list(vector.shape)} with weights for {columns} entries")
        times = math.prod(lead)
        if times * rows > MOST_NUMBERS or times**2 * weight.size > MOST_NUMBERS:
            raise _RefusedError(f"has a '{op}' of more than {MOST_NUMBERS} numbers, far more than can be bounded")
        weight = _scaled(weight, attributes.get("alpha", 1.0), op)
        bias = np.zeros((*lead, rows))
        if len(operands) > 2 and operands[2] is not None:
            if isinstance(operands[2], _Vector):
                raise _RefusedError(f"has a '{op}' that adds what is no constant")
            added = _scaled(_weights(op, operands[2]), attributes.get("beta", 1.0), op)
            bias = _broadcast(added, (*lead, rows), op)
        block = np.kron(np.eye(times), weight) if times != 1 else weight
        layer = Layer("linear", times * rows, (vector.index,))
        return self._layer(layer, (*lead, rows), weight=block, bias=bias.reshape(-1))

    def convolution(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """A convolution whose window is one entry, or all there is: a linear layer."""
        vector = operands[0]
        if not isinstance(vector, _Vector) or any(isinstance(o, _Vector) for o in operands[1:]):
            raise _RefusedError("has a 'Conv' whose weights are no constants")
        weight = _weights(op, operands[1])
        if weight.ndim < 3 or len(vector.shape) != weight.ndim or vector.shape[0] != 1:
            raise _RefusedError(f"has a 'Conv' of shape {list(vector.shape)} with weights {list(weight.shape)}")
        outputs, channels, *window = weight.shape
        space = list(vector.shape[2:])
        plain = {"group": [1], "dilations": [1], "strides": [1], "pads": [0]}
        for key, allowed in plain.items():
            found = attributes.get(key, allowed)
            if any(v not in allowed for v in (found if isinstance(found, list) else [found])):
                raise _RefusedError(f"has a 'Conv' with {key} {found}, which is not supported")
        if attributes.get("auto_pad", "NOTSET") not in ("NOTSET", "VALID"):
            raise _RefusedError(f"has a 'Conv' with auto_pad {attributes['auto_pad']}, which is not supported")
        if attributes.get("kernel_shape", window) != window or vector.shape[1] != channels:
            raise _RefusedError(f"has a 'Conv' of shape {list(vector.shape)} with weights {list(weight.shape)}")
        whole = window == space
        if not whole and any(size != 1 for size in window):
            raise _RefusedError(f"has a 'Conv' with a window {window} over {space}; supported are 1x1 and all of it")
        points = 1 if whole else math.prod(space)
        if points**2 * weight.size > MOST_NUMBERS:
            raise _RefusedError(f"has a 'Conv' of more than {MOST_NUMBERS} numbers, far more than can be bounded")
        matrix = np.kron(weight.reshape(outputs, -1), np.eye(points))
        bias = np.zeros(outputs)
        if len(operands) > 2 and operands[2] is not None:
            bias = _weights(op, operands[2])
            if bias.shape != (outputs,):
                raise _RefusedError(f"has a 'Conv' with {bias.size} offsets for {outputs} outputs")
        shape = (1, outputs, *([1] * len(space) if whole else space))
        layer = Layer("linear", outputs * points, (vector.index,))
        return self._layer(layer, shape, weight=matrix, bias=np.repeat(bias, points))

    def binary(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """Sum, difference, product or quotient of two values, entry by entry."""
        shapes = [o.shape for o in operands]
        if not any(isinstance(o, _Vector) for o in operands):
            raise _RefusedError(f"has a '{op}' of two constants; fold them into one first")
        try:
            shape = np.broadcast_shapes(*shapes)
        except ValueError:
            raise _RefusedError(f"has a '{op}' of shapes {[*map(list, shapes)]}, which do not fit") from None
        size = math.prod(shape)
        divisor = operands[1]
        if op == "Div" and not isinstance(divisor, _Vector) and not np.all(divisor):
            raise _RefusedError("has a 'Div' by zero")
        reads = [self._spread(op, o, shape, size) for o in operands]
        return self._layer(Layer(op.lower(), size, tuple(reads)), shape)

    def _spread(self, op: str, value: Any, shape: tuple[int, ...], size: int) -> int:
        """The vector of a value that is repeated to a shape."""
        if size > MOST_NUMBERS:
            raise _RefusedError(f"has a '{op}' of more than {MOST_NUMBERS} numbers, far more than can be bounded")
        if not isinstance(value, _Vector):
            array = _broadcast(_weights(op, value), shape, op)
            return self._layer(Layer("constant", size), shape, value=array.reshape(-1)).index
        if math.prod(value.shape) == size:
            return value.index
        entries = np.broadcast_to(np.arange(math.prod(value.shape)).reshape(value.shape), shape).reshape(-1)
        return self._layer(Layer("pick", size, (value.index,), entries=tuple(entries.tolist())), shape).index

    def function(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """An activation."""
        vector, numbers = operands[0], ()
        if not isinstance(vector, _Vector):
            raise _RefusedError(f"has a '{op}' of a constant; fold it into one first")
        if op == "LeakyRelu":
            numbers = (attributes.get("alpha", float(np.float32(0.01))),)
            if not -1 <= numbers[0] <= 1:
                raise _RefusedError(f"has a 'LeakyRelu' with slope {numbers[0]}, supported is -1 to 1")
        if op == "Elu" and attributes.get("alpha", 1.0) != 1.0:
            numbers = (float(attributes["alpha"]),)
            if not numbers[0] > 0:
                raise _RefusedError(f"has an 'Elu' with alpha {numbers[0]}, supported is a positive one")
        if op == "Gelu" and attributes.get("approximate", "none") not in ("none", "tanh"):
            raise _RefusedError(
                f"has a 'Gelu' with approximate '{attributes['approximate']}', supported are none and tanh"
            )
        if op == "Softmax":
            axis = attributes.get("axis", -1 if self.graph["opset"] >= 13 else 1)
            if not -len(vector.shape) <= axis < len(vector.shape) or vector.shape[axis] != math.prod(vector.shape):
                raise _RefusedError(
                    f"has a 'Softmax' along axis {axis} of shape {list(vector.shape)}; it must be over all entries"
                )
        if op == "Clip":
            numbers = tuple(
                _limit(attributes.get(key), operands[i] if len(operands) > i else None, none)
                for i, key, none in ((1, "min", -math.inf), (2, "max", math.inf))
            )
        if op == "PRelu":
            slopes = None if isinstance(operands[1], _Vector) else np.unique(_weights(op, operands[1]))
            if slopes is None or len(slopes) != 1 or not -1 <= slopes[0] <= 1:
                raise _RefusedError("has a 'PRelu' whose slope is not one constant of -1 to 1")
            numbers = (float(slopes[0]),)
        kind = {"LeakyRelu": "leaky_relu", "PRelu": "leaky_relu", "Clip": "clamp"}.get(op, op.lower())
        if op == "Gelu" and attributes.get("approximate", "none") == "tanh":
            kind = "gelu_tanh"
        if op == "Elu" and numbers:
            kind = "elu_of"
        size = math.prod(vector.shape)
        return self._layer(Layer(kind, size, (vector.index,), numbers), vector.shape)

    def shaped(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """The same entries in another shape."""
        value = operands[0]
        shape, size = tuple(value.shape), math.prod(value.shape)
        if op == "Flatten":
            axis = attributes.get("axis", 1)
            if not -len(shape) <= axis <= len(shape):
                raise _RefusedError(f"has a 'Flatten' at axis {axis} of shape {list(shape)}")
            new = (math.prod(shape[:axis]), math.prod(shape[axis:]))
        else:
            wanted = attributes.get("shape") if len(operands) == 1 else operands[1]
            if wanted is None or isinstance(wanted, _Vector) or np.asarray(wanted).dtype != np.int64:
                raise _RefusedError("has a 'Reshape' whose shape is no constant")
            new = _reshaped(shape, np.asarray(wanted).reshape(-1).tolist(), attributes.get("allowzero", 0))
        if math.prod(new) != size:
            raise _RefusedError(f"has a '{op}' from shape {list(shape)} to {list(new)}")
        return _Vector(value.index, new) if isinstance(value, _Vector) else value.reshape(new)

    def transposed(self, op: str, operands: Sequence[Any], attributes: Mapping[str, Any]) -> Any:
        """Dimensions in another order."""
        value = operands[0]
        axes = attributes.get("perm", list(range(len(value.shape)))[::-1])
        if sorted(axes) != list(range(len(value.shape))):
            raise _RefusedError(f"has a 'Transpose' with perm {axes} of shape {list(value.shape)}")
        if not isinstance(value, _Vector):
            return value.transpose(axes)
        index = np.arange(math.prod(value.shape)).reshape(value.shape).transpose(axes)
        entries = tuple(index.reshape(-1).tolist())
        if entries == tuple(range(len(entries))):
            return _Vector(value.index, index.shape)
        return self._layer(Layer("pick", len(entries), (value.index,), entries=entries), index.shape)


def _static(given: Mapping[str, Any]) -> tuple[int, ...]:
    """The input's shape; a first size that is not said is a batch, of one."""
    shape = list(given["shape"])
    if given["type"] == "other":
        raise _RefusedError(f"has an input '{given['name']}' of another type than FLOAT and DOUBLE")
    if shape and shape[0] in (None, 0):
        shape[0] = 1
    if not shape or any(size is None or size < 1 for size in shape):
        raise _RefusedError(f"has an input of shape {given['shape']}; only the batch, which comes first, may be open")
    if math.prod(shape) > MOST_NUMBERS:
        raise _RefusedError(f"has an input of shape {shape}, far more than can be bounded")
    return tuple(shape)


def _weights(op: str, array: Any) -> np.ndarray:
    if array is None or array.dtype not in (np.float32, np.float64):
        raise _RefusedError(f"has a '{op}' of whole numbers, supported are FLOAT and DOUBLE")
    return array


def _finite(op: str, array: np.ndarray) -> np.ndarray:
    if not np.isfinite(array).all():
        raise _RefusedError(f"has NaN or infinity in a '{op}'")
    return array


def _scaled(array: np.ndarray, factor: float, op: str) -> np.ndarray:
    """The array times a factor, without rounding: float32 numbers by a float32 number are exact in float64."""
    wide = array.astype(np.float64)
    if factor == 1.0:
        return wide
    exact = array.dtype == np.float32 or abs(math.frexp(factor)[0]) == 0.5
    if not exact or not math.isfinite(factor):
        raise _RefusedError(f"has a '{op}' with a factor {factor} on float64 weights; fold it into them first")
    return _finite(op, wide * factor)


def _broadcast(array: np.ndarray, shape: tuple[int, ...], op: str) -> np.ndarray:
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise _RefusedError(f"has a '{op}' of shapes {list(shape)} and {list(array.shape)}, which do not fit") from None


def _limit(said: float | None, given: Any, none: float) -> float:
    """A limit of a Clip: an attribute, a constant input, or none."""
    if given is None:
        return none if said is None else float(said)
    if isinstance(given, _Vector) or np.size(given) != 1:
        raise _RefusedError("has a 'Clip' whose limits are no constants")
    return float(np.asarray(given).reshape(()))


def _reshaped(shape: tuple[int, ...], wanted: list[int], allow_zero: int) -> tuple[int, ...]:
    if any(v < -1 for v in wanted) or wanted.count(-1) > 1 or (allow_zero and 0 in wanted):
        raise _RefusedError(f"has a 'Reshape' to {wanted}")
    if any(v == 0 and i >= len(shape) for i, v in enumerate(wanted)):
        raise _RefusedError(f"has a 'Reshape' from {list(shape)} to {wanted}")
    new = [shape[i] if v == 0 else v for i, v in enumerate(wanted)]
    if -1 in new:
        rest = -math.prod(new)
        new[new.index(-1)] = math.prod(shape) // rest if rest > 0 else 0
    return tuple(new)


_Make = Callable[[_Lowering, str, Sequence[Any], Mapping[str, Any]], Any]

_OPS: Mapping[str, tuple[int, int, tuple[str, ...], _Make]] = {
    "Gemm": (2, 3, ("alpha", "beta", "transA", "transB", "broadcast"), _Lowering.affine),
    "MatMul": (2, 2, (), _Lowering.affine),
    "Conv": (
        2,
        3,
        ("auto_pad", "dilations", "group", "kernel_shape", "pads", "strides"),
        _Lowering.convolution,
    ),
    "Add": (2, 2, ("broadcast",), _Lowering.binary),
    "Sub": (2, 2, ("broadcast",), _Lowering.binary),
    "Mul": (2, 2, ("broadcast",), _Lowering.binary),
    "Div": (2, 2, ("broadcast",), _Lowering.binary),
    "Relu": (1, 1, (), _Lowering.function),
    "LeakyRelu": (1, 1, ("alpha",), _Lowering.function),
    "PRelu": (2, 2, (), _Lowering.function),
    "Tanh": (1, 1, (), _Lowering.function),
    "Sigmoid": (1, 1, (), _Lowering.function),
    "Elu": (1, 1, ("alpha",), _Lowering.function),
    "Softplus": (1, 1, (), _Lowering.function),
    "Gelu": (1, 1, ("approximate",), _Lowering.function),
    "Softmax": (1, 1, ("axis",), _Lowering.function),
    **dict.fromkeys(
        (
            "Mish",
            "HardSwish",
            "Softsign",
            "Erf",
            "Exp",
            "Sqrt",
            "Abs",
            "Neg",
            "Sin",
            "Cos",
            "Floor",
            "Ceil",
            "Round",
            "Sign",
        ),
        (1, 1, (), _Lowering.function),
    ),
    "Clip": (1, 3, ("min", "max"), _Lowering.function),
    "Flatten": (1, 1, ("axis",), _Lowering.shaped),
    "Reshape": (1, 2, ("shape", "allowzero"), _Lowering.shaped),
    "Transpose": (1, 1, ("perm",), _Lowering.transposed),
    "Identity": (1, 1, (), _Lowering.same),
    "Cast": (1, 1, ("to", "saturate"), _Lowering.same),
    "Constant": (
        0,
        0,
        ("value", "value_float", "value_floats", "value_int", "value_ints"),
        _Lowering.constant,
    ),
}
"""Inputs at least and at most, attributes, and what makes the result."""
