"""A robot model that is a neural network, 3 x 64, trained here in seconds: enough to measure time and tightness on."""

from __future__ import annotations

import torch

from sagemp_cli.config.composition import compose
from sagemp_cli.dynamics.learned import Learned
from sagemp_cli.identification import DynamicsTrainingOptions, EnclosureWeight, ModelErrors, learn_dynamics
from sagemp_cli.pipeline.problem import robot_of


def learned_unicycle(*, seed: int = 0, updates: int = 1500) -> tuple[Learned, ModelErrors]:
    """The robot of ``dynamics=unicycle_learned`` after a short training, and its errors."""
    config = compose(["dynamics=unicycle_learned"])
    options = dict(config["dynamics_training"]) | {"transitions": 200_000, "steps": updates}
    options["enclosure"] = EnclosureWeight(**options["enclosure"])
    robot = robot_of(config)
    assert isinstance(robot, Learned)
    generator = torch.Generator().manual_seed(seed)
    _, errors = learn_dynamics(robot, DynamicsTrainingOptions(**options), generator=generator)
    return robot, errors
