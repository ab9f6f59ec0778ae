"""``sagemp gen-data``: expert demonstrations, resumable one by one."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from sagemp_cli.config.binding import Binding
from sagemp_cli.config.ranges import Count, Whole
from sagemp_cli.errors import ConfigError
from sagemp_cli.experts import (
    Demonstration,
    Expert,
    plan_demonstrations,
    solve_problems,
)
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.partial import PartialResults
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.demonstrations import draw_demonstrations
from sagemp_cli.report.figure import draw_beside
from sagemp_cli.scenes.sides import side_label
from sagemp_cli.storage import Demonstrations

_BESIDE = {"count": Count, "processes": Whole}
SECTIONS = (Binding("expert", Expert, given=("dynamics", "scene", "horizon"), beside=_BESIDE),)
_FIGURES = ("cost", "optimality", "control_violation", "state_violation", "clearance", "goal_error")


def run(context: StageContext) -> Path:
    """Solve the planned problems that are not finished yet, and write them all."""
    problem, options = problem_of(context.config), SECTIONS[0].options(context.config)
    count, processes = options.pop("count"), options.pop("processes")
    expert = Expert(problem.dynamics.analytical, problem.scene, problem.horizon, **options)
    problems = plan_demonstrations(problem.start, count, seed=int(context.config["seed"]))
    # A demonstration does not depend on how many there are or who solves it, so these may change between runs.
    partial = PartialResults.of(context, "gen-data", without=("expert.count",))
    done = partial.finished & set(range(count))
    with (
        context.progress.task("demonstrations", count, len(done)) as task,
        closing(solve_problems(problems, expert, processes=processes, done=done)) as solved,
    ):
        for demonstration in solved:
            partial.save(demonstration.problem.index, _arrays(demonstration))
            task.advance(note=demonstration.failure)
    found = [partial.load(index) for index in range(count)]
    path = context.write("gen-data", _record(found, len(problem.dynamics.position)))
    partial.remove()
    return path


def draw(context: StageContext) -> Path:
    """Draw the figure of what is there."""
    return draw_beside(context.output_path("gen-data"), draw_demonstrations, context.read("gen-data"))


def _arrays(demonstration: Demonstration) -> dict[str, np.ndarray]:
    """One finished problem as arrays; a failure has its reason only."""
    t = demonstration.trajectory
    if t is None:
        return {"failure": np.array(demonstration.failure)}
    return {
        "states": t.states,
        "controls": t.controls,
        "sides": np.array(t.sides, dtype=np.int64),
        "iterations": np.array(t.iterations),
        "seconds": np.array(demonstration.seconds),
        **{name: np.array(getattr(t, name)) for name in _FIGURES},
    }


def _record(found: Sequence[dict[str, np.ndarray]], dimension: int) -> Demonstrations:
    solved = [(index, item) for index, item in enumerate(found) if "failure" not in item]
    failed = [f"problem {index}: {item['failure']}" for index, item in enumerate(found) if "failure" in item]
    if not solved:
        raise ConfigError(f"expert: none of {len(found)} problems was solved; {failed[0]}")
    return Demonstrations(
        states=np.stack([item["states"] for _, item in solved]),
        controls=np.stack([item["controls"] for _, item in solved]),
        problem=np.array([index for index, _ in solved], dtype=np.int64),
        side=tuple(side_label(item["sides"].tolist(), dimension) for _, item in solved),
        iterations=np.array([item["iterations"] for _, item in solved], dtype=np.int64),
        seconds=np.array([item["seconds"] for _, item in solved]),
        failed=tuple(failed),
        **{name: np.array([item[name] for _, item in solved], dtype=np.float64) for name in _FIGURES},
    )
