"""The closed loops that the benchmarks measure: robot, references, tracker, sets; built once and kept in a cache.

References come from trajectory optimisation and trackers are trained here, in minutes. The cache is a folder of NPZ
files: plain arrays and the hash of the recipe that made them; a recipe that changes makes its case be built again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.config.binding import build
from sagemp_cli.config.composition import compose
from sagemp_cli.dynamics import Dynamics
from sagemp_cli.experts import Expert, Weights, plan_demonstrations, solve_problem
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress, Silent, Task
from sagemp_cli.scenes.scene import Scene, scene_from_mapping
from sagemp_cli.sets import Box
from sagemp_cli.trackers import Tracker
from sagemp_cli.trackers.losses import LossWeights
from sagemp_cli.trackers.training import TrackerTrainingOptions, train_tracker
from sagemp_cli.trackers.tube_loss import TubeLoss

SEED = 0


@dataclass(frozen=True)
class Recipe:
    """How a case is made.

    Attributes:
        dynamics, tracker, scene: options of the config groups, and a file of ``data/scenes``.
        start_center, start_radius: X_I.
        disturbance_radius: W.
        references_from: radius of the box that the references start in.
        references: how many.
        expert: cost of the trajectory optimisation, and the margin to obstacles.
        training: options of :func:`sagemp_cli.trackers.training.train_tracker`; under ``warm_up``, trainings that come
            first, each with the options that differ.
        tube: options of :class:`sagemp_cli.trackers.tube_loss.TubeLoss`, None for the plain loss.
        horizon: K.
    """

    dynamics: str
    tracker: str
    scene: str
    start_center: tuple[float, ...]
    start_radius: tuple[float, ...]
    disturbance_radius: tuple[float, ...]
    references_from: tuple[float, ...]
    expert: Mapping[str, Any]
    training: Mapping[str, Any]
    tube: Mapping[str, Any] | None
    references: int = 8
    horizon: int = 100

    @property
    def digest(self) -> str:
        """A hash of everything that the result depends on, except the package's code."""
        config = compose([f"dynamics={self.dynamics}", f"tracker={self.tracker}", f"scene={self.scene}"])
        content = [dataclasses.asdict(self), *(config[key] for key in ("dynamics", "tracker", "scene"))]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


RECIPES = {
    "unicycle": Recipe(
        dynamics="unicycle",
        tracker="mlp",
        scene="slalom",
        start_center=(0.0, 0.0, 0.0, 1.2),
        start_radius=(0.15, 0.15, 0.0, 0.0),
        disturbance_radius=(0.05, 0.05, 0.0, 0.025),
        references_from=(0.5, 0.5, 0.0, 0.0),
        expert={
            "weights": {"effort": [1.0, 1.0], "smoothness": [0.1, 0.1], "goal": [100.0] * 4},
            "margin": 0.65,
            "workspace_margin": 0.3,
        },
        training={
            "steps": 500,
            "batch": 48,
            "rollout_steps": 40,
            "weights": {"track": 1.0, "state": 0.1, "control": 3.0},
            "tube_steps": 60,
        },
        tube={"references": 4, "counts": [1, 1], "steps": 60, "symbols": 40},
    ),
    "planar_quadrotor": Recipe(
        dynamics="planar_quadrotor",
        tracker="planar_quadrotor",
        scene="disc",
        start_center=(0.6, 2.4, 0.0, 0.0, 0.0, 0.0),
        start_radius=(0.15, 0.15, 0.0, 0.0, 0.0, 0.0),
        disturbance_radius=(0.0, 0.0, 0.0, 0.25, 0.25, 0.25),
        references_from=(0.3, 0.3, 0.0, 0.0, 0.0, 0.0),
        expert={
            "weights": {
                "effort": [0.05, 50.0],
                "smoothness": [0.005, 5.0],
                "goal": [100.0] * 6,
                "rest": [4.905, 0.0],
            },
            "margin": 0.4,
            "workspace_margin": 0.3,
        },
        training={
            "steps": 600,
            "batch": 48,
            "rollout_steps": 50,
            "weights": {"track": 10.0, "state": 0.1, "control": 3.0},
            "tube_steps": 150,
        },
        tube={
            "weight": 0.2,
            "references": 3,
            "counts": [1, 1],
            "steps": 100,
            "symbols": 40,
            "scale": [0.5, 0.5, 0.5, 1.0, 1.0, 2.0],
        },
    ),
    "quadrotor": Recipe(
        dynamics="quadrotor",
        tracker="quadrotor",
        scene="sphere",
        start_center=(0.7, 0.7, 1.2, *[0.0] * 9),
        start_radius=(0.1, 0.1, 0.1, *[0.0] * 9),
        disturbance_radius=(*[0.0] * 6, *[0.1] * 6),
        references_from=(0.2, 0.2, 0.2, *[0.0] * 9),
        expert={
            "weights": {
                "effort": [0.02, 0.1, 1.0, 0.5],
                "smoothness": [0.002, 0.01, 0.1, 0.05],
                "goal": [100.0] * 12,
                "rest": [9.81, 0.0, 0.0, 0.0],
            },
            "margin": 0.4,
            "workspace_margin": 0.3,
        },
        # Short rollouts first: those of an untrained tracker tumble, and their gradients overflow.
        training={
            "warm_up": [{"steps": 300, "rollout_steps": 12}, {"steps": 300, "rollout_steps": 25}],
            "steps": 400,
            "batch": 48,
            "rollout_steps": 50,
            "weights": {"track": 10.0, "state": 0.1, "control": 3.0},
        },
        tube=None,
    ),
}


@dataclass(frozen=True)
class Case:
    """A robot with its tracker, references, scene and sets.

    Attributes:
        references: ``(R, K+1, n)``, from different starts.
        start: X_I around the first reference's start, ``(n,)``.
        disturbance: W, ``(n,)``.
    """

    name: str
    dynamics: Dynamics
    tracker: Tracker
    scene: Scene
    references: Tensor
    start: Box
    disturbance: Box

    def loop(self, reference: int = 0) -> ClosedLoop:
        """The closed loop along one reference."""
        return ClosedLoop(self.dynamics, self.tracker, self.references[reference])

    def start_of(self, reference: int) -> Box:
        """X_I around the start of a reference."""
        shift = self.references[reference, 0] - self.references[0, 0]
        return Box.around(self.references[0, 0] + shift, self.start.radius)


class Lines(Silent):
    """Tells on standard error what long work has begun."""

    @contextmanager
    def task(self, description: str, total: int, done: int = 0) -> Iterator[Task]:
        """Say it once."""
        print(f"{description} ({total}) ...", file=sys.stderr, flush=True)
        with super().task(description, total, done) as task:
            yield task


def load(name: str, folder: Path, *, progress: Progress | None = None) -> Case:
    """A case from the cache, built first if it is not there or its recipe has changed."""
    recipe = RECIPES[name]
    path = folder / f"{name}.npz"
    dynamics, tracker, scene = _objects(recipe)
    arrays = _cached(path, recipe.digest)
    if arrays is None:
        references = _references(recipe, dynamics, scene, progress or Silent())
        start = Box.around(recipe.start_center, recipe.start_radius)
        disturbance = Box.around([0.0] * dynamics.state_dim, recipe.disturbance_radius)
        problem = Problem(dynamics, scene, start, disturbance, recipe.horizon)
        _train(recipe, tracker, problem, references, progress)
        arrays = {"references": references.numpy(), "digest": np.frombuffer(recipe.digest.encode(), dtype=np.uint8)}
        arrays |= {f"tracker/{k}": v.detach().numpy() for k, v in tracker.state_dict().items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **arrays)
    weights = {k.removeprefix("tracker/"): torch.from_numpy(v) for k, v in arrays.items() if k.startswith("tracker/")}
    tracker.load_state_dict(weights)
    tracker.requires_grad_(False)
    references = torch.from_numpy(arrays["references"])
    return Case(
        name,
        dynamics,
        tracker.eval(),
        scene,
        references,
        Box.around(references[0, 0], recipe.start_radius),
        Box.around([0.0] * dynamics.state_dim, recipe.disturbance_radius),
    )


def _objects(recipe: Recipe) -> tuple[Dynamics, Tracker, Scene]:
    config = compose([f"dynamics={recipe.dynamics}", f"tracker={recipe.tracker}", f"scene={recipe.scene}"])
    dynamics: Dynamics = build(config["dynamics"], "dynamics")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        sizes = {"state_dim": dynamics.state_dim, "control_dim": dynamics.control_dim}
        tracker: Tracker = build(config["tracker"], "tracker", **sizes)
    scene = scene_from_mapping(config["scene"], state_dim=dynamics.state_dim, position_dim=len(dynamics.position))
    return dynamics, tracker, scene


def _cached(path: Path, digest: str) -> dict[str, np.ndarray] | None:
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    return arrays if bytes(arrays["digest"]).decode() == digest else None


def _references(recipe: Recipe, dynamics: Dynamics, scene: Scene, progress: Progress) -> Tensor:
    """Trajectories of the expert: the first starts in the middle of X_I, the others around it."""
    options = dict(recipe.expert)
    expert = Expert(dynamics, scene, recipe.horizon, Weights(**options.pop("weights")), **options)
    around = Box.around(recipe.start_center, recipe.references_from)
    problems = plan_demonstrations(around, 2 * recipe.references, seed=SEED)
    problems[0] = dataclasses.replace(problems[0], start=np.array(recipe.start_center))
    found: list[np.ndarray] = []
    with progress.task(f"references of {recipe.dynamics}", recipe.references) as task:
        for problem in problems:
            trajectory = solve_problem(problem, expert).trajectory
            if trajectory is not None and len(found) < recipe.references:
                found.append(trajectory.states)
                task.advance()
    return torch.from_numpy(np.stack(found))


def _train(recipe: Recipe, tracker: Tracker, problem: Problem, references: Tensor, progress: Progress | None) -> None:
    options = {k: v for k, v in recipe.training.items() if k not in ("warm_up", "tube_steps", "weights")}
    options["weights"] = LossWeights(**recipe.training.get("weights", {}))
    last = {"tube": None if recipe.tube is None else TubeLoss(**recipe.tube)}
    last |= {k: v for k, v in recipe.training.items() if k == "tube_steps"}
    generator = torch.Generator().manual_seed(SEED)
    for changes in (*recipe.training.get("warm_up", ()), last):
        wanted = TrackerTrainingOptions(**(options | changes))
        train_tracker(tracker, problem, wanted, references=references, generator=generator, progress=progress)
