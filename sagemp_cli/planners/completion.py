"""Whole states from the positions alone: velocities, headings and tilts that a file of trajectories leaves out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sagemp_cli.errors import ArtifactError

POSITIONS = ("px", "py", "pz")
ANGLES = ("theta", "phi", "psi")
"""Names of states that are angles, so that 2 pi more is the same."""
GRAVITY = 9.81

Array = NDArray[np.float64]

_RATES = {"vx": "px", "vy": "py", "vz": "pz", "omega": "phi", "p": "phi", "q": "theta", "r": "psi"}


def complete(
    states: Mapping[str, Array], *, state_names: Sequence[str], dt: float, where: str
) -> tuple[Array, list[str]]:
    """All states ``(K+1, n)`` in their order, and one line for each that was filled in.

    Rules, by name; differences are forward, ``(p_{k+1} - p_k) / dt``, as in the robots' Euler step, the last repeated:

    * ``vx, vy, vz``: differences of the position; ``v``: its speed.
    * ``theta`` of a robot on the ground: direction of the position's differences, continuous over turns; while it
      stands still, the direction before.
    * ``phi`` of a planar quadrotor, ``theta`` and ``phi`` of a 3-D one: the tilt whose thrust gives the velocity's
      differences under gravity of 9.81 m/s^2, at the yaw ``psi``, which is 0 if it is missing.
    * ``omega``; ``p, q, r``: differences of the angles (body rates: only where tilts are small).

    Args:
        states: values ``(K+1,)`` by name at the robot's time step.
        state_names: all names.
        dt: seconds a step.
        where: begins an error's message.

    Raises:
        ArtifactError: a position is missing, or a state for which there is no rule.
    """
    known, notes = {name: np.asarray(values) for name, values in states.items()}, []
    places = [name for name in state_names if name in POSITIONS]
    missing = [name for name in places if name not in known]
    if missing:
        raise ArtifactError(f"{where} has no {' and no '.join(missing)}; positions cannot be filled in")

    def rate(values: Array) -> Array:
        steps = np.diff(values) / dt
        return np.append(steps, steps[-1])

    def fill(name: str, values: Array, how: str) -> None:
        if name in state_names and name not in known:
            known[name] = values
            notes.append(f"{name}: {how}")

    if "pz" not in state_names:
        velocity = np.stack([rate(known[p]) for p in places])
        fill("v", np.hypot(*velocity), "speed of the position's differences")
        fill("theta", _heading(velocity), "direction of the position's differences")
    for name in ("vx", "vy", "vz"):
        if name in state_names:
            fill(name, rate(known[_RATES[name]]), f"differences of {_RATES[name]}")
    if "pz" in state_names:
        fill("psi", np.zeros_like(known["pz"]), "taken as 0")
        _tilt(known, rate, fill)
    for name in ("omega", "p", "q", "r"):
        if _RATES[name] in known:
            fill(name, rate(known[_RATES[name]]), f"differences of {_RATES[name]}")
    lacking = [name for name in state_names if name not in known]
    if lacking:
        raise ArtifactError(f"{where} has no {lacking[0]}, and there is no rule to fill it in")
    return np.stack([known[name] for name in state_names], axis=-1), notes


def _heading(velocity: Array) -> Array:
    """Direction of velocities ``(2, K+1)`` in the plane, unwrapped; kept while they vanish."""
    moving = np.hypot(*velocity) > 1e-9
    if not moving.any():
        return np.zeros(velocity.shape[1])
    # Row k has the direction of the last moving row up to k; rows before the first take that one's.
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    last[last < 0] = int(np.argmax(moving))
    return np.unwrap(np.arctan2(velocity[1], velocity[0])[last])


def _tilt(known: Mapping[str, Array], rate: Callable[[Array], Array], fill: Callable[[str, Array, str], None]) -> None:
    """The attitude whose thrust, along the body's axis, gives the acceleration; see ``dynamics`` for the equations."""
    up = rate(known["vz"]) + GRAVITY
    if "py" not in known:
        fill("phi", np.unwrap(np.arctan2(-rate(known["vx"]), up)), "tilt from the differences of the velocity")
        return
    ax, ay, psi = rate(known["vx"]), rate(known["vy"]), known["psi"]
    ahead, left = ax * np.cos(psi) + ay * np.sin(psi), ay * np.cos(psi) - ax * np.sin(psi)
    how = "tilt from the differences of the velocity"
    fill("theta", np.unwrap(np.arctan2(ahead, up)), how)
    fill("phi", np.arctan2(-left, np.hypot(ahead, up)), how)
