"""Every robot model, built from its config."""

from __future__ import annotations

import pytest

from sagemp_cli.config.binding import build
from sagemp_cli.config.composition import compose, options_of
from sagemp_cli.dynamics import Dynamics

ROBOTS = [name for name in options_of("dynamics") if not name.endswith("_learned")]


def robot(name: str, **changes) -> Dynamics:
    return build(compose([f"dynamics={name}"])["dynamics"] | changes, "dynamics")


@pytest.fixture(params=ROBOTS)
def any_robot(request) -> Dynamics:
    return robot(request.param)


@pytest.fixture
def make_robot():
    """``make_robot(name, **changes)``: a robot of the config, with some options changed."""
    return robot
