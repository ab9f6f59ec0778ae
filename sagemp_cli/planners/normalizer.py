"""Shift and scale that bring every state to zero mean and unit spread."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sagemp_cli.errors import NonFiniteError, UsageError


class Normalizer(nn.Module):
    """``z = (x - mean) / scale`` per dimension; the identity until it is fitted.

    Mean and scale are float64 buffers ``(n,)``, so they travel with the weights of the module that owns them.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(dim, dtype=torch.float64))

    @torch.no_grad()
    def fit(self, data: Tensor) -> Normalizer:
        """Take mean and standard deviation from ``data (..., n)``; a constant dimension gets scale 1."""
        flat = data.reshape(-1, data.shape[-1]).to(torch.float64)
        if data.shape[-1] != self.mean.shape[0] or len(flat) == 0:
            raise UsageError(f"normalizer needs data of shape (..., {self.mean.shape[0]}), found {tuple(data.shape)}")
        if not bool(torch.isfinite(flat).all()):
            raise NonFiniteError("the data to fit a normalizer on contain NaN or infinity")
        mean, spread = flat.mean(0), flat.std(0, correction=0)
        # Rounding gives a constant column a spread of some 1e-16 of its value; that is no scale to divide by.
        constant = spread <= 1e-9 * (1 + mean.abs())
        self.mean.copy_(mean)
        self.scale.copy_(torch.where(constant, torch.ones_like(spread), spread))
        return self

    def normalize(self, x: Tensor) -> Tensor:
        """States ``(..., n)`` to normalised states."""
        return (x - self.mean) / self.scale

    def denormalize(self, z: Tensor) -> Tensor:
        """Normalised states ``(..., n)`` back to states (the inverse up to rounding)."""
        return z * self.scale + self.mean
