"""A scene with one disc and smooth curves around it, as a stand-in for expert demonstrations."""

import pytest
import torch

from sagemp_cli.scenes.scene import Ball, Scene
from sagemp_cli.sets import Box

HORIZON, DT = 40, 0.1


@pytest.fixture(scope="session")
def scene():
    goal = Box.around([8.0, 0.0, 0.0, 2.0], [0.4, 0.4, 0.5, 0.5])
    return Scene(Box(torch.tensor([-2.0, -4.0]), torch.tensor([10.0, 4.0])), (Ball((4.0, 0.0), 1.0),), goal)


def curves(count, seed, *, sides=None):
    """States ``(count, K+1, 4)`` on curves that pass above the disc if they start above, else below.

    No curve starts near the x axis, so a smooth field can tell the sides apart; ``sides (count, 1)`` of 1 and -1 sets
    them free from the start. The path is
    ``y = y0 (1 - s)^2 + side 1.8 sin(pi s)^2``, ``x = x0 + (8 - x0) s``; heading and speed are its own.
    """
    generator = torch.Generator().manual_seed(seed)
    x0 = -0.5 + torch.rand(count, 1, dtype=torch.float64, generator=generator)
    y0 = 0.8 * torch.rand(count, 1, dtype=torch.float64, generator=generator) - 0.4
    y0 = y0 + 0.4 * torch.sign(y0)
    s = torch.linspace(0, 1, HORIZON + 1, dtype=torch.float64)
    side = torch.where(y0 >= 0, 1.0, -1.0) if sides is None else sides
    x = x0 + (8 - x0) * s
    y = y0 * (1 - s) ** 2 + 1.8 * side * torch.sin(torch.pi * s) ** 2
    slope = -2 * y0 * (1 - s) + 1.8 * side * torch.pi * torch.sin(2 * torch.pi * s)
    duration = HORIZON * DT
    heading, speed = torch.atan2(slope, (8 - x0).expand_as(slope)), torch.hypot(8 - x0, slope) / duration
    return torch.stack([x, y, heading, speed], dim=-1)


@pytest.fixture(scope="session")
def demonstrations():
    return curves(60, seed=0)


@pytest.fixture(scope="session")
def held_out():
    return curves(20, seed=1)


@pytest.fixture(scope="session")
def two_sided():
    """Curves of which half pass above and half below, wherever they start."""
    sides = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(60)[:, None]
    return curves(120, seed=2, sides=sides)
