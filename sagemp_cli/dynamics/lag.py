"""How late a robot's control may be: measured a little before its instant, in force a little after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.sets.box import Box

Seconds = float | list[float]
"""At most so many, or least and most."""


@dataclass(frozen=True)
class Lag:
    """What is known of a control's delay and of its measurement's jitter, in seconds, least and most.

    ``u_k`` is computed from ``x(t_k - j)`` and comes into force at ``t_k + d``; until then ``u_{k-1}`` is. Of every
    instant j and d are unknown in these bounds, but for the first: ``u_0`` is computed from ``x(0)`` and in force at
    once.
    """

    delay: tuple[float, float] = (0.0, 0.0)
    jitter: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, where: str, delay: Seconds, jitter: Seconds, period: float) -> Lag:
        """From numbers, each the most or a pair of least and most.

        Raises:
            ConfigError: they are no such bounds, or together more than a period.
        """
        found = cls(_bounds(f"{where}: delay", delay), _bounds(f"{where}: jitter", jitter))
        if Fraction(found.delay[1]) + Fraction(found.jitter[1]) > Fraction(period):
            raise ConfigError(
                f"{where}: delay and jitter may be at most one period together, {period:g} s; found "
                f"{found.delay[1]:g} s and {found.jitter[1]:g} s"
            )
        return found

    def __bool__(self) -> bool:
        return self.delay[1] > 0 or self.jitter[1] > 0

    @property
    def box(self) -> Box:
        """Of delay and jitter, ``(2,)``."""
        least, most = zip(self.delay, self.jitter, strict=True)
        return Box(torch.tensor(least, dtype=torch.float64), torch.tensor(most, dtype=torch.float64))


def _bounds(where: str, given: Seconds) -> tuple[float, float]:
    pair = tuple(given) if isinstance(given, Sequence) else (0.0, given)
    if len(pair) != 2 or not 0 <= pair[0] <= pair[1] < float("inf"):
        raise ConfigError(f"{where} must be a number of seconds, or least and most of them, found {given}")
    return float(pair[0]), float(pair[1])
