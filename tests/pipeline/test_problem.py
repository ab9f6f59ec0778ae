import copy

import pytest
import torch

from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ConfigError
from sagemp_cli.pipeline.problem import problem_of


@pytest.fixture(scope="module")
def config():
    return compose(["effort=toy"])


def changed(config, **sections):
    config = copy.deepcopy(config)
    for key, value in sections.items():
        config[key] = {**config[key], **value} if isinstance(value, dict) else value
    return config


def test_the_problem_is_what_the_config_says(config):
    problem = problem_of(config)
    assert problem.horizon == 25
    assert problem.dynamics.dt == 0.1
    x, y, *rest = config["start"]["center"]
    corner = torch.tensor([x + 0.1, y - 0.1, *rest], dtype=torch.float64)
    assert bool(problem.start.contains(corner))
    assert problem.start.width.tolist() == pytest.approx([0.2, 0.2, 0.0, 0.0])
    assert problem.disturbance.upper.tolist() == pytest.approx([0.05, 0.05, 0.0, 0.025])
    assert problem.scene.constraint_names == ("workspace", "disc")


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"start": {"radius": [0.0] * 4}}, r"start.radius must be positive in at least one of px, py, theta, v; found"),
        ({"start": {"radius": [0.1, -0.1, 0, 0]}}, "start.radius must not be negative, found -0.1 for py"),
        ({"start": {"radius": [0.1, 0.1]}}, "start.radius needs 4 numbers, found 2"),
        ({"start": {"radius": 0.1}}, "start.radius must be a list of 4 numbers, found 0.1"),
        ({"start": {"center": [0.0, float("nan"), 0, 1]}}, "start.center must hold finite numbers"),
        ({"start": {"center": [0.0, float("inf"), 0, 1]}}, "start.center must hold finite numbers"),
        ({"start": {"center": ["a", 0, 0, 1]}}, "start.center must be a list of 4 numbers"),
        ({"start": {"center": None}}, "start.center must be a list of 4 numbers, found None"),
        ({"disturbance": {"radius": [0.1] * 3}}, "disturbance.radius needs 4 numbers, found 3"),
        ({"disturbance": {"radius": [0, 0, 0, -1e-9]}}, "disturbance.radius must not be negative, found -1e-09 for v"),
        ({"horizon": 0}, "horizon must be a positive whole number of steps, found 0"),
        ({"horizon": 2.5}, "horizon must be a positive whole number of steps, found 2.5"),
        ({"horizon": True}, "horizon must be a positive whole number of steps, found True"),
    ],
)
def test_a_problem_that_is_none_is_refused_in_one_line_that_names_the_key(config, sections, message):
    with pytest.raises(ConfigError, match=message) as caught:
        problem_of(changed(config, **sections))
    assert "\n" not in str(caught.value)
