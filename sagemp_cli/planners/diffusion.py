"""The diffusion planner: plans by denoising, DDPM and DDIM."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from sagemp_cli.config.ranges import Count, Share
from sagemp_cli.errors import ConfigError
from sagemp_cli.planners.generative import Conditions, GenerativeLoss, GenerativePlanner

PREDICTIONS = ("knots", "v", "epsilon")
SAMPLERS = ("ddim", "ddpm")


def cosine_schedule(levels: int) -> Tensor:
    """``abar_0 = 1 > abar_1 > ... > abar_T > 0``, ``(T+1,)``, float64 (Nichol & Dhariwal 2021, equation 17).

    As there, no single level takes away more than 99.9 % of the signal's variance.
    """
    share = torch.arange(levels + 1, dtype=torch.float64) / levels
    curve = torch.cos((share + 0.008) / 1.008 * math.pi / 2).square()
    alpha = (curve[1:] / curve[:-1]).clamp(min=1e-3)
    return torch.cat([torch.ones(1, dtype=torch.float64), alpha.cumprod(0)])


class DiffusionLoss(GenerativeLoss):
    """DDPM training (Ho et al. 2020) at a level drawn uniformly from 1..T.

    On ``z = a knots + b noise``, ``a^2 = abar = 1 - b^2``, the network is to answer ``noise``
    (``prediction="epsilon"``), ``a noise - b knots`` (``"v"``, Salimans & Ho 2022) or ``knots``, in the mean square.
    Knots are weighted with ``1 / b^2``, at most 100; up to there that is the same loss as ``"v"``.
    """

    def error(self, module: Diffusion, knots: Tensor, noise: Tensor, u: Tensor, conditions: Conditions) -> Tensor:
        """See :meth:`GenerativeLoss.error`."""
        level = 1 + (u * module.levels).long()
        a, b = module.signal[level][:, None, None], module.noise[level][:, None, None]
        wanted = {"knots": knots, "v": a * noise - b * knots, "epsilon": noise}[module.prediction]
        miss = module.answer(a * knots + b * noise, level / module.levels, conditions) - wanted
        return (miss / b.clamp(min=0.1)).square().mean() if module.prediction == "knots" else miss.square().mean()


class Diffusion(GenerativePlanner):
    """Plans by denoising diffusion; see :class:`~sagemp_cli.planners.generative.GenerativePlanner`.

    Args:
        levels: noise levels T.
        prediction: what the network is trained to answer, ``"knots"``, ``"v"`` or ``"epsilon"``. The last two have to
            carry the noise through the network, whose errors then stay in the plan; ``"knots"`` gives smoother ones.
        sampler: ``"ddpm"`` (ancestral, all T levels; Ho et al. 2020) or ``"ddim"`` (Song et al. 2021).
        denoising_steps: levels that DDIM visits, spread evenly over T.
        eta: share of DDPM's fresh noise that DDIM adds: 0 is deterministic given the first noise, 1 is ancestral.
        common: those of every generative planner; the generative time is the noise level over T.
    """

    loss_type: ClassVar = DiffusionLoss

    _abar: Tensor
    signal: Tensor
    noise: Tensor

    def __init__(
        self,
        *,
        levels: Count = 100,
        prediction: Literal["knots", "v", "epsilon"] = "knots",
        sampler: Literal["ddpm", "ddim"] = "ddim",
        denoising_steps: Count = 20,
        eta: Share = 0.0,
        **common: Any,
    ) -> None:
        super().__init__(**common)
        if prediction not in PREDICTIONS:
            raise ConfigError(f"planner: prediction must be one of {PREDICTIONS}, found '{prediction}'")
        if sampler not in SAMPLERS:
            raise ConfigError(f"planner: sampler must be one of {SAMPLERS}, found '{sampler}'")
        if not 1 <= denoising_steps <= levels:
            raise ConfigError(
                f"planner: denoising_steps must lie between 1 and levels, found {denoising_steps} and {levels}"
            )
        if not 0 <= eta <= 1:
            raise ConfigError(f"planner: eta must lie in [0, 1], found {eta}")
        self.levels, self.prediction, self.sampler = int(levels), prediction, sampler
        self.denoising_steps, self.eta = int(denoising_steps), float(eta)
        self.register_buffer("_abar", cosine_schedule(self.levels), persistent=False)
        self.register_buffer("signal", self._abar.sqrt().float(), persistent=False)
        self.register_buffer("noise", (1 - self._abar).sqrt().float(), persistent=False)

    @property
    def arguments(self) -> dict[str, Any]:
        """Plain keyword arguments that rebuild this planner; its weights are in ``state_dict()``."""
        return super().arguments | {
            "levels": self.levels,
            "prediction": self.prediction,
            "sampler": self.sampler,
            "denoising_steps": self.denoising_steps,
            "eta": self.eta,
        }

    def generate(self, noise: Tensor, conditions: Conditions, *, generator: torch.Generator) -> Tensor:
        """Denoise from level T to 0; fresh noise, where the sampler adds any, comes from ``generator``."""
        if self.sampler == "ddpm":
            return self._ancestral(noise, conditions, generator)
        return self._implicit(noise, conditions, generator)

    def denoise(self, z: Tensor, level: int, conditions: Conditions) -> tuple[Tensor, Tensor]:
        """What the network takes for the knots and for the noise in ``z (B, M, n)`` at a level in 1..T."""
        a, b = self.signal[level], self.noise[level]
        found = self.answer(z, z.new_full((len(z),), level / self.levels), conditions)
        if self.prediction == "knots":
            return found, (z - a * found) / b
        if self.prediction == "v":
            return a * z - b * found, b * z + a * found
        return (z - b * found) / a, found

    def _ancestral(self, z: Tensor, conditions: Conditions, generator: torch.Generator) -> Tensor:
        """``z_{t-1} ~ q(z_{t-1} | z_t, knots)`` with the knots that the network sees: DDPM's posterior, equation 7."""
        for level in range(self.levels, 0, -1):
            before, now = self._abar[level - 1], self._abar[level]
            beta = 1 - now / before
            knots, _ = self.denoise(z, level, conditions)
            mean = (before.sqrt() * beta * knots + (1 - beta).sqrt() * (1 - before) * z) / (1 - now)
            spread = ((1 - before) / (1 - now) * beta).sqrt()
            z = (mean + spread * self._fresh(z, generator) if level > 1 else mean).float()
        return z

    def _implicit(self, z: Tensor, conditions: Conditions, generator: torch.Generator) -> Tensor:
        """DDIM, equation 12: to the next visited level along the noise that the network sees, eta of it fresh."""
        visited = torch.linspace(self.levels, 0, self.denoising_steps + 1, dtype=torch.float64).round().long().tolist()
        for level, following in zip(visited[:-1], visited[1:], strict=True):
            now, then = self._abar[level], self._abar[following]
            knots, noise = self.denoise(z, level, conditions)
            spread = self.eta * ((1 - then) / (1 - now) * (1 - now / then)).sqrt()
            z = then.sqrt() * knots + (1 - then - spread**2).clamp(min=0).sqrt() * noise
            if self.eta > 0 and following > 0:
                z = z + spread * self._fresh(z, generator)
            z = z.float()
        return z

    @staticmethod
    def _fresh(z: Tensor, generator: torch.Generator) -> Tensor:
        return torch.randn(z.shape, generator=generator)
