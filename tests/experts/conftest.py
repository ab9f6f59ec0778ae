"""A small unicycle problem, and a robot without any geometry of its own: a point mass."""

from __future__ import annotations

import math

import pytest
import torch

from sagemp_cli.dynamics import Dynamics, Unicycle
from sagemp_cli.experts import Expert, Weights
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box


class PointMass(Dynamics):
    """A double integrator in space; linear, so that optima can be computed independently."""

    state_names = ("px", "py", "pz", "vx", "vy", "vz")
    state_units = ("m",) * 3 + ("m/s",) * 3
    control_names = ("ax", "ay", "az")
    control_units = ("m/s^2",) * 3
    position = (0, 1, 2)

    def derivative(self, x, u):
        return torch.cat([x[..., 3:], u], dim=-1)


@pytest.fixture
def unicycle() -> Unicycle:
    return Unicycle(
        dt=0.2,
        control_lower=[-1.5, -2.0],
        control_upper=[1.5, 2.0],
        state_lower=[-3.0, -4.0, -1.5, 0.0],
        state_upper=[13.0, 4.0, 1.5, 3.0],
    )


@pytest.fixture
def slalom() -> Scene:
    """Two staggered discs, half the length of the demo's scene."""
    return Scene(
        Box(torch.tensor([-2.0, -3.0]), torch.tensor([7.0, 3.0])),
        (Ball((2.0, -0.3), 0.5, "first disc"), Ball((3.6, 0.4), 0.5, "second disc")),
        Box(torch.tensor([4.8, -0.2, -0.4, 0.5]), torch.tensor([5.2, 0.2, 0.4, 1.5])),
    )


@pytest.fixture
def expert(unicycle, slalom) -> Expert:
    weights = Weights(effort=[1.0, 1.0], smoothness=[0.1, 0.1], goal=[100.0] * 4)
    return Expert(unicycle, slalom, horizon=25, weights=weights, margin=0.3, workspace_margin=0.1)


@pytest.fixture
def starts() -> Box:
    return Box.around([0.0, 0.0, 0.0, 1.0], [0.5, 0.6, 0.2, 0.2])


@pytest.fixture
def point_mass() -> PointMass:
    return PointMass(
        dt=0.1,
        control_lower=[-4.0] * 3,
        control_upper=[4.0] * 3,
        state_lower=[-10.0] * 6,
        state_upper=[10.0] * 6,
    )


@pytest.fixture
def open_space() -> Scene:
    far = torch.full((3,), 10.0)
    goal = torch.tensor([3.0, 1.0, 2.0, 0.0, 0.0, 0.0])
    slack = torch.tensor([1.0, 1.0, 1.0, math.inf, math.inf, math.inf])
    return Scene(Box(-far, far), (), Box(goal - slack, goal + slack))
