"""The network that flow matching and diffusion share: a small convolutional U-Net along time."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError

LEVELS = 3
"""Resolutions of the U-Net; each has half the rows and twice the channels of the one above."""

_STRIDE = 2 ** (LEVELS - 1)


class TemporalNetwork(nn.Module):
    """Sequences ``(B, T, inputs)`` of any length T to sequences ``(B, T, outputs)``, given a time and a vector each.

    Residual blocks of two convolutions along T (FiLM: the condition scales and shifts the channels between them) at
    three resolutions, with a skip connection at each. T is padded to a multiple of four by repeating the last row
    and cropped again. The generative time enters as ``t, sin(pi j t), cos(pi j t)``, ``j = 1..frequencies``; each
    row also gets its place ``k / (T - 1)``, since a trajectory is not the same at all times. At the default width
    there are about a million parameters. The last layer starts at a tenth of the usual size.

    Args:
        inputs: channels of the sequence.
        outputs: channels of the answer.
        condition: length of the vector.
        width: channels at the full resolution; twice and four times as many below.
        kernel: rows that a convolution sees, odd.
        frequencies: features of the generative time.
    """

    angles: Tensor

    def __init__(
        self, inputs: int, outputs: int, *, condition: int, width: int = 64, kernel: int = 3, frequencies: int = 8
    ) -> None:
        super().__init__()
        if width < 1 or kernel < 1 or kernel % 2 == 0 or frequencies < 1:
            raise ConfigError(
                "planner: width and frequencies must be positive and kernel odd, "
                f"found {width}, {frequencies} and {kernel}"
            )
        angles = math.pi * torch.arange(1, frequencies + 1, dtype=torch.float32)
        self.register_buffer("angles", angles, persistent=False)
        c, e = width, 2 * width
        self.embedding = nn.Sequential(nn.Linear(1 + 2 * frequencies + condition, e), nn.SiLU(), nn.Linear(e, e))
        self.enter = nn.Linear(inputs + 1, c)
        self.down = nn.ModuleList(_Block(c * 2**i, c * 2**i, e, kernel) for i in range(LEVELS - 1))
        self.merge = nn.ModuleList(nn.Linear(2 * c * 2**i, c * 2 ** (i + 1)) for i in range(LEVELS - 1))
        self.middle = _Block(c * _STRIDE, c * _STRIDE, e, kernel)
        self.split = nn.ModuleList(nn.Linear(c * 2 ** (i + 1), 2 * c * 2**i) for i in range(LEVELS - 1))
        self.up = nn.ModuleList(_Block(2 * c * 2**i, c * 2**i, e, kernel) for i in range(LEVELS - 1))
        self.leave = nn.Sequential(nn.LayerNorm(c), nn.SiLU(), nn.Linear(c, outputs))
        self.reset(torch.default_generator)

    @torch.no_grad()
    def reset(self, generator: torch.Generator) -> None:
        """Draw new weights: uniform within ``1 / sqrt(inputs)`` of a layer, the last layer a tenth of that."""
        for layer in self.modules():
            if isinstance(layer, nn.Linear | nn.Conv2d):
                bound = layer.weight[0].numel() ** -0.5
                layer.weight.uniform_(-bound, bound, generator=generator)
                assert layer.bias is not None
                layer.bias.zero_()
            elif isinstance(layer, nn.LayerNorm):
                layer.weight.fill_(1.0)
                layer.bias.zero_()
        last = self.leave[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(0.1)

    def forward(self, x: Tensor, t: Tensor, condition: Tensor) -> Tensor:
        """The answer for sequences ``(B, T, inputs)``, generative times ``(B,)`` in [0, 1] and vectors ``(B, c)``."""
        rows = x.shape[1]
        place = torch.linspace(0, 1, rows, dtype=x.dtype)[:, None].expand(len(x), rows, 1)
        x = torch.cat([x, place], dim=-1)
        missing = -rows % _STRIDE
        if missing:
            x = torch.cat([x, x[:, -1:].expand(-1, missing, -1)], dim=1)
        phase = t[:, None] * self.angles
        e = self.embedding(torch.cat([t[:, None], torch.sin(phase), torch.cos(phase), condition], dim=-1))
        h, kept = self.enter(x), []
        for block, merge in zip(self.down, self.merge, strict=True):
            h = block(h, e)
            kept.append(h)
            h = merge(h.reshape(len(h), h.shape[1] // 2, -1))
        h = self.middle(h, e)
        for block, split in zip(reversed(self.up), reversed(self.split), strict=True):
            h = split(h).reshape(len(h), 2 * h.shape[1], -1)
            h = block(torch.cat([h, kept.pop()], dim=-1), e)
        return self.leave(h)[:, :rows]


class _Block(nn.Module):
    """``x + conv(silu(film(norm(conv(silu(norm(x)))))))`` on sequences ``(B, T, c)``."""

    def __init__(self, inputs: int, outputs: int, embedding: int, kernel: int) -> None:
        super().__init__()
        self.first, self.second = nn.LayerNorm(inputs), nn.LayerNorm(outputs)
        # Two-dimensional with one row: its channels-last layout is that of (B, T, c), the fastest there is on a CPU.
        self.one = nn.Conv2d(inputs, outputs, (1, kernel), padding=(0, kernel // 2))
        self.two = nn.Conv2d(outputs, outputs, (1, kernel), padding=(0, kernel // 2))
        self.film = nn.Linear(embedding, 2 * outputs)
        self.past = nn.Identity() if inputs == outputs else nn.Linear(inputs, outputs)

    def forward(self, x: Tensor, e: Tensor) -> Tensor:
        scale, shift = self.film(e)[:, None].chunk(2, dim=-1)
        h = _along_time(self.one, nn.functional.silu(self.first(x)))
        h = self.second(h) * (1 + scale) + shift
        return self.past(x) + _along_time(self.two, nn.functional.silu(h))


def _along_time(convolution: nn.Conv2d, x: Tensor) -> Tensor:
    return convolution(x.transpose(1, 2).unsqueeze(2)).squeeze(2).transpose(1, 2)
