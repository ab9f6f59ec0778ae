"""The backward pass of CROWN over the steps that a forward pass recorded.

The forward pass writes the inputs of every nonlinear operation, and the next state, as ``center + coefficients @ v``
where the variables v are the deviations ``z`` of state and disturbance and one error
``e_j = y_j - (slope x_j + offset)`` per relaxed entry ``y_j = f(x_j)``, scaled to [-1, 1]. A linear functional (a
*row*) of the next state is then a functional of v. Backwards, in the reverse order of evaluation, each ``e_j`` is
replaced by a line over x_j, the upper or the lower one according to the sign of its coefficient; and x_j is a function
of earlier variables. What remains at the end of the step is a functional of ``z``, which is a row of the previous
state. With both lines parallel to the band this is affine arithmetic again; lines chosen by sign are what CROWN has
more.

Everything that does not depend on the rows is done once for all steps of equal structure: a replacement is one product
of the coefficients' positive and negative parts with a fixed matrix. Building these matrices and sweeping rows through
them share one layout of variables, which is why they share one (long) file.

Rounding. Each matrix has a column more, with the magnitudes ``|coefficients| |v|`` that pass through it. Their sum T
bounds every intermediate result, so a step errs by at most ``gamma T`` (Higham 2002, section 3.1; gamma from the
lengths of all sums), and that is added to the bound. The computed coefficients are taken as they are: what they differ
from the exact ones by is in it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sagemp_cli.reachability.affine_form import SAFETY, AffineForm, Relaxed
from sagemp_cli.reachability.relaxations.band import TINY, UNIT

_LINEAR = 1e-9  # a band this narrow, relative to the values, is rounding only
_LEAD = 2  # columns before the coefficients: what is gained, and the magnitude


class Product(NamedTuple):
    """Planes over a product's factors, see :func:`_tilted`. Upper bounds first, then lower ones, ``(*batch, 1, 2E)``.

    Attributes:
        tilts: what a plane may be tilted along, the difference M and the sum P, as coefficients
            ``(*batch, 2E, first)``.
        top: the plane's height when it is not tilted.
        free: the tilts up to ``free / 2`` cost only their square.
        size: the largest tilt.
        offset: from the product to its error as the forward pass counts it, rounding included.
        middle: size of that without rounding.
        magnitude, rounding: of the tilting variable, and what of it is rounding error.
    """

    tilts: Tensor
    top: Tensor
    free: Tensor
    size: Tensor
    offset: Tensor
    middle: Tensor
    magnitude: Tensor
    rounding: Tensor


class Replacement(NamedTuple):
    """How the error variables of one operation are replaced.

    Attributes:
        first, last: the columns of its variables.
        inverse: one over their scale, ``(*batch, 1, E)``.
        lines: from positive and negative parts of their coefficients to gain, magnitude and earlier coefficients,
            ``(*batch, 2E, 2 + first)``.
        input: the operation's input (and minus it) as such rows, ``(*batch, 2E, 2 + first)``; None for a product.
        chosen: the entries in ``input``: those where the function is not linear on the interval, in any cell or step;
            nothing is gained by bounding the others once more.
        product: planes instead of lines.
    """

    first: int
    last: int
    inverse: Tensor
    lines: Tensor
    input: Tensor | None
    chosen: Tensor | None = None
    product: Product | None = None


class Step(NamedTuple):
    """One step, ready for rows.

    Attributes:
        output: the next state's deviation from its centre in terms of all variables, ``(*batch, 2n, 2 + variables)``.
        replacements: in the order of evaluation; the disturbance is the first.
        shape: the ellipsoid that stands for the state set where a guess is enough, ``(*batch, n, n)``.
        own: radii of the other variables.
        rounding: relative rounding error of the step's sums.
    """

    output: Tensor
    replacements: tuple[Replacement, ...]
    shape: Tensor
    own: Tensor
    rounding: float


@dataclass(frozen=True)
class Bounds:
    """What a backward pass found.

    Attributes:
        state: ``(lower, upper)`` of the deviations of the states from their centres per target step,
            ``(*batch, targets, n)``.
        inputs: the same of each operation's input, per target step and operation, ``(*batch, E)``; None where unknown.
    """

    state: tuple[Tensor, Tensor]
    inputs: list[list[tuple[Tensor, Tensor] | None]]

    def intersected(self, other: Bounds) -> Bounds:
        """What holds if both hold."""

        def both(a: Any, b: Any) -> Any:
            return None if a is None else (torch.maximum(a[0], b[0]), torch.minimum(a[1], b[1]))

        inputs = [
            [both(a, b) for a, b in zip(*step, strict=True)] for step in zip(self.inputs, other.inputs, strict=True)
        ]
        return Bounds(both(self.state, other.state), inputs)


def compiled(steps: Sequence[AffineForm]) -> list[Step]:
    """The recorded steps, ready for rows; equal structures are stacked, so that lines are found in one call for all."""
    parts: list[Step] = []
    for _, group in itertools.groupby(steps, key=_structure):
        parts += _compile(list(group))
    return parts


def backward(steps: Sequence[Step], radius: Tensor, *, targets: range, inputs: bool = False) -> Bounds:
    """Bounds of the states after the target steps (and of all operations' inputs in these steps) over the start box.

    Two sweeps, one with tilted and one with level planes over products; neither is always the better one.

    Args:
        steps: from :func:`compiled`, step 0 first.
        radius: of the start box, ``(*batch, n)``.
        targets: the steps whose results are bounded.
        inputs: whether the operations' inputs are bounded too.
    """
    level = _swept(steps, radius, targets, inputs, False)
    if all(r.product is None for step in steps for r in step.replacements):
        return level
    return level.intersected(_swept(steps, radius, targets, inputs, True))


def _swept(steps: Sequence[Step], radius: Tensor, targets: range, inputs: bool, tilted: bool) -> Bounds:
    """All targets go back in one sweep; a target joins when the sweep comes by."""
    n = radius.shape[-1]
    rows = radius.new_zeros(*radius.shape[:-1], 0, 1 + n)
    unit = torch.cat([torch.eye(n), -torch.eye(n)]).to(rows)
    unit = torch.cat([unit.new_zeros(2 * n, 1), unit], dim=-1).expand(*radius.shape[:-1], -1, -1)
    joined: list[tuple[int, int, int]] = []  # step, operation (-1: the state), rows
    for k in range(targets.stop - 1, -1, -1):
        step = steps[k]
        if k in targets:
            rows = torch.cat([rows, unit], dim=-2)
            joined.append((k, -1, 2 * n))
        constant = rows[..., :1]
        values = _split(rows[..., 1:]) @ step.output
        for i in range(len(step.replacements) - 1, -1, -1):
            r = step.replacements[i]
            parts = _split(values[..., _LEAD + r.first : _LEAD + r.last] * r.inverse)
            values = values[..., : _LEAD + r.first]
            if tilted and r.product is not None:
                values = values + _tilted(parts, r.product, _likely(values[..., _LEAD:], step))
            else:
                values = values + parts @ r.lines
            if inputs and k in targets and r.input is not None:
                values = torch.cat([values, r.input], dim=-2)
                constant = torch.cat([constant, constant.new_zeros(*r.input.shape[:-1], 1)], dim=-2)
                joined.append((k, i - 1, r.input.shape[-2]))
        gain = values[..., :1] + (step.rounding * values[..., 1:2] + TINY)
        constant = constant + gain
        constant = constant + (constant.abs() + gain.abs()) * (4 * UNIT)
        rows = torch.cat([constant, values[..., _LEAD:]], dim=-1)
    reach = rows[..., 1:].abs() @ radius[..., None]
    upper = rows[..., 0] + reach[..., 0] * (1.0 + (2 * n + 8) * UNIT)
    upper = upper + (upper.abs() + reach[..., 0]) * (4 * UNIT)
    upper = torch.nan_to_num(upper, nan=math.inf, posinf=math.inf, neginf=math.inf)
    return _collected(upper, joined, targets, steps)


def _split(rows: Tensor) -> Tensor:
    """Positive and negative parts side by side, both not negative."""
    return torch.cat([rows.clamp(min=0.0), (-rows).clamp(min=0.0)], dim=-1)


def _likely(rows: Tensor, step: Step) -> Tensor:
    """About where in the step's variables the rows are largest; a guess: the state set is taken for an ellipsoid."""
    n = step.shape.shape[-1]
    state, own = rows[..., :n], rows[..., n:]
    ahead = state @ step.shape
    length = (ahead * state).sum(-1, keepdim=True).sqrt() + TINY
    return torch.cat([ahead / length, torch.sign(own) * step.own[..., : own.shape[-1]]], dim=-1)


def _tilted(parts: Tensor, product: Product, likely: Tensor) -> Tensor:
    """What replaces the error of a product ``X Y``: a plane, tilted so that it is low where the row is large.

    ``X Y = (P^2 - M^2) / 4`` with ``|P| <= p``, ``|M| <= m`` and ``|P| + |M| <= 2 s``. For every tilt ``|a| <= s`` the
    excess over ``a M`` is at most ``p^2 / 4 + a^2`` if ``2 |a| <= q = min(m, 2 s - p)``, and
    ``p^2 / 4 - q^2 / 4 + |a| q`` otherwise: ``P^2`` is at its largest for ``|M| <= 2 s - p``, and beyond that the
    boundary ``|P| = 2 s - |M|`` makes the excess linear, falling outwards. For independent factors (p = m = 2 s) and
    ``a = +-s`` these are McCormick's planes, for ``a = 0`` the band of affine arithmetic. Below it is the same with P
    and M exchanged.
    """
    star = torch.nan_to_num(likely @ product.tilts.mT)
    inside = star.abs() <= product.free
    tilt = torch.where(inside, -0.5 * star, -torch.sign(star) * product.size)
    steep = tilt.abs()
    cost = torch.where(2 * steep <= product.free, steep * steep, (steep - 0.25 * product.free) * product.free)
    weights = parts * tilt
    height = parts * ((product.top + cost) * (1.0 + 16 * UNIT))
    through = weights.abs() * product.magnitude
    gain = (height + parts * product.offset + weights.abs() * product.rounding).sum(-1, keepdim=True)
    passed = (height + parts * product.middle + through).sum(-1, keepdim=True)
    return torch.cat([gain, passed, weights @ product.tilts], dim=-1)


def _collected(upper: Tensor, joined: list[tuple[int, int, int]], targets: range, steps: Sequence[Step]) -> Bounds:
    """Upper bounds of rows and of minus the rows, as lower and upper bounds by step and operation."""
    states: list[Any] = [None] * len(targets)
    inputs: list[list[Any]] = [[None] * (len(steps[k].replacements) - 1) for k in targets]
    pieces = upper.split([count for *_, count in joined], dim=-1)
    for (k, i, _), piece in zip(joined, pieces, strict=True):
        high, low = piece.chunk(2, dim=-1)
        if i < 0:
            states[k - targets.start] = (-low, high)
        else:
            r = steps[k].replacements[i + 1]
            unknown = high.new_full((*high.shape[:-1], r.last - r.first), math.inf)
            inputs[k - targets.start][i] = (
                (-unknown).index_copy(-1, r.chosen, -low),
                unknown.index_copy(-1, r.chosen, high),
            )
    lower, higher = (torch.stack(side, dim=-2) for side in zip(*states, strict=True))
    return Bounds((lower, higher), inputs)


def _structure(after: AffineForm) -> Any:
    """Equal for steps that can be stacked."""

    def known(parameter: Any) -> Any:
        return ("tensor", id(parameter)) if isinstance(parameter, Tensor) else parameter

    return (
        after.coefficients.shape,
        tuple(
            (r.name, r.first, r.coefficients.shape, r.error, r.operation, tuple(map(known, r.parameters)))
            for r in after.frame.relaxations
        ),
    )


def _compile(steps: list[AffineForm]) -> Iterator[Step]:
    """Steps of one structure."""
    frame = steps[0].frame
    batch, n, inputs = frame.batch, frame.states, frame.inputs
    stacked = [
        _replacement(list(group), batch, len(steps))
        for group in zip(*(s.frame.relaxations for s in steps), strict=True)
    ]
    first = torch.stack([s.frame.disturbance_radius for s in steps])
    first = first.reshape(len(steps), *[1] * len(batch), inputs - n).expand(len(steps), *batch, inputs - n)
    stacked.insert(0, _kept(first, n))
    output = _rows(steps, batch)
    carried = torch.stack([s.rounding() for s in steps]).flatten(1 + len(batch))
    output = _signed(carried, _stack(steps, "magnitude", batch), output)
    # Every product of a step is a sum of twice its entries; 8 more for the factors and for joining it to the rest.
    lengths = [2 * n + 8, *(2 * (r.last - r.first) + 8 for r in stacked)]
    rounding = sum(lengths) * UNIT * SAFETY
    for k in range(len(steps)):
        yield Step(
            output[k],
            tuple(_at(r, k) for r in stacked),
            steps[k].frame.ellipsoid,
            steps[k].frame.own_radius(frame.size - n),
            rounding,
        )


def _at(stacked: Replacement, k: int) -> Replacement:
    """The k-th of stacked replacements."""
    first, last, inverse, lines, own, chosen, product = stacked
    planes = None if product is None else Product(*(part[k] for part in product))
    return Replacement(first, last, inverse[k], lines[k], None if own is None else own[k], chosen, planes)


def _kept(radius: Tensor, first: int) -> Replacement:
    """Variables that are known only to lie in ``[-radius, radius]``."""
    entries = radius.shape[-1]
    lines = radius.new_zeros(*radius.shape[:-1], 2 * entries, _LEAD + first)
    lines[..., :_LEAD] = torch.cat([radius, radius], dim=-1)[..., None]
    return Replacement(first, first + entries, torch.ones_like(radius)[..., None, :], lines, None)


def _replacement(group: list[Relaxed], batch: torch.Size, steps: int) -> Replacement:
    """One operation in all steps."""
    r = group[0]
    magnitude = _stack(group, "magnitude", batch)
    radius = _stack(group, "radius", batch, like=magnitude)
    if r.operation is None:
        kept = _kept(torch.ones_like(radius), r.first)
        if r.factors is None:
            return kept
        # Lines in units of the error itself, as for planes.
        return kept._replace(
            inverse=(1.0 / radius)[..., None, :],
            lines=kept.lines * torch.cat([radius, radius], dim=-1)[..., None],
            product=_planes(group, batch, magnitude),
        )
    error, coefficients = r.error, _rows(group, batch)
    missing = r.first - coefficients.shape[-1]
    coefficients = torch.nn.functional.pad(coefficients, (0, missing))
    center = _stack(group, "center", batch)
    slope, offset, _ = (
        torch.stack([q.band[part].expand(q.radius.shape) for q in group]).reshape(radius.shape) for part in range(3)
    )
    below, low, above, high = _lines(group, radius.shape)
    # The band's error as a function of x: what the input's own rounding does to it is in the last term.
    own = (slope.abs() * magnitude + offset.abs() + radius) * ((error + 8 * UNIT) * SAFETY)

    def relative(line_slope: Tensor, line_offset: Tensor, sign: float) -> tuple[Tensor, Tensor]:
        tilt = line_slope - slope
        value = tilt * center + (line_offset - offset)
        doubt = tilt.abs() * magnitude * ((error + 8 * UNIT) * SAFETY)
        doubt = doubt + (line_offset.abs() + offset.abs()) * (8 * UNIT) + own + TINY
        tilt, value = (torch.where(torch.isfinite(value), part, 0.0) for part in (tilt, sign * value + doubt))
        return sign * tilt, torch.where(torch.isfinite(line_offset), value, radius)

    (up, above_value), (down, below_value) = relative(above, high, 1.0), relative(below, low, -1.0)
    tilt, value = torch.cat([up, down], dim=-1), torch.cat([above_value, below_value], dim=-1)
    twice = torch.cat([magnitude, magnitude], dim=-1)
    lead = torch.stack([value, tilt.abs() * twice + value.abs()], dim=-1)
    lines = torch.cat([lead, tilt[..., None] * torch.cat([coefficients, coefficients], dim=-2)], dim=-1)
    carried = magnitude * (error * SAFETY)
    chosen = (radius > _LINEAR * (slope.abs() * magnitude + offset.abs())).flatten(0, -2).any(0).nonzero()[:, 0]
    return Replacement(
        r.first,
        r.first + radius.shape[-1],
        (1.0 / radius)[..., None, :],
        lines,
        _signed(carried[..., chosen], magnitude[..., chosen], coefficients[..., chosen, :]),
        chosen,
    )


def _planes(group: list[Relaxed], batch: torch.Size, magnitude: Tensor) -> Product:
    """A product in all steps."""
    r, factors = group[0], [q.factors for q in group]
    plus, minus, size, middle, carried = (
        _stack(factors, name, batch) for name in ("plus", "minus", "size", "middle", "magnitude")
    )
    sums, differences = (_rows(factors, batch, name) for name in ("sum", "difference"))
    tilts = torch.cat([differences, sums], dim=-2)
    own = magnitude * ((2 * r.error + 24 * UNIT) * SAFETY)
    twice = torch.cat([carried, carried], dim=-1)

    def both(upper: Tensor, lower: Tensor) -> Tensor:
        return torch.cat([upper, lower], dim=-1)[..., None, :]

    return Product(
        tilts=torch.nn.functional.pad(tilts, (0, r.first - tilts.shape[-1])),
        top=0.25 * both(plus * plus, minus * minus),
        free=both(torch.minimum(minus, 2 * size - plus), torch.minimum(plus, 2 * size - minus)).clamp(min=0.0),
        size=both(size, size),
        offset=both(own - middle, own + middle),
        middle=both(middle.abs(), middle.abs()),
        magnitude=twice[..., None, :],
        rounding=twice[..., None, :] * ((r.error + 8 * UNIT) * SAFETY),
    )


def _lines(group: list[Relaxed], shape: torch.Size) -> Iterator[Tensor]:
    """The operation's lines in all steps, found in one call."""
    r = group[0]
    lower, upper = torch.stack([q.lower for q in group]), torch.stack([q.upper for q in group])
    return (part.reshape(shape) for part in r.operation.lines(lower, upper, *r.parameters))


def _signed(carried: Tensor, magnitude: Tensor, coefficients: Tensor) -> Tensor:
    """Rows for entries and for minus the entries: error carried, magnitude, coefficients."""
    lead = torch.stack([carried, magnitude], dim=-1)
    return torch.cat([torch.cat([lead, coefficients], dim=-1), torch.cat([lead, -coefficients], dim=-1)], dim=-2)


def _stack(group: Sequence[Any], name: str, batch: torch.Size, like: Tensor | None = None) -> Tensor:
    """One attribute of all steps, ``(steps, *batch, entries)``."""
    stacked = torch.stack([getattr(q, name) for q in group])
    return stacked.reshape(len(group), *batch, -1)


def _rows(group: Sequence[Any], batch: torch.Size, name: str = "coefficients") -> Tensor:
    """Coefficients of all steps, ``(steps, *batch, entries, variables)``."""
    stacked = torch.stack([getattr(q, name) for q in group], dim=1)
    return stacked.reshape(stacked.shape[0], len(group), *batch, -1).movedim(0, -1)
