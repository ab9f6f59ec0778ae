"""What enclosing a network will cost a proof, as a term of its loss.

A network that predicts well on points may still be hopeless to enclose on boxes: thousands of plain updates make hidden
values large and their activations strongly curved, every neuron's relaxation error is added up, and the tube of a loop
explodes that would be thin. This term is the relaxation error of forward affine arithmetic, in float32 and with
relaxations from a few points: a differentiable guess that teaches, no enclosure.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from sagemp_cli.dynamics.learned import ACTIVATIONS

_POINTS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_SMALL = 1e-6


def enclosure_error(layers: Sequence[nn.Linear], activation: str, center: Tensor, radius: Tensor) -> Tensor:
    """Radius ``(..., out)`` that relaxing the activations adds to a perceptron's outputs over boxes ``(..., in)``."""
    function, inputs = ACTIVATIONS[activation], radius.shape[-1]
    spread = torch.diag_embed(radius)
    points = torch.tensor(_POINTS, dtype=center.dtype)
    for i, layer in enumerate(layers):
        if i > 0:
            reach = spread.abs().sum(-1)
            x = center[..., None] + reach[..., None] * points
            y = function(x)
            slope = (y[..., -1] - y[..., 0]) / (2 * reach + _SMALL)
            rest = y - slope[..., None] * x
            low, high = rest.amin(-1), rest.amax(-1)
            center = slope * center + (low + high) / 2
            spread = torch.cat([slope[..., None] * spread, torch.diag_embed((high - low) / 2)], dim=-1)
        center, spread = nn.functional.linear(center, layer.weight, layer.bias), layer.weight @ spread
    return spread[..., inputs:].abs().sum(-1)
