"""Affine arithmetic in plain float64, for the price of rigour: the propagator without its account of rounding.

It knows the operations of the benchmark's loops only, and its tubes prove nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import sagemp_cli.reachability.relaxed_operations  # noqa: F401  (registers the relaxations)
from sagemp_cli.reachability.form import Form, Operation, registers
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box, Tube


class PlainForm(Form):
    """``center + sum_i coefficients_i z_i``; variables first, as in the propagator's form."""

    __slots__ = ("center", "coefficients", "frame")

    def __init__(self, frame: _Frame, center: Tensor, coefficients: Tensor) -> None:
        self.frame, self.center, self.coefficients = frame, center, coefficients

    @property
    def shape(self) -> torch.Size:
        return self.center.shape

    def dim(self) -> int:
        return self.center.dim()

    def _rows(self) -> Tensor:
        batch = self.frame.batch
        return self.coefficients.reshape(self.coefficients.shape[0], *batch, -1).movedim(0, -1)

    def spread(self) -> Tensor:
        """Rows in terms of all symbols, ``(*batch, events, symbols)``."""
        rows, generators = self._rows(), self.frame.generators
        n = generators.shape[-2]
        own = rows[..., n:] * self.frame.own_radius[: rows.shape[-1] - n]
        return torch.cat([rows[..., :n] @ generators, own], dim=-1)

    def radius(self) -> Tensor:
        rows, generators = self._rows(), self.frame.generators
        n = generators.shape[-2]
        own = (rows[..., n:].abs() * self.frame.own_radius[: rows.shape[-1] - n]).sum(-1)
        return ((rows[..., :n] @ generators).abs().sum(-1) + own).reshape(self.shape)

    def relaxed(self, name: str, operation: Operation, *parameters: Any) -> PlainForm:
        radius = self.radius()
        slope, offset, error = operation.band(self.center - radius, self.center + radius, *parameters)
        return self.with_fresh(self.center * slope + offset, self.coefficients * slope, error)

    def with_fresh(self, center: Tensor, coefficients: Tensor, radius: Tensor) -> PlainForm:
        """One new variable per entry."""
        frame, batch = self.frame, len(self.frame.batch)
        events = math.prod(center.shape[batch:])
        fresh = center.new_zeros(frame.size - coefficients.shape[0] + events, *center.shape)
        if center.dim() == batch:
            fresh[-1] = radius
        else:
            fresh[-events:].flatten(batch + 1).diagonal(dim1=0, dim2=-1).copy_(radius.flatten(batch))
        frame.size += events
        return PlainForm(frame, center, torch.cat([coefficients, fresh]))

    def __getitem__(self, index: Any) -> PlainForm:
        index = index if isinstance(index, tuple) else (index,)
        return PlainForm(self.frame, self.center[index], self.coefficients[(slice(None), *index)])


class _Frame:
    def __init__(self, generators: Tensor, disturbance_radius: Tensor) -> None:
        self.generators, self.batch = generators, generators.shape[:-2]
        self.own_radius = torch.cat([disturbance_radius, disturbance_radius.new_ones(256)])
        self.size = generators.shape[-2] + disturbance_radius.shape[-1]

    def inputs(self, center: Tensor, w_center: Tensor) -> tuple[PlainForm, PlainForm]:
        n, d = center.shape[-1], w_center.shape[-1]
        eye = torch.eye(n + d, dtype=torch.float64).reshape(n + d, *[1] * len(self.batch), n + d)
        eye = eye.expand(n + d, *self.batch, n + d)
        return (
            PlainForm(self, center, eye[..., :n]),
            PlainForm(self, w_center.expand(*self.batch, d), eye[..., n:]),
        )


PlainForm.handlers = {}
handles = registers(PlainForm.handlers)


def _padded(coefficients: Tensor, size: int) -> Tensor:
    gap = size - coefficients.shape[0]
    return coefficients if gap == 0 else torch.cat([coefficients, coefficients.new_zeros(gap, *coefficients.shape[1:])])


@handles(torch.add)
def add(a: Any, b: Any) -> PlainForm:
    if not isinstance(a, PlainForm):
        a, b = b, a
    if not isinstance(b, PlainForm):
        return PlainForm(a.frame, a.center + b, a.coefficients)
    size = max(a.coefficients.shape[0], b.coefficients.shape[0])
    return PlainForm(a.frame, a.center + b.center, _padded(a.coefficients, size) + _padded(b.coefficients, size))


@handles(torch.neg)
def negate(a: PlainForm) -> PlainForm:
    return PlainForm(a.frame, -a.center, -a.coefficients)


@handles(torch.mul)
def multiply(a: Any, b: Any) -> PlainForm:
    if not isinstance(a, PlainForm):
        a, b = b, a
    if not isinstance(b, PlainForm):
        return PlainForm(a.frame, a.center * b, a.coefficients * b)
    size = max(a.coefficients.shape[0], b.coefficients.shape[0])
    shape = torch.broadcast_shapes(a.shape, b.shape)
    x, y = (
        PlainForm(f.frame, f.center.expand(shape), _padded(f.coefficients, size).expand(size, *shape)) for f in (a, b)
    )
    rows_x, rows_y = x.spread(), y.spread()
    ratio = torch.sqrt(rows_y.abs().sum(-1) / rows_x.abs().sum(-1))[..., None]
    scaled_x, scaled_y = rows_x * ratio, rows_y / ratio
    high = 0.25 * (scaled_x + scaled_y).abs().sum(-1).square().reshape(shape)
    low = 0.25 * (scaled_x - scaled_y).abs().sum(-1).square().reshape(shape)
    coefficients = x.center * y.coefficients + y.center * x.coefficients
    return x.with_fresh(x.center * y.center + 0.5 * (high - low), coefficients, 0.5 * (high + low))


@handles(torch.div, torch.Tensor.__truediv__)
def divide(a: PlainForm, b: float) -> PlainForm:
    return PlainForm(a.frame, a.center / b, a.coefficients / b)


@handles(torch.nn.functional.linear)
def linear(x: PlainForm, weight: Tensor, bias: Tensor | None = None) -> PlainForm:
    apply = torch.nn.functional.linear
    return PlainForm(x.frame, apply(x.center, weight, bias), apply(x.coefficients, weight))


@handles(torch.stack)
def stack(values: Sequence[PlainForm], dim: int = -1) -> PlainForm:
    size = max(v.coefficients.shape[0] for v in values)
    return PlainForm(
        values[0].frame,
        torch.stack([v.center for v in values], dim),
        torch.stack([_padded(v.coefficients, size) for v in values], dim),
    )


@handles(torch.cat)
def cat(values: Sequence[PlainForm], dim: int = -1) -> PlainForm:
    size = max(v.coefficients.shape[0] for v in values)
    return PlainForm(
        values[0].frame,
        torch.cat([v.center for v in values], dim),
        torch.cat([_padded(v.coefficients, size) for v in values], dim),
    )


@torch.inference_mode()
def propagate(loop: Loop, start: Box, disturbance: Box) -> Tube:
    """The tube in plain float64."""
    center, generators = start.center, torch.diag_embed(start.radius)
    lowers, uppers = [start.lower], [start.upper]
    for k in range(loop.horizon):
        frame = _Frame(generators, disturbance.radius)
        after = loop.step(k, *frame.inputs(center, disturbance.center))
        center, generators = after.center, after.spread()
        radius = generators.abs().sum(-1)
        lowers.append(center - radius)
        uppers.append(center + radius)
    return Tube(torch.stack(lowers, -2), torch.stack(uppers, -2))
