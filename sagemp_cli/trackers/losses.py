"""The paper's tracking loss (section V-A): ``L = l1 L_track + l2 L_state + l3 L_ctrl``."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torch.nn.functional import softplus

from sagemp_cli.config.ranges import NonNegative
from sagemp_cli.dynamics.base import Dynamics


@dataclass(frozen=True)
class LossWeights:
    """Weights ``lambda_1, lambda_2, lambda_3``, which the paper leaves open."""

    track: NonNegative = 1.0
    state: NonNegative = 0.1
    control: NonNegative = 0.1


def tracking_loss(states: Tensor, targets: Tensor) -> Tensor:
    """``L_track``: mean over steps (and batch) of ``||x_{j+1} - p_{j+1}||^2``; both ``(..., H, n)``."""
    return (states - targets).square().sum(-1).mean()


def limit_loss(values: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """``L_state`` or ``L_ctrl``: mean over steps of ``softplus(z - z_U) + softplus(z_L - z)``, summed over entries."""
    return (softplus(values - upper) + softplus(lower - values)).sum(-1).mean()


def rollout_loss(
    dynamics: Dynamics, states: Tensor, controls: Tensor, targets: Tensor, weights: LossWeights
) -> tuple[Tensor, dict[str, float]]:
    """The paper's loss of rollouts, and its three parts as figures.

    Args:
        dynamics: gives the limits.
        states: ``x_{k+1}..x_{k+H}``, ``(..., H, n)``.
        controls: ``u_k..u_{k+H-1}``, ``(..., H, m)``.
        targets: ``p_{k+1}..p_{k+H}``, ``(..., H, n)``.
        weights: of the parts.
    """
    track = tracking_loss(states, targets)
    state = limit_loss(states, dynamics.state_lower, dynamics.state_upper)
    control = limit_loss(controls, dynamics.control_lower, dynamics.control_upper)
    total = weights.track * track + weights.state * state + weights.control * control
    return total, {"track": track.item(), "state": state.item(), "control": control.item()}
