"""The dynamics' inverse: the controls that would make the robot follow a plan, and what they leave of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import NonFiniteError, UsageError

AFFINE = 1e-9
"""Relative deviation from an affine map of u up to which a derivative counts as affine in it: rounding is far below."""


@dataclass(frozen=True)
class Inverse:
    """What :func:`invert` returns.

    Attributes:
        controls: ``u_k``, ``(..., K, m)``.
        residual: ``(x_{k+1} - x_k) / dt - f(x_k, u_k)``, the part of the plan's slope that the controls do not make,
            ``(..., K, n)`` in units of the state per second. Zero exactly where the plan is feasible.
    """

    controls: Tensor
    residual: Tensor


def invert(dynamics: Dynamics, plans: Tensor, *, within_limits: bool = True) -> Inverse:
    """Controls of plans ``(..., K+1, n)``, as if the robot were on the plan at every step and undisturbed.

    All robots of the paper are affine in the control, ``f(x, u) = f0(x) + B(x) u``, so ``u_k`` is the least-squares
    solution of ``B(x_k) u = (x_{k+1} - x_k) / dt - f0(x_k)``. Least squares, because a plan need not be feasible and an
    underactuated robot has fewer controls than states: the residual is what no control could make (a sideways
    velocity of a unicycle, a position that runs ahead of its velocity), and with ``within_limits`` what the limits
    cut off as well. States count by their numbers, whatever their units; for the paper's robots that makes no
    difference, since no two of their controls act on the same states and those that one acts on share a unit.

    Args:
        dynamics: the robot; a learned one is in general not affine, its analytical model is.
        plans: states of every step.
        within_limits: whether the controls are clamped into the robot's limits. Where the columns of ``B`` are
            orthogonal, as for the paper's robots, no control within the limits leaves a smaller residual.

    Raises:
        UsageError: another shape, or a robot that is not affine in the control.
        NonFiniteError: a plan contains NaN or infinity.
    """
    n, m = dynamics.state_dim, dynamics.control_dim
    if plans.dim() < 2 or plans.shape[-1] != n or plans.shape[-2] < 2:
        raise UsageError(f"plans to invert must have shape (..., K+1, {n}), found {tuple(plans.shape)}")
    if not bool(torch.isfinite(plans).all()):
        raise NonFiniteError("a plan to invert contains NaN or infinity")
    x = plans[..., :-1, :].reshape(-1, n)
    slope = (plans[..., 1:, :] - plans[..., :-1, :]).reshape(-1, n) / dynamics.dt
    with torch.no_grad():
        idle = x.new_zeros(len(x), m)
        f0 = dynamics.derivative(x, idle)
        # B, (steps, n, m): of an affine map differences over any distance are the derivative.
        units = torch.eye(m).to(x)
        effect = torch.stack([dynamics.derivative(x, one.expand(len(x), -1)) - f0 for one in units], dim=-1)
        _require_affine(dynamics, x, f0, effect)
        u = torch.linalg.lstsq(effect, (slope - f0)[..., None]).solution[..., 0]
        if within_limits:
            u = torch.minimum(torch.maximum(u, dynamics.control_lower), dynamics.control_upper)
        residual = slope - dynamics.derivative(x, u)
    steps = plans[..., 1:, :].shape
    return Inverse(u.reshape(*steps[:-1], m), residual.reshape(steps))


def _require_affine(dynamics: Dynamics, x: Tensor, f0: Tensor, effect: Tensor) -> None:
    """Raise unless the affine map found about u = 0 also gives the derivative at the limits of the controls."""
    for u in (dynamics.control_lower, dynamics.control_upper):
        found, plane = dynamics.derivative(x, u.expand(len(x), -1)), f0 + effect @ u
        if not bool(((found - plane).abs() <= AFFINE * (1 + found.abs().amax())).all()):
            raise UsageError(
                f"{type(dynamics).__name__} has no inverse: its derivative is not affine in the control, "
                f"so a plan's controls cannot be recovered by least squares"
            )
