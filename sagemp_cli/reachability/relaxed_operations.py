"""Which torch function uses which relaxation: one line per function."""

from __future__ import annotations

import torch

from sagemp_cli.reachability.affine_form import AffineForm, handles
from sagemp_cli.reachability.relaxations import leaky_relu as _leaky_relu
from sagemp_cli.reachability.relaxations import sine as _sine


@handles(torch.nn.functional.leaky_relu)
def leaky_relu(x: AffineForm, negative_slope: float = 0.01, inplace: bool = False) -> AffineForm:
    """Leaky ReLU."""
    return x.relaxed("leaky_relu", _leaky_relu.band(*x.bounds(), negative_slope))


@handles(torch.relu, torch.Tensor.relu, torch.nn.functional.relu)
def relu(x: AffineForm, inplace: bool = False) -> AffineForm:
    """ReLU."""
    return x.relaxed("relu", _leaky_relu.band(*x.bounds(), 0.0))


@handles(torch.sin, torch.Tensor.sin)
def sine(x: AffineForm) -> AffineForm:
    """Sine."""
    return x.relaxed("sin", _sine.sine_band(*x.bounds()))


@handles(torch.cos, torch.Tensor.cos)
def cosine(x: AffineForm) -> AffineForm:
    """Cosine."""
    return x.relaxed("cos", _sine.cosine_band(*x.bounds()))
