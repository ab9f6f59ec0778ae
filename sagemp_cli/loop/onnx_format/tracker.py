"""A controller that somebody else trained, from an ONNX file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor

from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.controller import (
    Controller,
    Precision,
    check_precision,
    lookahead_errors,
    scaled_in_float32,
)
from sagemp_cli.loop.onnx_format.layers import Layer, Network
from sagemp_cli.loop.onnx_format.lowering import read_network

Inputs = Literal["errors", "state", "state_and_reference"]
"""What a network may be given; see :class:`OnnxTracker`."""

INPUTS: tuple[str, ...] = get_args(Inputs)


class OnnxTracker(Controller):
    """``u = control_scale * network(input) + control_offset``, the network's weights taken as the numbers stored.

    Of its own arithmetic an ONNX file says float32; here the network is the real function with these weights, evaluated
    in float64 (:mod:`sagemp_cli.loop.onnx_format.lowering`), unless ``precision`` is float32: then the input is rounded
    to float32 and network, scale and offset are evaluated in float32 arithmetic.

    Args:
        state_dim, control_dim: of the robot.
        path: the ONNX file; read by ``train-tracker`` only, which keeps the network in its own file.
        inputs: what the network is given: the lookahead errors ``[p_{k+1} - x, ..., p_{k+N} - x]`` one after the other
            (``errors``), the state ``x`` (``state``), or the state and after it ``p_{k+1}, ..., p_{k+N}``
            (``state_and_reference``). N follows from the size of the network's input.
        control_scale, control_offset: m numbers each; 1 and 0 if not given.
        precision: see above.
        network: its layers as plain data, as an artifact has them.
    """

    trains: ClassVar[bool] = False
    control_scale: Tensor
    control_offset: Tensor

    def __init__(
        self,
        *,
        state_dim: int,
        control_dim: int,
        path: str = "",
        inputs: Inputs = "errors",
        control_scale: list[float] | None = None,
        control_offset: list[float] | None = None,
        precision: Precision = "real",
        network: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if network is None:
            raise ConfigError("tracker: a network of an ONNX file is made by train-tracker")
        check_precision(precision)
        self.precision = precision
        self._set(state_dim, control_dim, inputs, _restored(network))
        self._scaled(control_scale, control_offset)
        self.path = path

    @classmethod
    def taken(
        cls, *, state_dim: int, control_dim: int, path: str = "", inputs: Inputs = "errors", **others: Any
    ) -> OnnxTracker:
        """From the file that ``path`` names, see :meth:`~sagemp_cli.loop.controller.Controller.taken`.

        Raises:
            ConfigError: no path is given, or the network does not fit the robot.
            ArtifactError: the file is missing or holds what is not supported.
        """
        if not path:
            raise ConfigError("tracker.path must name an ONNX file: tracker.path=net.onnx")
        found = read_network(Path(path))
        arguments = {"state_dim": state_dim, "control_dim": control_dim, "path": path, "inputs": inputs, **others}
        try:
            made = cls(**arguments, network=as_data(found))
        except ConfigError as e:
            raise ConfigError(f"{path}: {e}") from None
        made.network = found
        return made

    def arguments(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """See :meth:`~sagemp_cli.loop.controller.Controller.arguments`; the network is among them."""
        return {
            "state_dim": self.state_dim,
            "control_dim": self.control_dim,
            "path": self.path,
            "inputs": self.inputs,
            "control_scale": self.control_scale.tolist(),
            "control_offset": self.control_offset.tolist(),
            "precision": self.precision,
            "network": as_data(self.network),
        }

    def files(self) -> tuple[Path, ...]:
        """The ONNX file."""
        return (Path(self.path),)

    def features(self, window: Tensor, x: Tensor) -> Tensor:
        """What the network is given, ``(..., size of its input)``; override it for features of your own."""
        if self.inputs == "state":
            return x
        if self.inputs == "errors":
            return lookahead_errors(window, x).flatten(-2)
        # Both parts with the batch of both: the reference's alone may have another one.
        return torch.cat([x, (window + 0.0 * x[..., None, :]).flatten(-2)], dim=-1)

    def control(self, window: Tensor, x: Tensor) -> Tensor:
        """Controls ``(..., m)``; see :class:`~sagemp_cli.loop.controller.Controller`."""
        if self.precision == "float32":
            h = self.network(self.features(window, x).float())
            return scaled_in_float32(h, self.control_scale, self.control_offset)
        return self.network(self.features(window, x)) * self.control_scale + self.control_offset

    def _set(self, n: int, m: int, inputs: str, network: Network) -> None:
        if inputs not in INPUTS:
            raise ConfigError(f"tracker.inputs must be one of {', '.join(INPUTS)}, found {inputs!r}")
        seen = {"errors": network.inputs, "state": n, "state_and_reference": network.inputs - n}[inputs]
        if seen < n or seen % n or (inputs == "state" and network.inputs != n):
            needs = {"errors": f"a multiple of {n}", "state": str(n)}.get(inputs, f"{n} and a multiple of {n} more")
            raise ConfigError(
                f"the network takes {network.inputs} numbers; with tracker.inputs={inputs} a robot of {n} states "
                f"gives {needs}"
            )
        if network.outputs != m:
            raise ConfigError(f"the network gives {network.outputs} numbers, the robot has {m} controls")
        self.state_dim, self.control_dim, self.lookahead = n, m, seen // n
        self.inputs, self.network = inputs, network

    def _scaled(self, scale: Sequence[float] | None, offset: Sequence[float] | None) -> None:
        for key, values, default in (("control_scale", scale, 1.0), ("control_offset", offset, 0.0)):
            filled = [default] * self.control_dim if values is None else [float(v) for v in values]
            if len(filled) != self.control_dim:
                raise ConfigError(f"tracker: {key} needs {self.control_dim} numbers, found {len(filled)}")
            self.register_buffer(key, torch.tensor(filled, dtype=torch.float64))


def as_data(network: Network) -> dict[str, Any]:
    """A network's layers without their weights, as plain data."""
    return {"inputs": network.inputs, "layers": [layer.as_data() for layer in network.layers]}


def _restored(data: Any) -> Network:
    """A network with all weights zero, from data that anybody may have written."""
    known = data if isinstance(data, Mapping) else {}
    inputs, layers = known.get("inputs"), known.get("layers")
    if not isinstance(inputs, int) or isinstance(inputs, bool) or inputs < 1 or not isinstance(layers, list):
        raise ConfigError("network: it must have inputs, a whole number, and a list of layers")
    return Network(inputs, [Layer.of(item, f"network: layer {i}") for i, item in enumerate(layers, start=1)])
