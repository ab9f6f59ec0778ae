"""Recorded trajectories as a planner."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.planners.base import starts_of
from sagemp_cli.planners.completion import complete
from sagemp_cli.planners.trajectory_file import RecordedTrajectory, read_trajectories
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

_UNITS = ((1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds"))
"""Units of time that loggers write, in a second's parts."""


class FromFile(nn.Module):
    """Plans that are trajectories of a file; :mod:`~sagemp_cli.planners.trajectory_file` says which files.

    Trajectories are resampled to the robot's steps, linearly in time (angles the short way round). One that ends
    before the horizon keeps its last row; one that lasts longer is refused, since cutting it would lose its end.
    States that the file does not have are filled in (:mod:`~sagemp_cli.planners.completion`). ``notes`` says all that
    was done.

    The trajectories are a buffer, so the planner is rebuilt from its weights without the file.

    Args:
        state_dim: number of states n.
        horizon: number of steps K.
        dt: seconds a step.
        state_names: names of the states.
        robot: with ``path``: says what follows from what.
        path: the file.
        position: without ``robot``: indices of the states that are the position.
        angles: without ``robot``: names of the states that are angles.
        count: instead of ``path``: how many trajectories there are, which ``load_state_dict`` brings then.
        notes: with ``count``: what was done when the file was read.
    """

    learns_from: ClassVar[str] = "nothing"

    trajectories: Tensor

    def __init__(
        self,
        *,
        state_dim: int,
        horizon: int,
        dt: float,
        state_names: list[str],
        robot: Dynamics | None = None,
        path: str | None = None,
        position: list[int] | None = None,
        angles: list[str] | None = None,
        count: int | None = None,
        notes: list[str] | None = None,
    ) -> None:
        super().__init__()
        if (path is None) == (count is None):
            raise ConfigError("planner.path must name a file of trajectories, e.g. planner.path=plans.csv")
        if path is not None and robot is None:
            raise ConfigError("planner: a file of trajectories is read for a robot, which must be given with its path")
        self.state_dim, self.horizon, self.dt = int(state_dim), int(horizon), float(dt)
        self.state_names = [str(name) for name in state_names]
        self.position = list(robot.position if robot is not None else position or ())
        self.angles = list(robot.angles if robot is not None else angles or ())
        self.source = None if path is None else Path(path)
        self.notes = [str(note) for note in notes or ()]
        if path is None or robot is None:
            trajectories = torch.zeros(int(count or 0), self.horizon + 1, self.state_dim, dtype=torch.float64)
        else:
            trajectories = torch.from_numpy(self._read(Path(path), robot))
        self.register_buffer("trajectories", trajectories)

    @property
    def arguments(self) -> dict[str, Any]:
        """Plain keyword arguments that rebuild this planner; the trajectories are in ``state_dict()``."""
        return {
            "state_dim": self.state_dim,
            "horizon": self.horizon,
            "dt": self.dt,
            "state_names": self.state_names,
            "position": self.position,
            "angles": self.angles,
            "count": len(self.trajectories),
            "notes": self.notes,
        }

    def sample(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """The ``count`` trajectories that begin closest to the start, closest first, see
        :class:`~sagemp_cli.planners.base.Planner`; again from the closest where there are fewer.

        They are as the file has them: row 0 is where they begin and *not* the start, and nothing is random. Angles
        are moved by multiples of 2 pi to lie next to the start's. For starts ``(count, n)``, each gets its closest.
        """
        starts = starts_of(start, count=count, state_dim=self.state_dim)
        where = self.position
        apart = torch.linalg.vector_norm(self.trajectories[:, 0, where] - starts[:, None, where], dim=-1)
        ranked = apart.argsort(dim=1, stable=True)
        rank = torch.zeros(count, dtype=torch.long) if start.dim() == 2 else torch.arange(count) % ranked.shape[1]
        references = self.trajectories[ranked[torch.arange(count), rank]].clone()
        turning = [i for i, name in enumerate(self.state_names) if name in self.angles]
        turns = torch.round((starts[:, turning] - references[:, 0, turning]) / (2 * math.pi))
        references[..., turning] += 2 * math.pi * turns[:, None]
        return references

    def _read(self, path: Path, robot: Dynamics) -> np.ndarray:
        found = [
            self._resampled(trajectory, path) for trajectory in read_trajectories(path, state_names=self.state_names)
        ]
        if not found:
            raise ArtifactError(f"{path}: holds no trajectory")
        filled = []
        for name, states in found:
            rows, notes = complete(states, robot, where=f"{path}: {name}")
            self.notes += [note for note in notes if note not in self.notes]
            filled.append(rows)
        return np.stack(filled)

    def _plausible(self, seconds: float) -> bool:
        """Whether a trajectory may last so long: within a factor of ten of the horizon."""
        return 0.1 <= seconds / (self.horizon * self.dt) <= 10.0

    def _resampled(self, trajectory: RecordedTrajectory, path: Path) -> tuple[str, dict[str, np.ndarray]]:
        """A trajectory's name and its states at the robot's steps."""
        steps = self.dt * np.arange(self.horizon + 1)
        where, duration = f"{path}: {trajectory.name}", self.horizon * self.dt
        time = trajectory.time
        if time is None:
            if trajectory.rows != self.horizon + 1:
                raise ArtifactError(
                    f"{where} has {trajectory.rows} rows and no time 't'; without it, rows are the steps of "
                    f"{self.dt:g} s and there must be horizon + 1 = {self.horizon + 1}"
                )
            time = steps
        lasts = float(time[-1] - time[0])
        if lasts > duration * (1 + 1e-9) + 0.5 * self.dt:
            unit = next((name for factor, name in _UNITS if self._plausible(lasts / factor)), None)
            wrong_unit = f"times are read in seconds, these look like {unit}; divide them"
            remedy = wrong_unit if unit else f"set horizon={math.ceil(lasts / self.dt - 1e-9)} or shorten it"
            raise ArtifactError(
                f"{where} lasts {lasts:.10g} s, but horizon is {self.horizon} steps of {self.dt:g} s, {duration:g} s; "
                f"{remedy}"
            )
        if lasts < duration * (1 - 1e-9) - 0.5 * self.dt:
            self.notes.append(f"{trajectory.name} ends after {lasts:g} s and keeps its last row until {duration:g} s")
        return trajectory.name, {
            name: np.interp(steps, time - time[0], np.unwrap(values) if name in self.angles else values)
            for name, values in trajectory.states.items()
        }
