"""What docs/adding.md shows works as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import torch

from sagemp_cli.config.binding import build, option_complaints, section_complaints
from sagemp_cli.planners.own import OwnPlanner
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

PAGE = (Path(__file__).parents[2] / "docs" / "adding.md").read_text()


def test_the_robot_and_the_planner_of_the_page_are_ones(folder):
    namespace = {"__name__": "documented"}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.S | re.M):
        exec(block, namespace)  # our own documentation
    limits = {"control_lower": [-1, -1], "control_upper": [1, 1], "state_lower": [-9] * 4, "state_upper": [9] * 4}
    robot = build({"name": "my_robot", "dt": 0.1} | limits, "dynamics")
    x = torch.tensor([0.0, 0.0, 0.0, 2.0], dtype=torch.float64)
    assert torch.equal(robot.derivative(x, torch.ones(2).double()), torch.tensor([2.0, 0.0, 1.0, 1.0]).double())

    wrong = section_complaints({"name": "straight", "overshot": 0.1}, "planner")
    assert wrong == ["planner.overshot: straight has no such option (did you mean 'overshoot'?)"]
    planner = build({"name": "straight", "overshoot": 0.5}, "planner", horizon=4)
    scene = Scene(Box.around([0.0, 0.0], [9.0, 9.0]), (), Box.around([4.0, 2.0, 0.0, 0.0], [1.0, 1.0, 9.0, 9.0]))
    own = OwnPlanner(planner, name="straight", state_names=robot.state_names, horizon=4)
    plans = own.sample(x, scene.goal, scene=scene, count=2, generator=torch.Generator())
    assert torch.equal(plans[:, -1, :2], torch.tensor([[6.0, 3.0]]).double().expand(2, 2))

    init = namespace["__init__"]
    assert option_complaints(init, {"lag": -1, "wheels": 0}, "dynamics", given=("self", "common")) == [
        "dynamics.lag must be a positive number, found -1",
        "dynamics.wheels must be a whole number of at least 1, found 0",
    ]
