"""A small certificate in continuous time: a vehicle that steers back to a line, past a disc, into a goal."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.pipeline.loop_record import continuous_loop_record
from sagemp_cli.pipeline.tubes import flow_record, relaxations_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import sampled
from sagemp_cli.sets import Box
from sagemp_cli.storage import Certificate, Header, Tubes, write_artifact


class Vehicle:
    """Unit speed, heading steered by a saturating network of two neurons."""

    state_dim, period = 3, 0.2

    def __init__(self, horizon: int, speed: float = 1.0, lag: Box | None = None) -> None:
        self.horizon, self.speed, self.lag = horizon, speed, lag

    def numbers(self):
        return torch.zeros(self.horizon, 0, dtype=torch.float64)

    def control_given(self, numbers, x):
        y, heading = x[..., 1:2], x[..., 2:3]
        return torch.tanh(torch.relu(-2 * y - heading + 1) - torch.relu(2 * y + heading + 1))

    def rate(self, x, u):
        heading = x[..., 2:3]
        return torch.cat([self.speed * torch.cos(heading), torch.sin(heading), 1.5 * u - 0.1 * heading], -1)


def config_of(horizon: int) -> dict[str, Any]:
    return {
        "name": "vehicle",
        "horizon": horizon,
        "start": {"lower": [0.0, 0.1, -0.1], "upper": [0.1, 0.2, 0.1]},
        "disturbance": {"lower": [-0.02, -0.1, -0.2], "upper": [0.02, 0.1, 0.1]},
        "scene": {
            "workspace": {"lower": [-1.0, -1.0], "upper": [3.0, 1.0]},
            "obstacles": [
                {"kind": "ball", "name": "disc", "center": [0.4, -0.6], "radius": 0.4},
                {"kind": "block", "name": "wall", "lower": [0.0, 0.7], "upper": [0.5, 0.9]},
            ],
            "goal": {"lower": [0.2, -1.0, -2.0], "upper": [1.6, 1.0, float("inf")]},
        },
    }


@dataclasses.dataclass(frozen=True)
class FlowCase:
    """A loop, how it is divided, and its certificate."""

    loop: Vehicle
    config: dict[str, Any]
    cells: Box
    certificate: Certificate

    @property
    def disturbance(self) -> Box:
        return _box(self.config["disturbance"])

    def write(self, path: Path, **changes: Any) -> Path:
        """The certificate as a file, with other fields of its tubes."""
        made = dataclasses.replace(
            self.certificate, tubes=dataclasses.replace(self.certificate.tubes, **changes)
        )  # fmt: skip
        header = Header(stage="prove", experiment="vehicle", config=self.config)
        return write_artifact(path, made, header, overwrite=True)


def flow_case(
    path: Path, *, horizon: int = 4, substeps: int = 2, order: int = 2, lag: Box | None = None, checked: bool = True
) -> FlowCase:  # fmt: skip
    """Two cells of a few periods; its figures are what the checker finds, at ``path``, or 0 if it is not asked."""
    loop, config = Vehicle(horizon, lag=lag), config_of(horizon)
    start, w = _box(config["start"]), _box(config["disturbance"])
    middle = start.center[1:2]
    cells = Box(
        torch.stack([start.lower, torch.cat([start.lower[:1], middle, start.lower[2:]])]),
        torch.stack([torch.cat([start.upper[:1], middle, start.upper[2:]]), start.upper]),
    )
    known = sampled(loop, cells)
    reach = reach_continuously(Affine(), known, cells, w, substeps=substeps, order=order)
    names = "workspace", "disc", "wall"
    tubes = Tubes(
        references=None,
        start_lower=start.lower[None].numpy(),
        start_upper=start.upper[None].numpy(),
        disturbance_lower=w.lower.numpy(),
        disturbance_upper=w.upper.numpy(),
        cell_reference=np.zeros(2, np.int64),
        cell_lower=cells.lower.numpy(),
        cell_upper=cells.upper.numpy(),
        tube_lower=reach.tube.lower.numpy(),
        tube_upper=reach.tube.upper.numpy(),
        control_lower=reach.control_lower.amin(0)[None].numpy(),
        control_upper=reach.control_upper.amax(0)[None].numpy(),
        verdict=("SAFE",),
        step=np.array([-1]),
        fraction=np.zeros(1),
        constraint=("",),
        constraint_names=names,
        clearance=np.zeros((1, 3)),
        goal_margin=np.zeros((1, 3)),
        seconds=np.zeros(1),
        propagator="affine",
        rigorous=True,
        between="continuous",
        parts=8,
        relaxations=relaxations_record(reach.recording),
        flow=flow_record([reach.flow]),
    )
    certificate = Certificate(
        tubes=tubes,
        loop=continuous_loop_record(
            known, position=[0, 1], state_names=("east", "north", "heading"), state_units=("m", "m", "rad")
        ),
        counterexamples=(), falsifier_rollouts=0, verdict="VERIFIED",
    )  # fmt: skip
    case = FlowCase(loop, config, cells, certificate)
    if not checked:
        return case
    (finding,) = check(case.write(path)).findings
    figures = {
        "clearance": np.nextafter([[finding.clearance[name] for name in names]], -np.inf),
        "goal_margin": np.nextafter([[*finding.goal_margin.values()]], -np.inf),
    }
    case = dataclasses.replace(
        case, certificate=dataclasses.replace(certificate, tubes=dataclasses.replace(tubes, **figures))
    )
    case.write(path)
    return case


def _box(section: dict[str, Any]) -> Box:
    return Box(*(torch.tensor(section[side], dtype=torch.float64) for side in ("lower", "upper")))
