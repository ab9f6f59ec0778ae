"""Whether a recorded program does what the step does, to the last roundings, where a difference would show.

The program is evaluated in interval arithmetic at points, which encloses its exact value there; what the step computes
may lie outside by some widths of that interval, which is the size of what rounding does to it. Compared are chosen
points, not all: what is proved is proved of the program.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
from sagemp_cli.reachability.program.kinds import FLOAT32
from sagemp_cli.reachability.program.probing import IN_FLOAT32, TOLERANCE, Step
from sagemp_cli.reachability.program.program import Instruction, Program
from sagemp_cli.sets import Box

ROUNDINGS = 16
"""Widths of the interval of a point that the step's own result may lie outside."""

MOST_POINTS = {True: 4096, False: 256}
"""Points at most in one comparison: of steps that take batches, of steps that take single states."""

_KINKS, _STARTS, _NEWTON = 32, 4, 4
_AROUND = (0.0, 1e-3, -1e-3, 0.1, -0.1, 1.0, -1.0)


def compare(
    step: Step,
    k: int | Tensor,
    program: Program,
    x: Tensor,
    w: Tensor,
    after: Tensor | None = None,
    numbers: Tensor | None = None,
) -> None:
    """Refuse a step that differs from its program at states ``(B, n)`` and disturbances ``(B, d)``.

    Where there are more points than :data:`MOST_POINTS`, every so many is taken. Points where the step gives no finite
    result are left out; where the interval is infinite, a relative tolerance of 1e-9 stands in (1e-4 in float32).

    Args:
        k: number of the step; one for each point where the next states are known.
        after: the next states, if they are known.
        numbers: that the program has at this step, ``(g,)``, or at each point's, ``(B, g)``.
    """
    if not len(x):
        return
    ks = torch.as_tensor(k).expand(len(x))
    own = torch.zeros(0, dtype=torch.float64) if numbers is None else numbers
    own = own.expand(len(x), -1)
    if after is None:
        every = max(1, -(-len(x) // MOST_POINTS[step.rowwise]))
        x, w, own, ks = x[::every], w[::every], own[::every], ks[::every]
        with torch.no_grad():
            after = step.all(int(ks[0]), x, w)
    known = torch.isfinite(after).all(-1)
    x, w, after, own, ks = x[known], w[known], after[known], own[known], ks[known]
    if not len(x):
        return
    with torch.no_grad():
        low, high = program.run(*(IntervalForm(v, v) for v in (x, w, own)), evaluate=evaluate).next.bounds
        slack = ROUNDINGS * ((high - low) + 2.0**-52 * after.abs())
        off = (after < low - slack) | (after > high + slack)
        loose = ~torch.isfinite(slack)
        if bool(loose.any()):
            plain = program.run(x, w, own).next.expand(after.shape)
            close = IN_FLOAT32 if any(kind in FLOAT32 for kind in program.kinds) else TOLERANCE
            off = torch.where(loose, ~((after - plain).abs() <= close * (1.0 + after.abs())), off)
    if bool(off.any()):
        row, i = torch.nonzero(off)[0].tolist()
        k = int(ks[row])
        if step.rowwise and not step.batched:
            with torch.no_grad():
                alone = step.at(k, x[row], w[row])
            if bool(((alone >= low[row] - slack[row]) & (alone <= high[row] + slack[row])).all()):
                raise UsageError(
                    f"step means one thing for a state of shape ({x.shape[-1]},) and another for a batch (at x = "
                    f"{x[row].tolist()}, w = {w[row].tolist()}); say which is meant with batched=False or batched=True"
                )
        raise UsageError(
            f"step does not always do the same: at step {k} it differs from what it did when it was recorded (x = "
            f"{x[row].tolist()}, w = {w[row].tolist()}: state {i} becomes {after[row, i].item():.17g}, recorded "
            f"{(low[row, i] + high[row, i]).item() / 2:.17g}); it must be a function of x and w only, in torch "
            f"operations"
        )


def corners_and_centres(cells: Box, disturbance: Box, *, most: int) -> tuple[Tensor, Tensor]:
    """Points ``(B, n)``, ``(B, d)``: the centre and corners of each cell ``(C, n)``, together with the disturbances'.

    Corners of many dimensions, and cells beyond ``most`` points, are drawn at random with a fixed seed.
    """
    generator = torch.Generator().manual_seed(2)
    both = Box(
        torch.cat([cells.lower, disturbance.lower.expand(len(cells.lower), -1)], -1),
        torch.cat([cells.upper, disturbance.upper.expand(len(cells.lower), -1)], -1),
    )
    dims = both.dim
    if dims <= 6:
        upper = torch.tensor(list(itertools.product([False, True], repeat=dims)))
    else:
        upper = torch.rand(64, dims, generator=generator) < 0.5
        upper[0], upper[1] = False, True
    kept = max(1, most // (len(upper) + 1))
    if len(both.lower) > kept:
        chosen = torch.randperm(len(both.lower), generator=generator)[:kept]
        both = Box(both.lower[chosen], both.upper[chosen])
    corners = torch.where(upper, both.upper[:, None], both.lower[:, None]).flatten(0, 1)
    x, w = torch.cat([both.center, corners]).split([cells.dim, disturbance.dim], dim=-1)
    return x, w


def _gaps(i: Instruction, values: Sequence[Tensor]) -> list[Tensor]:
    """How far values are from where an instruction has its kinks."""
    if i.kind in ("relu", "leaky_relu", "abs", "elu", "sign", "positive", "softsign"):
        return [values[0]]
    if i.kind == "hardswish":
        return [values[0] - 3.0, values[0] + 3.0]
    if i.kind in ("maximum", "minimum"):
        return [values[0] - values[1]]
    limits = i.constants if i.kind == "clamp" else ()
    return [values[0][..., finite] - limit[finite] for limit in limits if (finite := torch.isfinite(limit)).any()]


@torch.enable_grad()  # whoever calls may have switched it off
def near_kinks(program: Program, numbers: Tensor, start: Box, disturbance: Box) -> tuple[Tensor, Tensor]:
    """Points ``(B, n)``, ``(B, d)`` of the boxes at and beside the thresholds of the program's clamps, relus and so on.

    Newton's method on the distance to each threshold (at most 32, from 4 points each) finds them.
    """
    both = Box(torch.cat([start.lower, disturbance.lower]), torch.cat([start.upper, disturbance.upper]))
    sizes = [start.dim, disturbance.dim]

    def gaps(z: Tensor) -> Tensor | None:
        found: list[Tensor] = []

        def noted(i: Instruction, values: Sequence[Tensor]) -> Tensor:
            found.extend(gap for gap in _gaps(i, values) if gap.requires_grad)
            return i.on(*values)

        x, w = z.split(sizes, dim=-1)
        program.run(x, w, numbers, evaluate=noted)
        return torch.cat(found, -1) if found else None

    z = both.sample(_STARTS, torch.Generator().manual_seed(3)).requires_grad_(True)
    first = gaps(z)
    if first is None:
        return torch.zeros(0, sizes[0], dtype=torch.float64), torch.zeros(0, sizes[1], dtype=torch.float64)
    columns = torch.arange(0, first.shape[1], -(-first.shape[1] // _KINKS))
    z, own = z.detach().repeat(len(columns), 1), columns.repeat_interleave(_STARTS)[:, None]
    towards = torch.zeros_like(z)
    for _ in range(_NEWTON):
        z = z.requires_grad_(True)
        gap = gaps(z)
        assert gap is not None
        gap = gap.gather(1, own)
        (slope,) = torch.autograd.grad(gap.sum(), z)
        towards = torch.nan_to_num(slope / slope.square().sum(-1, keepdim=True))
        z = _inside(z.detach() - gap.detach() * towards, both)
    points = torch.cat([_inside(z + around * towards, both) for around in _AROUND])
    x, w = points.split(sizes, dim=-1)
    return x, w


def _inside(z: Tensor, box: Box) -> Tensor:
    return torch.nan_to_num(torch.minimum(torch.maximum(z, box.lower), box.upper))


def climbed(step: Step, program: Program, numbers: Tensor, start: Box, disturbance: Box) -> tuple[Tensor, Tensor]:
    """Points reached by gradient ascent on the difference of step and program; none if the step has no gradient."""
    both = Box(torch.cat([start.lower, disturbance.lower]), torch.cat([start.upper, disturbance.upper]))
    sizes = [start.dim, disturbance.dim]
    z = both.sample(16 if step.rowwise else 4, torch.Generator().manual_seed(4))
    visited = [z]
    for _ in range(4):
        z = z.detach().requires_grad_(True)
        try:
            with torch.enable_grad():
                x, w = z.split(sizes, dim=-1)
                difference = step.differentiable(0, x, w) - program.run(x, w, numbers).next
                (slope,) = torch.autograd.grad(difference.square().sum(), z)
        except (RuntimeError, UsageError):
            return torch.zeros(0, sizes[0], dtype=torch.float64), torch.zeros(0, sizes[1], dtype=torch.float64)
        z = _inside(z.detach() + 0.25 * both.width * torch.sign(torch.nan_to_num(slope)), both)
        visited.append(z)
    x, w = torch.cat(visited).split(sizes, dim=-1)
    return x, w
