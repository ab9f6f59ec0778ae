"""A sampled loop: an ODE whose control is measured and computed at instants and held between them, as data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from sagemp_cli.reachability.program.loops import record
from sagemp_cli.reachability.program.program import Program
from sagemp_cli.sets import Box


class Sampled(Protocol):
    """A loop that says its ODE and its control apart; a ``lag`` as :class:`SampledLoop` has it may be there too."""

    @property
    def horizon(self) -> int:
        """Periods K."""
        ...

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        ...

    @property
    def period(self) -> float:
        """Seconds between two instants."""
        ...

    def numbers(self) -> Tensor:
        """What the control at each instant has of its own, ``(K, ..., g)``."""
        ...

    def control_given(self, numbers: Tensor, x: Tensor) -> Tensor:
        """``u_k (..., m)``, held over period k, from the instant's :meth:`numbers` and ``x(t_k)``."""
        ...

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """``f(x, u) (..., n)``."""
        ...


@dataclass(frozen=True, eq=False)
class SampledLoop:
    """``x'(t) = f(x(t), u_k) + w(t)`` and ``u_k = c_k(x(t_k))`` for t in period k; w is any measurable signal in W.

    With a lag ``u_k = c_k(x(t_k - j_k))`` is in force from ``t_k + d_k`` to ``t_{k+1} + d_{k+1}``, whatever ``d_k`` and
    ``j_k`` are within their bounds, but for the first: ``d_0 = j_0 = 0``.

    Attributes:
        control: reads the state and the instant's numbers; its output ``control`` is u, its ``next`` the state itself.
        rate: f; reads the state and, as its numbers, u. Its output ``next`` is ``x' - w``. Neither reads a disturbance.
        numbers: of each instant, ``(K, ..., g)``; dimensions between are a batch of loops.
        horizon: periods K.
        period: seconds, taken as exact.
        lag: bounds of delay d and jitter j in seconds, together at most a period, ``(2,)`` or of each period
            ``(K, 2)``; None if there is none.
    """

    control: Program
    rate: Program
    numbers: Tensor
    horizon: int
    period: float
    lag: Box | None = None

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.rate.states

    @property
    def batch(self) -> torch.Size:
        """Shape of the batch of loops that this is."""
        return self.numbers.shape[1:-1]

    @property
    def controls(self) -> int:
        """Number of controls m."""
        return self.rate.numbers

    def beginning(self, periods: int) -> SampledLoop:
        """Its first periods."""
        lag = self.lag
        if lag is not None and lag.lower.dim() > 1:
            lag = Box(lag.lower[:periods], lag.upper[:periods])
        return replace(self, numbers=self.numbers[:periods], horizon=periods, lag=lag)


def sampled(loop: Sampled | SampledLoop, start: Box) -> SampledLoop:
    """The loop as programs; one that is recorded already as it is.

    Args:
        loop: in torch operations.
        start: an example is computed at a centre of it, ``(..., n)``.

    Raises:
        UnsupportedOperationError: an operation that cannot be bounded.
    """
    if isinstance(loop, SampledLoop):
        return loop
    x = start.center.reshape(-1, start.dim)[0]
    nothing = torch.zeros_like(x)
    numbers = loop.numbers().to(torch.float64)
    example = numbers.flatten(0, -2)[0]
    control = record(lambda x, w, numbers: (x * 1, loop.control_given(numbers, x)), x, nothing, example)
    with torch.no_grad():
        u = loop.control_given(example, x)
    rate = record(lambda x, w, u: loop.rate(x, u), x, nothing, u)
    return SampledLoop(control, rate, numbers, loop.horizon, float(loop.period), getattr(loop, "lag", None))
