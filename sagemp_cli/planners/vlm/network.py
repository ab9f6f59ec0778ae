"""What the local stand-in sees: a picture and a few words of an instruction to maps of where not to go and where to."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.vlm.words import WORDS


@dataclass(frozen=True)
class ReaderOptions:
    """Size of a :class:`SceneReader`, see there."""

    pixels: int = 48
    channels: int = 16

    def __post_init__(self) -> None:
        pixels, channels = self.pixels, self.channels
        if pixels < 16 or pixels % 8 or channels < 4 or channels % 4:
            raise ConfigError(
                "planner.network: pixels must be a multiple of 8 from 16 up and channels a multiple of 4, "
                f"found {pixels} and {channels}"
            )


class SceneReader(nn.Module):
    """A picture and an instruction to two maps: where the robot must not be, and what it is told to pass over.

    A stand-in for a vision-language model, a hundred thousand weights small. A U-shaped convolutional network looks
    at the picture; the words of the instruction (which of a fixed list occur in it) scale and shift its features, so
    the same burger is an obstacle under one instruction and a place to go under another. The maps have half
    the picture's resolution.

    Args:
        pixels: side of the pictures, a multiple of 8.
        channels: of the finest features.
    """

    places: Tensor

    def __init__(self, *, pixels: int = 48, channels: int = 16) -> None:
        super().__init__()
        ReaderOptions(pixels, channels)  # complains about a wrong one
        self.pixels = pixels
        fine, middle, deep = channels, 2 * channels, 3 * channels
        self.told = nn.Sequential(nn.Linear(len(WORDS), 48), nn.SiLU(), nn.Linear(48, 48), nn.SiLU())
        self.first, self.first_more = _Layer(5, fine, stride=2), _Layer(fine, fine)
        self.second, self.second_more = _Layer(fine, middle, stride=2), _Layer(middle, middle)
        self.third, self.third_more = _Layer(middle, deep, stride=2), _Layer(deep, deep)
        self.back, self.back_more = _Layer(deep + middle, middle), _Layer(middle + fine, fine + 8)
        self.names = nn.Conv2d(fine + 8, len(WORDS), 1)
        self.judge = _Layer(fine + 8 + len(WORDS), fine, reach=0)
        self.maps = nn.Conv2d(fine, 2, 1)
        self.register_buffer("places", cell_middles(pixels).permute(2, 0, 1).contiguous(), persistent=False)

    @torch.no_grad()
    def reset(self, generator: torch.Generator) -> None:
        """Draw new weights: uniform within ``sqrt(3 / inputs)`` and biases 0, so that features keep their size."""
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear):
                bound = (3.0 / layer.weight[0].numel()) ** 0.5
                layer.weight.uniform_(-bound, bound, generator=generator)
                assert layer.bias is not None
                layer.bias.zero_()
            elif isinstance(layer, nn.GroupNorm):
                layer.reset_parameters()
        for layer in (self.maps, self.names):  # most of a scene is free floor
            assert layer.bias is not None
            layer.bias.fill_(-2.0)

    def forward(self, images: Tensor, words: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of two maps ``(B, 2, h, h)``: must not be there, told to pass over; and of each word whether it names
        what is there, ``(B, words, h, h)``. Side ``h`` is ``pixels / 2``.

        Args:
            images: ``(B, 3, pixels, pixels)``, uint8, without dots.
            words: :func:`~sagemp_cli.planners.vlm.words.bag_of_words` of the instructions, ``(B, words)``.
        """
        told = self.told(words)
        dark = 2.0 * (1.0 - images.float() / 255.0)  # pictures are nearly white: darkness is the news
        a = self.first_more(self.first(torch.cat([dark, self.places.expand(len(images), -1, -1, -1)], 1), told), told)
        b = self.second_more(self.second(a, told), told)
        c = self.third_more(self.third(b, told), told)
        up = self.back(torch.cat([_doubled(c), b], dim=1), told)
        h = self.back_more(torch.cat([_doubled(up), a], dim=1), told)
        # Which words name what is here, of those that were said: what to do with it follows from that.
        names = self.names(h)
        said = torch.sigmoid(names) * words[..., None, None]
        return self.maps(self.judge(torch.cat([h, said], dim=1), told)), names


class _Layer(nn.Module):
    """A convolution whose outcome the instruction scales and shifts per channel."""

    def __init__(self, inputs: int, outputs: int, *, stride: int = 1, reach: int = 1) -> None:
        super().__init__()
        self.look = nn.Conv2d(inputs, outputs, 2 * reach + 1, stride=stride, padding=reach)
        self.norm = nn.GroupNorm(4, outputs)
        self.modulate = nn.Linear(48, 2 * outputs)

    def forward(self, h: Tensor, told: Tensor) -> Tensor:
        scale, shift = self.modulate(told)[..., None, None].chunk(2, dim=1)
        return nn.functional.silu(self.norm(self.look(h)) * (1 + scale) + shift)


def _doubled(h: Tensor) -> Tensor:
    return nn.functional.interpolate(h, scale_factor=2, mode="nearest")


def cell_middles(side: int) -> Tensor:
    """Middles of a square picture's cells ``(side, side, 2)``: x grows with the column, y falls with the row."""
    middles = (torch.arange(side) + 0.5) * 2 / side - 1
    y, x = torch.meshgrid(-middles, middles, indexing="ij")
    return torch.stack([x, y], dim=-1)
