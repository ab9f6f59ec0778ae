"""What every robot model offers, and the discrete step written once.

A model is written as plain torch operations on ``(x, u)``. The same function is simulated on tensors,
differentiated in training, bounded by every propagator and re-checked in ball arithmetic, so it may use
only operations for which the propagators have a relaxation (an unknown one is an error that names it).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Literal

import torch
from annotated_types import Gt, doc
from torch import Tensor, nn

from sagemp_cli.dynamics.flatness import Array
from sagemp_cli.dynamics.lag import Lag, Seconds
from sagemp_cli.errors import ConfigError
from sagemp_cli.sets.box import Box

DISTURBANCE_READINGS = ("derivative", "state")

SIMULATED = 4
"""Parts of a period in which a robot in continuous time is simulated (classical Runge-Kutta method)."""


class Dynamics(nn.Module):
    """Base of all robot models, ``x_{k+1} = f(x_k, u_k, w_k)`` (paper, equation 1).

    A subclass sets the class attributes and implements :meth:`derivative`.

    The paper leaves open how w enters. ``disturbance="derivative"`` (default) reads
    ``x_{k+1} = x_k + dt (f(x_k, u_k) + w_k)``; ``disturbance="state"`` reads
    ``x_{k+1} = x_k + dt f(x_k, u_k) + w_k``.

    With ``time="continuous"`` the robot is the ODE ``x' = f(x, u) + w`` itself, u is held between the instants
    ``k dt``, and a step is a simulated solution over one period with w held too. What is proved speaks of all times and
    of every measurable w (``docs/continuous_time.md``). There the control may lag (:class:`~.dynamics.lag.Lag`).
    """

    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    control_names: tuple[str, ...]
    control_units: tuple[str, ...]
    position: tuple[int, ...]
    """Indices of the state that are the position in the scene."""
    angles: tuple[str, ...] = ()
    """Names of the states that are angles, so that 2 pi more is the same."""
    rates: Mapping[str, str] = MappingProxyType({})
    """Of each state that is the rate of change of another one, that one's name, so that plans may leave it out."""
    control_lower: Tensor
    control_upper: Tensor
    state_lower: Tensor
    state_upper: Tensor

    def __init__(
        self,
        *,
        dt: Annotated[float, Gt(0), doc("a positive number of seconds")],
        control_lower: list[float],
        control_upper: list[float],
        state_lower: list[float],
        state_upper: list[float],
        disturbance: Literal["derivative", "state"] = "derivative",
        time: Literal["discrete", "continuous"] = "discrete",
        delay: Seconds = 0.0,
        jitter: Seconds = 0.0,
    ) -> None:
        super().__init__()
        name = type(self).__name__
        if not 0 < dt < float("inf"):
            raise ConfigError(f"{name}: dt must be a positive number of seconds, found {dt}")
        if disturbance not in DISTURBANCE_READINGS:
            raise ConfigError(f"{name}: disturbance must be one of {DISTURBANCE_READINGS}, found '{disturbance}'")
        if time not in ("discrete", "continuous"):
            raise ConfigError(f"{name}: time must be 'discrete' or 'continuous', found '{time}'")
        if time == "continuous" and disturbance != "derivative":
            raise ConfigError(
                f"{name}: with time=continuous w is added to the derivative, found disturbance '{disturbance}'"
            )
        self.control_lag = Lag.of(name, delay, jitter, float(dt))
        if self.control_lag and time != "continuous":
            raise ConfigError(f"{name}: delay and jitter are those of time=continuous; in discrete time there are none")
        self.dt = float(dt)
        self.time: Literal["discrete", "continuous"] = time
        self.disturbance: Literal["derivative", "state"] = disturbance
        for key, values, size in (
            ("control_lower", control_lower, self.control_dim),
            ("control_upper", control_upper, self.control_dim),
            ("state_lower", state_lower, self.state_dim),
            ("state_upper", state_upper, self.state_dim),
        ):
            if len(values) != size:
                raise ConfigError(f"{name}: {key} needs {size} numbers, found {len(values)}")
            self.register_buffer(key, torch.tensor([float(v) for v in values], dtype=torch.float64), persistent=False)
        if bool((self.control_lower >= self.control_upper).any() | (self.state_lower >= self.state_upper).any()):
            raise ConfigError(f"{name}: every lower limit must lie below its upper limit")

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return len(self.state_names)

    @property
    def control_dim(self) -> int:
        """Number of controls m."""
        return len(self.control_names)

    @property
    def analytical(self) -> Dynamics:
        """The model of formulas that this one stands for: itself, unless it was learned from another."""
        return self

    def filled_in(self, known: Mapping[str, Array]) -> Iterator[tuple[str, Array, str]]:
        """States that follow from others which a plan has, where :attr:`rates` do not say it: none by default.

        Args:
            known: values ``(K+1,)`` by name, which grow by what is given; the positions are among them.

        Yields:
            A state's name, its values ``(K+1,)`` and, in a few words, what they are; those that a plan has are kept.
        """
        yield from ()

    def derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """The undisturbed state derivative ``f(x, u)``; ``x (..., n)``, ``u (..., m)`` to ``(..., n)``."""
        raise NotImplementedError

    @property
    def continuous(self) -> bool:
        """Whether the robot is an ODE, not a map from instant to instant."""
        return self.time == "continuous"

    def unknowns(self, disturbance: Box) -> Box:
        """What is unknown of every step: w in a box ``(n,)``; if a control lags, the seconds of delay and jitter."""
        if not self.control_lag:
            return disturbance
        sides = zip(
            (disturbance.lower, disturbance.upper),
            (self.control_lag.box.lower, self.control_lag.box.upper),
            strict=True,
        )
        return Box(*(torch.cat(pair) for pair in sides))

    def completed(self, w: Tensor) -> Tensor:
        """Disturbances ``(..., K, d)`` of a rollout; where they say nothing of a lag, it is the least that may be."""
        if not self.control_lag or w.shape[-1] != self.state_dim:
            return w
        return torch.cat([w, self.control_lag.box.lower.expand(*w.shape[:-1], 2)], dim=-1)

    def step(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """One forward-Euler step under the disturbance ``w (..., n)``; in continuous time a simulated solution over one
        period. See the class for how w enters.
        """
        if self.continuous:
            return self._simulated(x, u, w)[-1]
        return self.advance(x, self.derivative(x, u), w)

    def path(self, states: Tensor, controls: Tensor, w: Tensor) -> Tensor:
        """A simulated rollout ``(..., K+1, n)`` with points between the instants, ``(..., P+1, n)``.

        In discrete time the rollout itself: between the instants are straight lines.

        Args:
            states, controls, w: of the rollout, ``(..., K+1, n)``, ``(..., K, m)`` and ``(..., K, d)``, see
                :meth:`unknowns`.
        """
        if not self.continuous:
            return states
        w = self.completed(w)
        held = torch.cat([controls[..., :1, :], controls[..., :-1, :]], dim=-2)
        inner = self._simulated(states[..., :-1, :], controls, w, held)[:-1]
        inside = torch.stack([states[..., :-1, :], *inner], dim=-2).flatten(-3, -2)
        return torch.cat([inside, states[..., -1:, :]], dim=-2)

    def lagged(self, x: Tensor, held: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """The state a period later, simulated, of which ``held`` was in force until the control came; ``w (..., d)``,
        see :meth:`unknowns`.
        """
        return self._simulated(x, u, w, held)[-1]

    def measured(self, x: Tensor, held: Tensor, w: Tensor) -> Tensor:
        """The state, simulated, that was measured before ``x``, under the control that was in force; ``w (..., d)``."""
        if w.shape[-1] == self.state_dim:
            return x
        return self._solved(x, held, w[..., : self.state_dim], -w[..., self.state_dim + 1 :])

    def _simulated(self, x: Tensor, u: Tensor, w: Tensor, held: Tensor | None = None) -> list[Tensor]:
        """States at the ends of the parts of a period."""
        h, n, found = self.dt / SIMULATED, self.state_dim, []
        rates = w[..., :n]
        for i in range(SIMULATED):
            if w.shape[-1] == n or held is None:
                x = self._solved(x, u, rates, h)
            else:
                before = (w[..., n : n + 1] - i * h).clamp(0.0, h)
                x = self._solved(self._solved(x, held, rates, before), u, rates, h - before)
            found.append(x)
        return found

    def _solved(self, x: Tensor, u: Tensor, w: Tensor, h: Tensor | float) -> Tensor:
        """The state some seconds later, by one step of the classical Runge-Kutta method."""
        a = self.derivative(x, u) + w
        b = self.derivative(x + h / 2 * a, u) + w
        c = self.derivative(x + h / 2 * b, u) + w
        d = self.derivative(x + h * c, u) + w
        return x + h / 6 * (a + 2 * b + 2 * c + d)

    def advance(self, x: Tensor, derivative: Tensor, w: Tensor) -> Tensor:
        """The same from a derivative that is known already."""
        if self.disturbance == "derivative":
            return x + self.dt * (derivative + w)
        return x + self.dt * derivative + w
