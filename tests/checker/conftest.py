"""Small certificates to check, made by the real verification path from problems that need no training."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest
import torch

from sagemp_cli.config.binding import target_class
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.pipeline.loop_record import loop_record
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.flow import AskedDivision
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.sets import Between, Box
from sagemp_cli.storage import Certificate, Header, Tubes, write_artifact
from sagemp_cli.storage.content import HASH_ATTRIBUTE, content_hash
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verification import verify_references

LIMITS = {"unicycle": (4, 2), "planar_quadrotor": (6, 2), "quadrotor": (12, 4)}


def config_of(robot: str, **changes: Any) -> dict[str, Any]:
    """The config of a small problem: a straight flight or drive along x, past one obstacle, into a goal."""
    n, m = LIMITS[robot]
    flat = 3 if robot == "quadrotor" else 2
    center = [0.0] * n
    center[{"unicycle": 3, "planar_quadrotor": 3, "quadrotor": 6}[robot]] = 1.0
    far = [9.0] * flat
    return {
        "name": f"small_{robot}",
        "horizon": 8,
        "dynamics": {
            "name": robot,
            "dt": 0.1,
            "control_lower": [-9.0] * m,
            "control_upper": [9.0] * m,
            "state_lower": [-9.0] * n,
            "state_upper": [9.0] * n,
        },
        "scene": {
            "workspace": {"lower": [-v for v in far], "upper": far},
            "obstacles": [
                {"kind": "ball", "name": "disc", "center": [0.4, 1.0] + [0.0] * (flat - 2), "radius": 0.5},
                {"kind": "block", "name": "wall", "lower": [-1.0, -2.0] + [-1.0] * (flat - 2),
                 "upper": [2.0, -0.7] + [1.0] * (flat - 2)},
            ],
            "goal": {"lower": [0.3] + [-3.0] * (n - 1), "upper": [1.3] + [float("inf")] * (n - 1)},
        },
        "start": {"center": center, "radius": [0.05, 0.04] + [0.0] * (n - 2)},
        "disturbance": {"radius": [0.05, 0.0] + [0.02] * (n - 2)},
    } | changes  # fmt: skip


def problem_from(config: dict[str, Any]) -> Problem:
    """What the stages build from such a config."""
    section = {key: value for key, value in config["dynamics"].items() if key != "name"}
    dynamics = target_class(config["dynamics"], "dynamics")(**section)
    n = dynamics.state_dim
    return Problem(
        dynamics,
        scene_from_mapping(config["scene"], state_dim=n, position_dim=len(dynamics.position)),
        Box.around(config["start"]["center"], config["start"]["radius"]),
        Box.around([0.0] * n, config["disturbance"]["radius"]),
        config["horizon"],
        between=Between.CONTINUOUS if dynamics.continuous else Between.SEGMENTS,
    )


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem, a tracker, references, and how they are verified."""

    config: dict[str, Any]
    problem: Problem
    tracker: Tracker
    arguments: dict[str, Any]
    tubes: Tubes

    def write(self, path: Path, **record: Any) -> Path:
        """The certificate as a file."""
        values: dict[str, Any] = {
            "tubes": self.tubes,
            "loop": loop_record(self.problem, self.tracker),
            "counterexamples": (),
            "falsifier_rollouts": 0,
            "verdict": "VERIFIED" if set(self.tubes.verdict) == {"SAFE"} else "UNKNOWN",
        }
        header = Header(stage="verify", experiment=self.config["name"], config=self.config)
        return write_artifact(path, Certificate(**(values | record)), header, overwrite=True)


def make_case(
    robot: str = "unicycle",
    *,
    counts=(2, 1),
    propagator=None,
    hidden=(4, 4),
    side=0.0,
    disc=None,
    limit=None,
    precision="real",
    time="discrete",
    order=None,
    lag=None,
    **changes,
) -> Case:
    """References are straight; ``side`` shifts a second one sideways, 0 makes one only; ``disc`` moves the disc;
    ``limit`` is where the controls saturate; ``order`` is that of polynomials in continuous time,
    ``lag`` the delay and the jitter there.
    """
    config = config_of(robot, **changes)
    config["dynamics"] |= {"time": time, **(lag or {})}
    if disc is not None:
        config["scene"]["obstacles"][0]["center"] = disc
    problem = problem_from(config)
    n, m = problem.dynamics.state_dim, problem.dynamics.control_dim
    hover = {"planar_quadrotor": [0.5 * 9.81, 0.0], "quadrotor": [9.81, 0.0, 0.0, 0.0]}.get(robot, [0.0] * m)
    arguments = {"state_dim": n, "control_dim": m, "lookahead": 3, "hidden": list(hidden), "negative_slope": 0.1}
    arguments |= {"control_offset": hover, "control_scale": [0.5 if robot == "unicycle" else 0.05] * m}
    arguments["precision"] = precision
    if limit is not None:
        arguments |= {"saturate": True, "control_scale": [limit] * m, "error_scale": [60.0] * n}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        tracker = Tracker(**arguments)
    steps = torch.arange(config["horizon"] + 1, dtype=torch.float64)[:, None]
    velocity = torch.zeros(n, dtype=torch.float64)
    velocity[0] = config["dynamics"]["dt"]
    reference = problem.start.center + steps * velocity
    references = [reference] if not side else [reference, reference + torch.eye(n, dtype=torch.float64)[1] * side]
    verification = verify_references(
        CellProver(propagator or Affine(), problem, tracker, division=AskedDivision(order=order)),
        torch.stack(references),
        counts=list(counts),
    )
    return Case(config, problem, tracker, arguments, tubes_record(verification))


@pytest.fixture(scope="session")
def case() -> Case:
    """A unicycle that is certified: 8 steps, 2 cells, tracker 4-4."""
    return make_case()


@pytest.fixture(scope="session")
def certificate(case, tmp_path_factory) -> Path:
    """Its certificate; treat it as read-only."""
    return case.write(tmp_path_factory.mktemp("certificates") / "certificate.h5")


def mutant(source: Path, path: Path, change: Callable[[h5py.File], None], *, rehash: bool = True) -> Path:
    """A copy of a file with one change and, unless told otherwise, the hash of what it then says."""
    path.write_bytes(source.read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
        if rehash:
            file.attrs[HASH_ATTRIBUTE] = content_hash(file)
    return path


STEP = "data/loop/programs/000000"
"""The program of a certificate."""


def slots_of(file: h5py.File, kind: str, program: str = STEP) -> list[int]:
    """The slots of a kind."""
    return [i for i, k in enumerate(file[f"{program}/kinds"].asstr()[()]) if k == kind]


def constants_of(file: h5py.File, slot: int, program: str = STEP) -> slice:
    """Where the constants of a slot are in the program's numbers."""
    begin = file[f"{program}/number_begin"][()]
    return slice(int(begin[slot]), int(begin[slot + 1]))


@pytest.fixture
def mutate() -> Callable[..., Path]:
    """:func:`mutant`."""
    return mutant


@pytest.fixture
def make() -> Callable[..., Case]:
    """:func:`make_case`."""
    return make_case
