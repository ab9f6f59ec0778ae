"""A tracker as an ONNX file: the same network, for whoever runs it on the robot.

The file is the function from what the network is given (the lookahead errors one after the other, of most trackers) to
the controls, scales, offsets and saturation included. In float64 it holds the tracker's exact numbers. In float32 they
are rounded, and what was proved of the tracker is proved of the file only up to what that changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.loop.controller import Controller
from sagemp_cli.loop.onnx_format.layers import Layer, Network
from sagemp_cli.loop.onnx_format.tracker import OnnxTracker
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.storage.atomic import write_whole

OPSET = 17
IR_VERSION = 8
"""Old enough for the runtimes that are out there."""

NEWER = {"mish": 18, "gelu": 20, "gelu_tanh": 20}
"""Layers that need a later version of the operators, and which; with it the version of the format is 9."""


def write_onnx(tracker: Controller, path: Path, *, float32: bool = False, overwrite: bool = False) -> None:
    """Write a tracker's network as an ONNX file with one input, ``(batch, entries)``, and one output, ``(batch, m)``.

    Args:
        tracker: one of ours or of an ONNX file.
        path: where to.
        float32: round all numbers to float32, which runtimes prefer; float64, exact, otherwise.
        overwrite: replace a file that is there.

    Raises:
        UsageError: a tracker that is neither, a number that float32 cannot hold, or no package ``onnx``.
        ArtifactError: the file is there already.
    """
    try:
        import onnx
    except ImportError:
        raise UsageError("writing ONNX needs the package 'onnx': pip install 'sagemp[onnx]'") from None
    network = as_network(tracker)
    opset = max([OPSET, *(NEWER.get(layer.kind, 0) for layer in network.layers)])
    graph = _Graph(network, np.float32 if float32 else np.float64, onnx).made(type(tracker).__name__)
    model = onnx.helper.make_model(
        graph,
        producer_name="sagemp",
        opset_imports=[onnx.helper.make_opsetid("", opset)],
        ir_version=IR_VERSION if opset == OPSET else 9,
    )
    onnx.checker.check_model(model)
    write_whole(path, model.SerializeToString(), overwrite=overwrite)


def rounding_to_float32(tracker: Controller) -> tuple[float, float]:
    """What writing in float32 changes: the largest change of a number, and of a control on 4096 random inputs.

    The inputs are between -1 and 1, and only the numbers are rounded, not the arithmetic of whoever runs the network.
    It is a measurement, no bound.
    """
    exact = as_network(tracker)
    constants = {name: value.to(torch.float32).to(torch.float64) for name, value in exact.named_buffers()}
    slopes = [replace(i, numbers=tuple(float(np.float32(v)) for v in i.numbers)) for i in exact.layers]
    rounded = Network(exact.inputs, slopes, constants)
    changes = [float((value - constants[name]).abs().max()) for name, value in exact.named_buffers()]
    changes += [
        abs(a - b)
        for i, j in zip(exact.layers, slopes, strict=True)
        for a, b in zip(i.numbers, j.numbers, strict=True)
        if math.isfinite(a)
    ]
    x = 2 * torch.rand(4096, exact.inputs, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1
    with torch.no_grad():
        return max(changes, default=0.0), float((exact(x) - rounded(x)).abs().max())


def as_network(tracker: Controller) -> Network:
    """The function from what a tracker's network is given to the controls, as layers.

    Raises:
        UsageError: it is of a kind whose layers are not known.
    """
    if isinstance(tracker, OnnxTracker):
        inner = tracker.network
        made = _Layers(inner.inputs, list(inner.layers), dict(inner.named_buffers()))
        last = inner.outputs
    elif isinstance(tracker, Tracker) and type(tracker).forward is Tracker.forward:
        made = _Layers(tracker.lookahead * tracker.state_dim)
        if not bool((tracker.error_scale == 1).all()):
            made.by("mul", tracker.error_scale.repeat(tracker.lookahead))
        for i, layer in enumerate(tracker.layers):
            assert isinstance(layer, torch.nn.Linear)
            if i:
                made.add(Layer("leaky_relu", made.size, (made.last,), (tracker.negative_slope,)))
            made.add(
                Layer("linear", layer.out_features, (made.last,)),
                weight=layer.weight.detach(),
                bias=layer.bias.detach(),
            )
        if tracker.saturate:
            made.add(Layer("clamp", made.size, (made.last,), (-1.0, 1.0)))
        last = tracker.control_dim
    else:
        raise UsageError(f"a tracker of kind {type(tracker).__name__} cannot be written as ONNX")
    assert made.size == last
    if not bool((tracker.control_scale == 1).all()):
        made.by("mul", tracker.control_scale)
    if not bool((tracker.control_offset == 0).all()):
        made.by("add", tracker.control_offset)
    return Network(made.inputs, made.layers, made.constants)


@dataclass
class _Layers:
    """A network that grows."""

    inputs: int
    layers: list[Layer] = field(default_factory=list)
    constants: dict[str, Tensor] = field(default_factory=dict)

    @property
    def last(self) -> int:
        return len(self.layers)

    @property
    def size(self) -> int:
        return self.layers[-1].size if self.layers else self.inputs

    def add(self, layer: Layer, **constants: Tensor) -> None:
        self.layers.append(layer)
        self.constants |= {f"layer{self.last}_{name}": value for name, value in constants.items()}

    def by(self, kind: str, value: Tensor) -> None:
        """The last vector times a constant, or plus one."""
        before, size = self.last, self.size
        self.add(Layer("constant", size), value=value)
        self.add(Layer(kind, size, (before, self.last)))


_NODES = {"relu": "Relu", "tanh": "Tanh", "sigmoid": "Sigmoid", "softplus": "Softplus", "elu": "Elu", "mish": "Mish",
          "gelu": "Gelu", "hardswish": "HardSwish", "softsign": "Softsign", "erf": "Erf", "exp": "Exp", "sqrt": "Sqrt",
          "abs": "Abs", "neg": "Neg", "sin": "Sin", "cos": "Cos", "floor": "Floor", "ceil": "Ceil", "round": "Round",
          "sign": "Sign", "softmax": "Softmax"}  # fmt: skip
_OPERATORS = {"add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div"}


class _Graph:
    """The nodes and constants of a network in one type of numbers."""

    def __init__(self, network: Network, kind: type, onnx: Any) -> None:
        self._network, self._kind, self._onnx = network, kind, onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def made(self, name: str) -> Any:
        """The graph."""
        network, helper = self._network, self._onnx.helper
        names = ["errors"]
        for i, layer in enumerate(network.layers, start=1):
            names.append("controls" if i == len(network.layers) else f"value{i}")
            self._add(i, layer, [names[r] for r in layer.reads], names[i])
        kind = self._onnx.TensorProto.FLOAT if self._kind is np.float32 else self._onnx.TensorProto.DOUBLE
        given = helper.make_tensor_value_info("errors", kind, ["batch", network.inputs])
        result = helper.make_tensor_value_info("controls", kind, ["batch", network.outputs])
        return helper.make_graph(self._nodes, name, [given], [result], self._constants)

    def _add(self, i: int, layer: Layer, reads: list[str], result: str) -> None:
        network = self._network
        match layer.kind:
            case "constant":
                self._constants.append(self._tensor(result, network.constant(i, "value").numpy()[None]))
            case "linear":
                weight = self._constant(f"weight{i}", network.constant(i, "weight").numpy())
                bias = self._constant(f"bias{i}", network.constant(i, "bias").numpy())
                self._node("Gemm", [*reads, weight, bias], result, transB=1)
            case "pick":
                chosen = np.zeros((network.inputs if not layer.reads[0] else self._size(layer.reads[0]), layer.size))
                chosen[list(layer.entries), range(layer.size)] = 1.0
                self._node("MatMul", [*reads, self._constant(f"picked{i}", chosen)], result)
            case "leaky_relu":
                slope = layer.numbers[0]
                if self._kind is np.float32 or float(np.float32(slope)) == slope:
                    self._node("LeakyRelu", reads, result, alpha=slope)
                else:  # whose slope may be any float64, an attribute is float32
                    self._node("PRelu", [*reads, self._constant(f"slope{i}", np.array([slope]))], result)
            case "gelu_tanh":
                self._node("Gelu", reads, result, approximate="tanh")
            case "elu_of":
                alpha = layer.numbers[0]
                if self._kind is not np.float32 and float(np.float32(alpha)) != alpha:
                    raise ConfigError(f"an ELU of alpha {alpha} cannot be written exactly, an attribute is float32")
                self._node("Elu", reads, result, alpha=alpha)
            case "clamp":
                limits = [
                    self._constant(f"{which}{i}", np.array(value)) if math.isfinite(value) else ""
                    for which, value in zip(("lower", "upper"), layer.numbers, strict=True)
                ]
                self._node("Clip", [*reads, *limits], result)
            case kind:
                self._node({**_NODES, **_OPERATORS}[kind], reads, result)

    def _size(self, index: int) -> int:
        return self._network.layers[index - 1].size

    def _node(self, op: str, reads: list[str], result: str, **attributes: Any) -> None:
        self._nodes.append(self._onnx.helper.make_node(op, reads, [result], **attributes))

    def _constant(self, name: str, array: np.ndarray) -> str:
        self._constants.append(self._tensor(name, array))
        return name

    def _tensor(self, name: str, array: np.ndarray) -> Any:
        with np.errstate(over="ignore"):
            rounded = array.astype(self._kind)
        if not np.isfinite(rounded).all():
            raise ConfigError(f"{name}: a number of the tracker is too large for float32")
        return self._onnx.numpy_helper.from_array(rounded, name)
