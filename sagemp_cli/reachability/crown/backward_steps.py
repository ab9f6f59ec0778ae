"""The steps that a forward pass recorded, made ready for a backward pass over them.

The forward pass writes the inputs of every nonlinear operation, and the next state, as ``center + coefficients @ v``
where the variables v are the deviations ``z`` of state and disturbance and one error
``e_j = y_j - (slope x_j + offset)`` per relaxed entry ``y_j = f(x_j)``, scaled to [-1, 1]. The backward pass
(:mod:`.crown.backward`) takes a linear functional (a *row*) of the next state, which is one of v, and
replaces each ``e_j`` by a line over x_j. All that this needs and that does not depend on the rows is found here, for
all steps of equal structure at once, with torch; what comes out are arrays, because the sweep works on arrays in place.

Errors of entries that are linear on their interval (most neurons, at most steps) are rounding only. They are no
variables here: wherever they come in, the sum of their coefficients' absolute values is added to the gain instead.

Layout. Every matrix maps the positive and negative parts of entries, side by side as columns, to a block of rows: the
gain, the magnitude, and the coefficients of the variables before. Cells come first.

Longer than other files, since whoever reads one of these matrices has to know how the others are laid out.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.operations import Relaxed, Value
from sagemp_cli.reachability.affine.compiled.steps import KeptStep
from sagemp_cli.sets.rounding import SAFETY, TINY, at_least, gamma, slack

Array = np.ndarray

LINEAR = 1e-9
"""A band this narrow, relative to the values, is rounding only."""

LEAD = 2
"""Rows before the coefficients: what is gained, and the magnitude."""


class Product(NamedTuple):
    """Planes over a product's factors, see :func:`~.crown.backward._tilted`. Upper bounds first, then
    lower ones, ``(B, 2E, 1)``.

    Attributes:
        tilts: what a plane may be tilted along, the difference M and the sum P, as coefficients ``(B, 2E, first)``.
        likely: the same of the state, times the ellipsoid that stands for the state set where a guess is enough,
            ``(B, 2E, n)``.
        top: the plane's height when it is not tilted.
        free: the tilts up to ``free / 2`` cost only their square.
        size: the largest tilt.
        offset: from the product to its error as the forward pass counts it, rounding included.
        middle: size of that without rounding.
        magnitude, rounding: of the tilting variable, and what of it is rounding error.
    """

    tilts: Array
    likely: Array
    top: Array
    free: Array
    size: Array
    offset: Array
    middle: Array
    magnitude: Array
    rounding: Array


class Inputs(NamedTuple):
    """Inputs of operations, to be bounded.

    Attributes:
        rows: of the inputs and of minus them, ``(B, 2 + first, 2C)``.
        operations: whose they are.
        entries: which of their entries, C numbers: those where the function is not linear on the interval; nothing is
            gained by bounding the others once more.
    """

    rows: Array
    operations: tuple[int, ...]
    entries: Array


class Replacement(NamedTuple):
    """How the error variables of one operation are replaced.

    Attributes:
        first, last: the rows of its variables, without the lead.
        radius: of variables that are known only to lie in ``[-radius, radius]``, ``(B, 1, E)``; of a product's, if its
            planes are level.
        inverse: of variables with lines or planes, one over their scale, ``(B, E, 1)``.
        lead: of lines, what they add to gain and magnitude, ``(B, 2, 2E)``.
        tilts: by how much the upper and the lower lines are steeper than the band, ``(2, B, E, 1)``.
        coefficients: of the operation's input, ``(B, first, E)``.
        product: planes instead of lines.
        inputs: the operation's, where they are not found with another's.
    """

    first: int
    last: int
    radius: Array | None = None
    inverse: Array | None = None
    lead: Array | None = None
    tilts: Array | None = None
    coefficients: Array | None = None
    product: Product | None = None
    inputs: Inputs | None = None


class Step(NamedTuple):
    """One step, ready for rows.

    Attributes:
        output: the next state's deviation from its centre in terms of all variables, ``(B, 2 + variables, 2n)``.
        replacements: in the order of evaluation; the disturbance is the first.
        shape: the ellipsoid that stands for the state set where a guess is enough, ``(B, n, n)``.
        own: radii of the other variables, ``(variables - n, 1)``.
        rounding: relative rounding error of the step's sums.
        entries: of each operation, ``(E,)`` of all.
    """

    output: Array
    replacements: tuple[Replacement, ...]
    shape: Array
    own: Array
    rounding: float
    entries: tuple[int, ...]


def ready(steps: Sequence[KeptStep]) -> list[Step]:
    """The recorded steps, ready for rows; equal structures are stacked, so that lines are found in one call for all."""
    parts: list[Step] = []
    for _, group in itertools.groupby(steps, key=_structure):
        parts += _ready(list(group))
    return parts


def _structure(step: KeptStep) -> Any:
    """Equal for steps that can be stacked."""

    def known(parameter: Any) -> Any:
        return ("tensor", id(parameter)) if isinstance(parameter, Tensor) else parameter

    def how(r: Relaxed) -> Any:
        if r.node is None or r.node.relaxation is None:
            return None
        return r.node.relaxation.operation, tuple(map(known, r.node.relaxation.parameters))

    return (
        step.after.coefficients.shape,
        tuple((r.name, r.first, r.form.coefficients.shape, r.form.error, how(r)) for r in step.relaxed),
    )


class _Stacked(NamedTuple):
    """One operation in all steps, as tensors ``(steps, B, ...)``.

    Attributes:
        first, last: its variables.
        kept: which of them are variables of the backward pass, ``(steps, E)``; None: all.
        radius, inverse: as for :class:`Replacement`, ``(..., E)``.
        lead, tilt, coefficients: of lines, ``(..., 2E, 2)``, of positive and then of negative parts ``(..., 2E)``, and
            ``(..., E, first)``.
        input: the operation's input, and minus it, as rows ``(..., 2E, 2 + first)``.
        tilts, planes: of a product, as for :class:`Product`; planes are ``(..., 2E)`` by name.
    """

    first: int
    last: int
    kept: Tensor | None = None
    radius: Tensor | None = None
    inverse: Tensor | None = None
    lead: Tensor | None = None
    tilt: Tensor | None = None
    coefficients: Tensor | None = None
    input: Tensor | None = None
    tilts: Tensor | None = None
    planes: dict[str, Tensor] | None = None


def _ready(steps: list[KeptStep]) -> Iterator[Step]:
    """Steps of one structure."""
    first, count = steps[0], len(steps)
    cells, n, _ = first.ellipsoid.shape
    own = first.own_radius
    added = sum(r.radius.shape[-1] for r in first.relaxed)
    radius = torch.from_numpy(own[: len(own) - added]).expand(count, 1, -1)
    stacked = [_Stacked(n, n + radius.shape[-1], radius=radius)]
    stacked += [_operation(list(group), cells) for group in zip(*(s.relaxed for s in steps), strict=True)]
    _, magnitude, coefficients = _forms([s.after for s in steps], cells, n + len(own))
    output = _signed(_stack([s.rounding for s in steps]), magnitude, coefficients)
    # Every product of a step is a sum of twice its entries, and what is no variable adds as many; 8 more for the
    # factors and for joining it to the rest.
    lengths = [4 * n + 8, *(4 * (s.last - s.first) + 8 for s in stacked)]
    shape = _stack([s.ellipsoid for s in steps])
    kept = torch.ones(count, n + len(own), dtype=torch.bool)
    for s in stacked:
        if s.kept is not None:
            kept[:, s.first : s.last] = s.kept
    variables = _Variables(kept)
    outputs = variables.condensed(output)
    shared = [_equal_inputs(*pair) for pair in itertools.pairwise(stacked)]
    parts = [
        _Part(s, variables, shape, found_before=before, found_after=after)
        for s, before, after in zip(stacked, [None, *shared], [*shared, None], strict=True)
    ]
    shapes = shape.numpy()
    for k in range(count):
        yield Step(
            outputs[k][:, variables.rows[k]],
            tuple(found for i, part in enumerate(parts) if (found := part.at(k, i - 1)) is not None),
            shapes[k],
            own[variables.index[k][n:] - n, None],
            gamma(sum(lengths)) * SAFETY,
            tuple(s.last - s.first for s in stacked[1:]),
        )


class _Variables:
    """Which variables the steps have.

    Attributes:
        kept: of all, ``(steps, variables)``.
        index: per step, their numbers among all.
        rows: the same of rows with a lead.
        before: how many of them come before each one of all, and how many there are, ``variables + 1`` numbers a step.
    """

    def __init__(self, kept: Tensor) -> None:
        self.kept = kept
        self.index = [np.flatnonzero(row) for row in kept.numpy()]
        self.rows = [np.concatenate([np.arange(LEAD), row + LEAD]) for row in self.index]
        self.before = torch.nn.functional.pad(kept.cumsum(-1), (1, 0)).tolist()

    def condensed(self, rows: Tensor) -> Array:
        """Rows ``(..., 2 + first)``, with what they have of no variables in their lead, as columns."""
        gone = self.gone(rows[..., LEAD:])[..., None]
        return torch.cat([rows[..., :LEAD] + gone, rows[..., LEAD:]], dim=-1).mT.contiguous().numpy()

    def gone(self, coefficients: Tensor) -> Tensor:
        """Bound of what coefficients ``(steps, B, rows, first)`` have of no variables, ``(steps, B, rows)``."""
        first = coefficients.shape[-1]
        some = torch.where(self.kept[:, None, None, :first], 0.0, coefficients.abs())
        return some.sum(-1) * at_least(first)


class _Part:
    """One operation in all steps, as arrays.

    Args:
        stacked: as tensors.
        variables: of the steps.
        shape: as for :class:`Step`, of all.
        found_before, found_after: at which steps its input is bounded with that of the operation before or after.
    """

    def __init__(
        self,
        stacked: _Stacked,
        variables: _Variables,
        shape: Tensor,
        *,
        found_before: Array | None,
        found_after: Array | None,
    ) -> None:
        self._stacked, self._variables = stacked, variables
        self._before, self._after = found_before, found_after
        self._radius = None if stacked.radius is None else stacked.radius[..., None, :].numpy()
        self._inverse = None if stacked.inverse is None else stacked.inverse[..., None].numpy()
        if stacked.lead is not None and stacked.tilt is not None and stacked.coefficients is not None:
            gone = variables.gone(stacked.coefficients)
            gone = (stacked.tilt.abs() * torch.cat([gone, gone], dim=-1))[..., None]
            self._lead = (stacked.lead + gone).mT.contiguous().numpy()
            self._tilt = torch.stack(stacked.tilt.chunk(2, dim=-1), dim=1)[..., None].numpy()
            self._coefficients = stacked.coefficients.mT.contiguous().numpy()
        self._input = None if stacked.input is None else variables.condensed(stacked.input)
        if stacked.tilts is not None and stacked.planes is not None:
            gone = variables.gone(stacked.tilts)
            planes = {name: part + gone if name in _OF_TILTS else part for name, part in stacked.planes.items()}
            self._planes = {name: part[..., None].numpy() for name, part in planes.items()}
            self._tilts = stacked.tilts.numpy()
            self._likely = (stacked.tilts[..., : shape.shape[-1]] @ shape).numpy()

    def at(self, k: int, operation: int) -> Replacement | None:
        """The operation, of that number, at step k; None if it has no variables there."""
        s, before, rows = self._stacked, self._variables.before[k], self._variables.rows[k]
        first, last = before[s.first], before[s.last]
        if first == last:
            return None
        if s.kept is None:
            radius = None if self._radius is None else self._radius[k]
            if s.tilts is None or self._inverse is None:
                return Replacement(first, last, radius)
            tilts = self._tilts[k][..., self._variables.index[k][:first]]
            planes = {name: part[k] for name, part in self._planes.items()}
            return Replacement(first, last, radius, self._inverse[k], product=Product(tilts, self._likely[k], **planes))
        assert self._inverse is not None and self._input is not None
        entries = np.flatnonzero(s.kept[k].numpy())
        twice = np.concatenate([entries, entries + (s.last - s.first)])
        inputs = None
        if self._before is None or not self._before[k]:
            both = self._after is not None and self._after[k]
            wanted = self._input[k][:, rows[: LEAD + first, None], twice]
            inputs = Inputs(wanted, (operation, operation + 1) if both else (operation,), entries)
        return Replacement(
            first,
            last,
            inverse=self._inverse[k][:, entries],
            lead=self._lead[k][..., twice],
            tilts=self._tilt[k][:, :, entries],
            coefficients=self._coefficients[k][:, self._variables.index[k][:first, None], entries],
            inputs=inputs,
        )


_OF_TILTS = ("magnitude", "rounding")


def _equal_inputs(a: _Stacked, b: _Stacked) -> Array | None:
    """At which steps two operations that follow one another have the same input, not linear in the same entries."""
    if a.input is None or b.input is None or a.kept is None or b.kept is None or a.kept.shape != b.kept.shape:
        return None
    width = a.input.shape[-1]
    if not torch.equal(a.input, b.input[..., :width]) or bool(b.input[..., width:].any()):
        return None
    return (a.kept == b.kept).all(-1).numpy()


def _operation(group: list[Relaxed], cells: int) -> _Stacked:
    """One operation in all steps."""
    r, radius = group[0], _stack([q.radius for q in group])
    last, error = r.first + radius.shape[-1], r.form.error
    center, magnitude, coefficients = _forms([q.form for q in group], cells, r.first)
    if r.factors is not None:
        tilts, planes = _planes(group, cells, magnitude)
        level = torch.ones_like(radius)
        return _Stacked(r.first, last, radius=level, inverse=1.0 / radius, tilts=tilts, planes=planes)
    slope, offset = (_stack([q.band[part] for q in group]).expand(radius.shape) for part in range(2))
    below, low, above, high = _lines(group)
    # The band's error as a function of x: what the input's own rounding does to it is in the last term.
    own = (slope.abs() * magnitude + offset.abs() + radius) * ((error + gamma(8)) * SAFETY)

    def relative(line_slope: Tensor, line_offset: Tensor, sign: float) -> tuple[Tensor, Tensor]:
        tilt = line_slope - slope
        value = tilt * center + (line_offset - offset)
        doubt = tilt.abs() * magnitude * ((error + gamma(8)) * SAFETY)
        doubt = doubt + slack(line_offset.abs() + offset.abs(), 8) + own + TINY
        tilt, value = (torch.where(torch.isfinite(value), part, 0.0) for part in (tilt, sign * value + doubt))
        return sign * tilt, torch.where(torch.isfinite(line_offset), value, radius)

    (up, above_value), (down, below_value) = relative(above, high, 1.0), relative(below, low, -1.0)
    tilt, value = torch.cat([up, down], dim=-1), torch.cat([above_value, below_value], dim=-1)
    twice = torch.cat([magnitude, magnitude], dim=-1)
    lead = torch.stack([value, tilt.abs() * twice + value.abs()], dim=-1)
    carried = magnitude * (error * SAFETY)
    linear = radius <= LINEAR * (slope.abs() * magnitude + offset.abs())
    return _Stacked(
        r.first,
        last,
        kept=~linear.all(1),
        inverse=1.0 / radius,
        lead=lead,
        tilt=tilt,
        coefficients=coefficients,
        input=_signed(carried, magnitude, coefficients),
    )


def _planes(group: list[Relaxed], cells: int, magnitude: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """A product in all steps: tilts, and the other attributes of :class:`Product` by name."""
    r, factors = group[0], [q.factors for q in group]
    plus, minus, size, middle, carried = (
        _stack([getattr(f, name) for f in factors]) for name in ("plus", "minus", "size", "middle", "magnitude")
    )
    sums, differences = (
        _stack([getattr(f, name) for f in factors]).expand(-1, cells, -1, -1) for name in ("sum", "difference")
    )
    tilts = torch.cat([differences, sums], dim=-2)
    own = magnitude * ((2 * r.form.error + gamma(24)) * SAFETY)

    def both(upper: Tensor, lower: Tensor) -> Tensor:
        return torch.cat([upper, lower], dim=-1)

    free = both(torch.minimum(minus, 2 * size - plus), torch.minimum(plus, 2 * size - minus)).clamp(min=0.0)
    return torch.nn.functional.pad(tilts, (0, r.first - tilts.shape[-1])), {
        "top": 0.25 * both(plus * plus, minus * minus),
        "free": free,
        "size": both(size, size),
        "offset": both(own - middle, own + middle),
        "middle": both(middle.abs(), middle.abs()),
        "magnitude": both(carried, carried),
        "rounding": both(carried, carried) * ((r.form.error + gamma(8)) * SAFETY),
    }


def _lines(group: list[Relaxed]) -> Iterator[Tensor]:
    """The operation's lines in all steps, found in one call."""
    (r, *_) = group
    assert r.node is not None and r.node.relaxation is not None
    _, operation, parameters = r.node.relaxation
    lower, upper = _stack([q.lower for q in group]), _stack([q.upper for q in group])
    given = (_stack(parts) for parts in zip(*(q.given for q in group), strict=True))
    return iter(operation.lines(lower, upper, *given, *parameters))


def _signed(carried: Tensor, magnitude: Tensor, coefficients: Tensor) -> Tensor:
    """Rows for entries and for minus the entries: error carried, magnitude, coefficients."""
    lead = torch.stack([carried, magnitude], dim=-1)
    return torch.cat([torch.cat([lead, coefficients], dim=-1), torch.cat([lead, -coefficients], dim=-1)], dim=-2)


def _stack(arrays: Sequence[Any]) -> Tensor:
    """One array of all steps, ``(steps, B, ...)``."""
    return torch.from_numpy(np.array(arrays))


def _forms(values: Sequence[Value], cells: int, variables: int) -> tuple[Tensor, Tensor, Tensor]:
    """Centres, magnitudes and coefficients of so many variables of all steps, ``(steps, B, entries, ...)``."""
    both = _stack([v.both for v in values])
    coefficients = _stack([v.coefficients for v in values])
    missing = variables - coefficients.shape[-1]
    return both[:, 0], both[:, 1], torch.nn.functional.pad(coefficients, (0, missing)).expand(-1, cells, -1, -1)
