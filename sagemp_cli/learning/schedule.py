"""How long and how fast something learns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from sagemp_cli.config.ranges import Count, Decay, NonNegative, Positive, Whole
from sagemp_cli.errors import ConfigError

FINAL_SHARE = 0.01
"""Share of the peak learning rate that the cosine ends at."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Updates of Adam and their learning rates; what learns adds options of its own in a subclass.

    Attributes:
        steps: number of updates.
        learning_rate: peak learning rate of Adam (AdamW where ``weight_decay`` is positive).
        shape: of the learning rate after the warm-up, see :meth:`rate_at`.
        warmup: number of warm-up updates; a twentieth of ``steps``, at most 100, if not given.
        weight_decay: decoupled weight decay.
        clip_norm: largest Euclidean norm of the gradient; None leaves gradients as they are.
        ema_decay: keep an exponential moving average of the weights with this decay (its first updates average
            over fewer steps, so that the initial weights are forgotten); the average is what is validated and what
            is kept in the end. None validates and keeps the weights themselves.
    """

    steps: Count
    learning_rate: Positive
    shape: Literal["cosine", "constant"] = "cosine"
    warmup: Whole | None = None
    weight_decay: NonNegative = 0.0
    clip_norm: Positive | None = 1.0
    ema_decay: Decay | None = None

    def __post_init__(self) -> None:
        if self.steps < 1 or not 0 <= self.warm_up < max(self.steps, 2):
            raise ConfigError(f"steps must be positive and 0 <= warmup < steps, found {self.steps} and {self.warm_up}")
        if not 0 < self.learning_rate < math.inf:
            raise ConfigError(f"learning_rate must be a positive number, found {self.learning_rate}")
        if self.shape not in ("cosine", "constant"):
            raise ConfigError(f"shape must be 'cosine' or 'constant', found '{self.shape}'")
        if self.ema_decay is not None and not 0 <= self.ema_decay < 1:
            raise ConfigError(f"ema_decay must lie in [0, 1), found {self.ema_decay}")

    @property
    def warm_up(self) -> int:
        """Number of warm-up updates, given or not."""
        return min(100, self.steps // 20) if self.warmup is None else self.warmup

    def rate_at(self, step: int) -> float:
        """The learning rate of update ``step`` in ``0..steps-1``.

        Linear from ``peak / (warmup + 1)`` to ``peak`` over ``warmup`` updates; then constant, or half a cosine
        down to ``FINAL_SHARE * peak``, which the last update gets.
        """
        peak, warmup = self.learning_rate, self.warm_up
        if step < warmup:
            return peak * (step + 1) / (warmup + 1)
        if self.shape == "constant":
            return peak
        phase = (step - warmup) / max(1, self.steps - 1 - warmup)
        return peak * (FINAL_SHARE + (1 - FINAL_SHARE) * 0.5 * (1 + math.cos(math.pi * min(1.0, phase))))
