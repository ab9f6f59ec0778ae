"""The tracking policy: one small multi-layer perceptron for all references (paper, section V-A)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Count, Decay, Widths
from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.controller import (
    Controller,
    Precision,
    check_precision,
    lookahead_errors,
    rounded_range,
    scaled_in_float32,
)


class Tracker(Controller):
    """``u = pi(e)``: lookahead errors ``e (..., N, n)`` to controls ``(..., m)``, leaky-ReLU MLP.

    The errors are flattened and multiplied by fixed per-state ``error_scale`` (a diagonal part of the first
    linear layer, so it costs nothing to verify); the output is multiplied by ``control_scale`` and offset by
    ``control_offset`` (hover thrust for flying robots). With unit scales and no offset it is the paper's plain MLP.

    The paper penalises control limits in training only. With ``saturate`` the network's output is cut off at +-1, so
    that every control lies within ``control_offset +- control_scale``, whatever the error: what is proved then needs
    no actuator that does more.

    With ``precision`` float32 the errors are rounded to float32, and all that follows is float32 arithmetic on weights
    and scales that are rounded to float32 as well: what ``export --float32`` writes. Proofs then hold for that.
    """

    error_scale: Tensor
    control_scale: Tensor
    control_offset: Tensor

    def __init__(
        self,
        *,
        state_dim: Count,
        control_dim: Count,
        lookahead: Count,
        hidden: Widths,
        negative_slope: Decay = 0.1,
        error_scale: list[float] | None = None,
        control_scale: list[float] | None = None,
        control_offset: list[float] | None = None,
        saturate: bool = False,
        precision: Precision = "real",
    ) -> None:
        super().__init__()
        if lookahead < 1 or not hidden or min(hidden) < 1:
            raise ConfigError(f"tracker: lookahead and hidden widths must be positive, found {lookahead} and {hidden}")
        if not 0 <= negative_slope < 1:
            raise ConfigError(f"tracker: negative_slope must lie in [0, 1), found {negative_slope}")
        if not isinstance(saturate, bool):
            raise ConfigError(f"tracker: saturate must be true or false, found {saturate!r}")
        check_precision(precision)
        self.saturate, self.precision = saturate, precision
        self.state_dim, self.control_dim, self.lookahead = state_dim, control_dim, lookahead
        self.hidden, self.negative_slope = list(hidden), float(negative_slope)
        for key, values, size, default in (
            ("error_scale", error_scale, state_dim, 1.0),
            ("control_scale", control_scale, control_dim, 1.0),
            ("control_offset", control_offset, control_dim, 0.0),
        ):
            filled = [default] * size if values is None else [float(v) for v in values]
            if len(filled) != size:
                raise ConfigError(f"tracker: {key} needs {size} numbers, found {len(filled)}")
            self.register_buffer(key, torch.tensor(filled, dtype=torch.float64))
        widths = [lookahead * state_dim, *hidden, control_dim]
        self.layers = nn.ModuleList(
            nn.Linear(a, b, dtype=torch.float64) for a, b in zip(widths[:-1], widths[1:], strict=True)
        )

    def features(self, window: Tensor, x: Tensor) -> Tensor:
        """What the network is given, ``(..., N, n)``: the lookahead errors.

        A class of one's own may give others of that shape, in torch operations; see ``docs/adding.md``.
        """
        return lookahead_errors(window, x)

    def control(self, window: Tensor, x: Tensor) -> Tensor:
        """Controls ``(..., m)``; see :class:`~sagemp_cli.loop.controller.Controller`."""
        return self(self.features(window, x))

    def forward(self, errors: Tensor) -> Tensor:
        """Controls ``(..., m)`` from lookahead errors (or other features) ``(..., N, n)``."""
        if self.precision == "float32":
            return self._in_float32(errors)
        h = self.layers[0]((errors * self.error_scale).flatten(-2))
        for layer in self.layers[1:]:
            h = layer(nn.functional.leaky_relu(h, self.negative_slope))
        if self.saturate:
            h = h.clamp(-1.0, 1.0)
        return h * self.control_scale + self.control_offset

    def _in_float32(self, errors: Tensor) -> Tensor:
        """The same operations but for those that change nothing, on numbers that are rounded to float32."""
        h = errors.float()
        if not bool((self.error_scale == 1).all()):
            h = h * self.error_scale.float()
        h = h.flatten(-2)
        for i, layer in enumerate(self.layers):
            assert isinstance(layer, nn.Linear)
            if i:
                h = nn.functional.leaky_relu(h, self.negative_slope)
            h = nn.functional.linear(h, layer.weight.float(), layer.bias.float())
        if self.saturate:
            h = h.clamp(-1.0, 1.0)
        return scaled_in_float32(h, self.control_scale, self.control_offset)

    def control_range(self) -> tuple[Tensor, Tensor]:
        """What no control leaves, ``(m,)`` each, rounded outwards; infinite unless it saturates."""
        if self.saturate and self.precision == "float32":
            return rounded_range(self.control_scale, self.control_offset, 1.0)
        reach = self.control_scale.abs() if self.saturate else torch.full_like(self.control_scale, torch.inf)
        return _outwards(self.control_offset, -reach), _outwards(self.control_offset, reach)


def _outwards(a: Tensor, b: Tensor) -> Tensor:
    """``a + b``, rounded away from a where it is not exact (two-sum, Knuth)."""
    total = a + b
    part = total - a
    exact = (part == b) & (total - part == a)
    return torch.where(exact | torch.isinf(total), total, torch.nextafter(total, torch.inf * b.sign()))
