"""Trajectories as a few knots of a cubic spline: the smooth representation that generative planners sample in."""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError


class Spline(nn.Module):
    """Cubic splines (not-a-knot) through ``knots`` values at equal spacing over K steps, to rows and back.

    A network that denoises every row of a trajectory leaves some noise in each, and second differences, which the
    tracker has to follow, amplify it most. A spline through a fifth of the rows cannot be jagged, and the network
    that generates its knots is five times cheaper. What is lost is what the spline cannot follow.

    Both directions are fixed matrices, computed once in float64; they are no weights.

    Args:
        horizon: K.
        knots: number of knots M, from 4 to K + 1.
    """

    _rows: Tensor
    _knots: Tensor

    def __init__(self, *, horizon: int, knots: int) -> None:
        super().__init__()
        if not 4 <= knots <= horizon + 1:
            raise ConfigError(f"planner: knots must lie between 4 and horizon + 1 = {horizon + 1}, found {knots}")
        basis = CubicSpline(np.linspace(0.0, 1.0, knots), np.eye(knots))(np.linspace(0.0, 1.0, horizon + 1))
        # Knot 0 is row 0; the others fit the remaining rows in the sense of least squares.
        rest = np.linalg.pinv(basis[:, 1:])
        fit = np.zeros((knots, horizon + 1))
        fit[1:] = rest
        fit[1:, 0] -= rest @ basis[:, 0]
        fit[0, 0] = 1.0
        self.register_buffer("_rows", torch.from_numpy(basis), persistent=False)
        self.register_buffer("_knots", torch.from_numpy(fit), persistent=False)

    def knots_of(self, rows: Tensor) -> Tensor:
        """Knots ``(..., M, n)`` of the spline nearest to rows ``(..., K+1, n)`` that has the same row 0; float64."""
        return self._knots @ rows.to(torch.float64)

    def rows_of(self, knots: Tensor) -> Tensor:
        """Rows ``(..., K+1, n)``, float64, of the spline through knots ``(..., M, n)``."""
        return self._rows @ knots.to(torch.float64)
