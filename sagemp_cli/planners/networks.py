"""Networks that planners share."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError


class TimeMLP(nn.Module):
    """``phi(x, t)``: vectors ``(..., inputs)`` and times in [0, 1] to vectors ``(..., outputs)``; SiLU layers.

    Time enters as ``t, sin(pi j t), cos(pi j t)`` for ``j = 1..frequencies``: half a period over the whole time
    at the lowest, so that the features of t = 0 and t = 1 differ. The last layer starts at a tenth of the usual size:
    an untrained field then moves little, and what is integrated from it stays finite.
    """

    angles: Tensor

    def __init__(
        self, inputs: int, outputs: int, *, hidden: list[int], frequencies: int, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__()
        if not hidden or min(hidden) < 1 or frequencies < 0:
            raise ConfigError(
                f"network: hidden widths must be positive and frequencies not negative, "
                f"found {hidden} and {frequencies}"
            )
        angles = math.pi * torch.arange(1, frequencies + 1, dtype=dtype)
        self.register_buffer("angles", angles, persistent=False)
        widths = [*hidden, outputs]
        self.time = nn.Linear(1 + 2 * frequencies, hidden[0], dtype=dtype)
        self.first = nn.Linear(inputs, hidden[0], bias=False, dtype=dtype)
        self.rest = nn.ModuleList(nn.Linear(a, b, dtype=dtype) for a, b in zip(widths[:-1], widths[1:], strict=True))
        self.reset(torch.default_generator)

    @torch.no_grad()
    def reset(self, generator: torch.Generator) -> None:
        """Draw new weights: uniform within ``1 / sqrt(inputs)`` of a layer, the last layer a tenth of that."""
        inputs = self.time.in_features + self.first.in_features
        rest = [layer for layer in self.rest if isinstance(layer, nn.Linear)]
        for layer in (self.time, self.first, *rest):
            shared = layer is self.time or layer is self.first
            bound = (inputs if shared else layer.in_features) ** -0.5
            for parameter in layer.parameters():
                parameter.uniform_(-bound, bound, generator=generator)
        rest[-1].weight.mul_(0.1)
        rest[-1].bias.zero_()

    def embed(self, t: Tensor) -> Tensor:
        """The time's part of the first layer, ``(...)`` to ``(..., h)``.

        An integration knows its times beforehand, so it can compute this for all of them at once.
        """
        phase = t[..., None] * self.angles
        return self.time(torch.cat([t[..., None], torch.sin(phase), torch.cos(phase)], dim=-1))

    def at(self, x: Tensor, embedded: Tensor) -> Tensor:
        """The output for vectors ``(..., inputs)`` and embedded times ``(..., h)``."""
        h = self.first(x) + embedded
        for layer in self.rest:
            h = layer(nn.functional.silu(h))
        return h

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """The output ``(..., outputs)``; times ``(...)`` broadcast against the vectors' batch."""
        return self.at(x, self.embed(t))
