"""Whole states from the positions alone: what a file of trajectories leaves out is filled in as the robot says."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.flatness import Array, rate
from sagemp_cli.errors import ArtifactError


def complete(states: Mapping[str, Array], robot: Dynamics, *, where: str) -> tuple[Array, list[str]]:
    """All states ``(K+1, n)`` in their order, and one line for each that was filled in.

    A state that is another one's rate of change (the robot's ``rates``) is that one's differences; then come the
    robot's own rules (:meth:`~sagemp_cli.dynamics.base.Dynamics.filled_in`), and rates of what these gave.

    Args:
        states: values ``(K+1,)`` by name at the robot's time step.
        robot: says what follows from what.
        where: begins an error's message.

    Raises:
        ArtifactError: a position is missing, or a state for which there is no rule.
    """
    known, notes = {name: np.asarray(values) for name, values in states.items()}, []
    names = robot.state_names
    missing = [names[i] for i in robot.position if names[i] not in known]
    if missing:
        raise ArtifactError(f"{where} has no {' and no '.join(missing)}; positions cannot be filled in")

    def fill(name: str, values: Array, how: str) -> None:
        if name not in known:
            known[name] = values
            notes.append(f"{name}: {how}")

    def fill_rates() -> None:
        for name in names:
            source = robot.rates.get(name)
            if source in known:
                fill(name, rate(known[source], robot.dt), f"differences of {source}")

    fill_rates()
    for name, values, how in robot.analytical.filled_in(known):
        fill(name, values, how)
    fill_rates()
    lacking = [name for name in names if name not in known]
    if lacking:
        raise ArtifactError(
            f"{where} has no {lacking[0]}, and there is no rule to fill it in: {type(robot).__name__} does not say"
        )
    return np.stack([known[name] for name in names], axis=-1), notes
