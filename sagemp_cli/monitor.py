"""Whether a robot is where its certificate says, measured state by measured state; for the robot itself.

A certificate proves that every rollout from X_I stays in its tube, if robot and disturbance are as it says. A measured
state outside of the tube proves that they are not, at the first step where it shows. This module needs NumPy and
nothing else: the file can be copied onto a robot, with one that ``sagemp export monitor`` wrote.

    monitor = Monitor.load("monitor.npz", reference=2)
    for k in range(monitor.horizon + 1):
        alarm = monitor.see(measure(), time=clock())   # None, or what is wrong
        if alarm:
            stop(alarm)

Nothing here raises while the robot moves: whatever comes, a state of the wrong size, NaN, a clock that jumps, a step
too many, is an alarm. The first alarm stays: what is proved ends with it. In the syntax of Python 3.8.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np


class Cause(str, Enum):  # noqa: UP042 (StrEnum is not in the Python of many robots)
    """What an alarm is about."""

    OUTSIDE = "outside of the tube"
    START = "outside of every certified start box"
    NUMBERS = "not a state"
    CLOCK = "not at its time"
    END = "after the end"


@dataclass(frozen=True)
class Alarm:
    """The first thing that is not as certified.

    Attributes:
        cause: what it is about.
        step: number of the sample, 0 at the start.
        coordinate: the state that is farthest outside, in units of its own allowed range; empty if none is.
        size: how far it is outside, in its units; of the clock, seconds. Infinite where there is no number.
        text: all of it in one line.
    """

    cause: Cause
    step: int
    coordinate: str
    size: float
    text: str

    def __str__(self) -> str:
        return self.text


class Monitor:
    """Watches one run along one certified reference. Use one for each run.

    Args:
        lower, upper: tubes of the cells, ``(C, K+1, n)``.
        cell_lower, cell_upper: the cells of X_I that they start from, ``(C, n)``.
        names: of the states, n of them.
        error: how far a measured state may be from the true one, ``(n,)`` or a number: only what is farther outside
            is an alarm. 0: the measurement is taken as exact, but for rounding.
        dt: seconds between samples; needed where times are given.
        jitter: seconds that a sample may be early or late. The certificate holds at the instants: what the robot does
            within this time has to be in ``error``.

    Raises:
        ValueError: arrays that do not fit each other, or a bound that is not a number. Only here.
    """

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        cell_lower: np.ndarray,
        cell_upper: np.ndarray,
        names: tuple[str, ...],
        *,
        error: float | np.ndarray = 0.0,
        dt: float | None = None,
        jitter: float = 0.0,
    ) -> None:
        sides = [np.asarray(side, dtype=np.float64) for side in (lower, upper)]
        cells = [np.asarray(side, dtype=np.float64) for side in (cell_lower, cell_upper)]
        count, rows, n = sides[0].shape if sides[0].ndim == 3 else (0, 0, 0)
        if not count or rows < 2 or sides[1].shape != sides[0].shape or any(c.shape != (count, n) for c in cells):
            raise ValueError(
                f"tubes (C, K+1, n) and cells (C, n) of one size are needed, found {sides[0].shape}, {sides[1].shape}, "
                f"{cells[0].shape} and {cells[1].shape}"
            )
        if len(names) != n or any(np.isnan(side).any() for side in (*sides, *cells)):
            raise ValueError(f"{n} names and bounds without NaN are needed, found the names {', '.join(names)}")
        allowed = np.broadcast_to(np.asarray(error, dtype=np.float64), (n,))
        if not (allowed >= 0).all() or not jitter >= 0 or not (dt is None or 0 < dt < np.inf):
            raise ValueError(f"error, jitter and dt must not be negative, found {error}, {jitter} and {dt}")
        self.names, self.dt, self.jitter, self.error = names, dt, float(jitter), allowed
        self._tubes, self._cells = sides, cells
        self._low = self._high = np.zeros((rows, n))
        self._step, self._began, self._alarm = 0, 0.0, None

    @classmethod
    def load(cls, path: str | Path, *, reference: int = 0, **options: Any) -> Monitor:
        """From a file of ``sagemp export monitor``, for one of its references; ``options`` as above.

        Raises:
            ValueError: the file is not one, or has no such reference.
        """
        with np.load(path, allow_pickle=False) as file:
            missing = {"lower", "upper", "cell_lower", "cell_upper", "cell_reference", "names", "dt"} - set(file.files)
            if missing:
                raise ValueError(f"{path}: not a file of 'sagemp export monitor', {sorted(missing)} is missing")
            own = file["cell_reference"] == reference
            if not own.any():
                last = int(file["cell_reference"].max())
                raise ValueError(f"{path}: has the references 0 to {last}, not {reference}")
            dt = float(file["dt"])
            options.setdefault("dt", dt if np.isfinite(dt) else None)
            low, high, cell_low, cell_high = (file[k][own] for k in ("lower", "upper", "cell_lower", "cell_upper"))
            return cls(low, high, cell_low, cell_high, tuple(str(name) for name in file["names"]), **options)

    @property
    def horizon(self) -> int:
        """Number of steps K; K+1 states are expected."""
        return self._tubes[0].shape[1] - 1

    @property
    def step(self) -> int:
        """The number of the state that is expected next."""
        return self._step

    @property
    def alarm(self) -> Alarm | None:
        """The first alarm, if there was one."""
        return self._alarm

    def see(self, state: Any, *, time: float | None = None) -> Alarm | None:
        """The next measured state ``(n,)``, and when it was measured (seconds of any clock that runs steadily).

        Returns:
            None if all is as certified so far; else the first alarm, from now on every time.
        """
        if self._alarm is None:
            self._alarm = self._check(state, time)
            self._step += 1
        return self._alarm

    def _check(self, state: Any, time: float | None) -> Alarm | None:
        k = self._step
        if k > self.horizon:
            return self._of(Cause.END, "", np.inf, f"{self.horizon} steps are certified")
        x = _numbers(state)
        if x is None or x.shape != (len(self.names),):
            found = "something else" if x is None else f"an array of shape {x.shape}"
            return self._of(Cause.NUMBERS, "", np.inf, f"{len(self.names)} numbers are expected, found {found}")
        bad = np.flatnonzero(~np.isfinite(x))
        if len(bad):
            name = self.names[bad[0]]
            return self._of(Cause.NUMBERS, name, np.inf, f"{name} is {x[bad[0]]}")
        late = self._late(time)
        if late is not None:
            return late
        if k == 0:
            held, exact = self._held(x, self.error), not self.error.any()
            if not held.any():  # beside a face by rounding, it may be in any of the cells there
                held, exact = self._held(x, self.error + _rounding(x)), False
            if not held.any():
                low, high = self._cells[0].min(0), self._cells[1].max(0)
                return self._outside(Cause.START, x, low, high) or self._of(Cause.START, "", np.inf, "between cells")
            if exact:  # exactly known: it is in the tubes of all the cells that it is in
                self._low, self._high = self._tubes[0][held].max(0), self._tubes[1][held].min(0)
            else:  # it may be in any of them
                self._low, self._high = self._tubes[0][held].min(0), self._tubes[1][held].max(0)
        return self._outside(Cause.OUTSIDE, x, self._low[k], self._high[k])

    def _held(self, x: np.ndarray, error: np.ndarray) -> np.ndarray:
        """The cells that a state may be in, ``(C,)``."""
        inside = (self._cells[0] - error <= x) & (x <= self._cells[1] + error)
        return np.asarray(inside.all(-1))

    def _late(self, time: float | None) -> Alarm | None:
        if time is None:
            return None
        now = _numbers(time)
        if now is None or now.shape or not np.isfinite(now):
            return self._of(Cause.CLOCK, "", np.inf, f"{time!r} is no time")
        if self.dt is None:
            return self._of(Cause.CLOCK, "", np.inf, "a time was given, and the monitor does not know dt")
        if self._step == 0:
            self._began = float(now)
        off = float(now) - self._began - self._step * self.dt
        slack = 1e-9 * self.dt * (1 + self._step) + 4 * np.spacing(abs(float(now)) + abs(self._began))
        if abs(off) <= self.jitter + slack:
            return None
        return self._of(Cause.CLOCK, "", abs(off), f"measured {abs(off):.6g} s too {'late' if off > 0 else 'early'}")

    def _outside(self, cause: Cause, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> Alarm | None:
        """The coordinate that is farthest outside, relative to the width of its bounds."""
        off = np.maximum(low - x, x - high) - self.error
        rounding = _rounding(x)
        if not (off > rounding).any():
            return None
        width = np.where(np.isfinite(high - low), high - low, 1.0)
        i = int(np.argmax(np.where(off > rounding, off / np.maximum(width, 1e-12), -np.inf)))
        name = self.names[i]
        return self._of(cause, name, float(off[i]), f"{name} is {x[i]:.6g}, certified is {low[i]:.6g} to {high[i]:.6g}")

    def _of(self, cause: Cause, name: str, size: float, why: str) -> Alarm:
        return Alarm(cause, self._step, name, size, f"step {self._step}: {cause.value}: {why}")


def _rounding(x: np.ndarray) -> np.ndarray:
    """Of computing the state; the tube holds in real arithmetic."""
    return 1e-9 * (1.0 + np.abs(x))


def _numbers(value: Any) -> np.ndarray | None:
    """Anything as an array of numbers, if it is one."""
    try:
        array = np.asarray(value)
        return array.astype(np.float64) if array.dtype.kind in "iuf" else None
    except Exception:  # whatever it is, it is no number, and the robot is moving
        return None
