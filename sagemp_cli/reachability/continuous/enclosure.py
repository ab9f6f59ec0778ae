"""What a flow does within a part of a period, by intervals: where it stays, and what its Taylor polynomial leaves out.

``docs/continuous_time.md`` derives all bounds and proves them. Of a part of length h that begins in a box B, with
controls in U and ``r_W`` the radius of W:

- ``X`` contains every solution if ``B + [0, h] (f(X, U) + W)`` lies in X (Picard and Lindelöf's operator).
- With ``A >= |Df|`` on X and U, ``e >= A (3/4 h^2 r_W + h e)`` bounds, at all times, how far a solution under ``w(t)``
  is from the one under the mean a of w, but for what they differ by because the integrals of both w do.
- With ``D`` the width of the bounds of Df, at the end of the part it is at most ``g = D 3/4 h^2 r_W + h A e``.
- The remainder lies in ``h^{p+1} c_{p+1}(X, U, W) + [-g, g]``.

Where a control before may be in force at first, both e and g are larger by what that moves (:class:`Held`).

Everything is for all parts of all periods and cells at once, and rounded outwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.reachability.continuous.expansion import Expansion
from sagemp_cli.reachability.interval.form import IntervalForm, evaluate_arrays, run_on_arrays
from sagemp_cli.reachability.program.program import Instruction, Outputs, Program
from sagemp_cli.reachability.relaxations.sawtooth import within_a_period
from sagemp_cli.sets import Box, round_down, round_up
from sagemp_cli.sets.rounding import TINY

_ROUNDS = 12
"""Attempts to find a box that a flow does not leave."""
_GROWTH = 0.1
"""Share of its own width that an attempt is widened by."""


@dataclass(frozen=True)
class Held:
    """Of N parts, what is known of the control that was before; where it is not in force, all of it is 0.

    Attributes:
        control: p and u in one box, ``(N, m)``; u alone where p is not in force.
        less: p - u, ``(N, m)``.
        jump: bound of ``|f(x, p) - f(x, u)|`` where the part begins, ``(N, n)``.
        most: bound of the share of the part that p is in force for, ``(N, 1)``.
        weight: the most that the jump may have in a mean of what moves the state, ``(N, 1)``.
        swing: see :attr:`~sagemp_cli.reachability.continuous.lagging.Shares.swing`, ``(N, 1)``.
    """

    control: IntervalForm
    less: IntervalForm
    jump: Tensor
    most: Tensor
    weight: Tensor
    swing: Tensor


@dataclass(frozen=True)
class Enclosure:
    """Of N parts; infinite where nothing was found.

    Attributes:
        lower, upper: a box that the flow does not leave, ``(N, n)``.
        remainder_lower, remainder_upper: what the polynomial leaves out, ``(N, n)``.
        curve: bound of ``h^2 / 2 |z''|`` of the solutions z under constant w, ``(N, n)``.
        drift: e, ``(N, n)``.
    """

    lower: Tensor
    upper: Tensor
    remainder_lower: Tensor
    remainder_upper: Tensor
    curve: Tensor
    drift: Tensor


@torch.no_grad()
def enclosure(
    programs: Expansion, state: IntervalForm, control: IntervalForm | None, w: Box, held: Held | None = None
) -> Enclosure:
    """Of N parts that begin in these states ``(N, n)`` under these controls ``(N, m)``; w is ``(n,)`` or ``(N, n)``."""
    signal = w
    if held is not None:  # what moves the solutions of constant disturbances
        reach = round_up(held.weight * held.jump)
        signal = Box(round_down(w.lower - reach), round_up(w.upper + reach))
    flowed = _Flowed(programs, state, control, w, signal, held)
    stay, inside = _a_priori(state, flowed)
    n, h, p = state.lower.shape[-1], programs.length, programs.division.order
    given = IntervalForm(signal.lower, signal.upper)
    found = _watched(programs.coefficients, inside, given, control)
    second, last = (IntervalForm(found.lower[:, i : i + n], found.upper[:, i : i + n]) for i in (0, (p > 1) * n))
    slopes = _slopes(programs, inside, control)
    swung, pushed = _swung(w.radius, h), torch.zeros(n, dtype=torch.float64)
    if held is not None:
        swung = swung + (h * h * _MORE) * held.swing * held.jump
        pushed = _pushed(programs, inside, held, w)
    drift = _drift(slopes, swung, pushed, h)
    end = _drift_at_the_end(slopes, swung, pushed, h, drift)
    power = round_up(torch.tensor(h**p, dtype=torch.float64) * h * (1 + 1e-12)), h**p * h * (1 - 1e-12)
    low, high = _times(last, power[1], float(power[0]))
    curve = round_up(torch.maximum(second.lower.abs(), second.upper.abs()) * (h * h * (1 + 1e-12)))
    return Enclosure(stay.lower, stay.upper, round_down(low - end), round_up(high + end), _number(curve), drift)


@torch.no_grad()
def measured_rest(
    programs: Expansion, stay: IntervalForm, control: IntervalForm, w: Box, jitter: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """``[j^2] c_2(X, P, W)``: what ``x - j (f(x, p) + v)`` leaves of the state j seconds before x, of N measurements.

    Args:
        programs: of the loop.
        stay: boxes around all that is passed since, ``(N, n)``.
        control: that was in force, ``(N, m)``.
        w: ``(n,)`` or ``(N, n)``.
        jitter: bounds of j, ``(N, 1)``.
    """
    n = stay.lower.shape[-1]
    found = _watched(programs.coefficients, stay, IntervalForm(w.lower, w.upper), control)
    least, most = ((j * j) * scale for j, scale in zip(jitter, (1 - 1e-12, 1 + 1e-12), strict=True))
    second = IntervalForm(found.lower[:, :n], found.upper[:, :n])
    ends = torch.stack([side * j for side in second.bounds for j in (least, most)])
    low = torch.nan_to_num(round_down(ends.amin(0)), nan=-torch.inf)
    high = torch.nan_to_num(round_up(ends.amax(0)), nan=torch.inf)
    return torch.where(most > 0, low, 0.0), torch.where(most > 0, high, 0.0)


def run_smoothly(
    program: Program, state: IntervalForm, w: IntervalForm, numbers: IntervalForm | None
) -> tuple[Outputs, Tensor]:
    """What a program gives over boxes ``(..., n)``, and over which of them it is smooth, ``(...)``.

    An angle or a remainder may jump where its values are bounded all the same, and whatever is made of it then may be
    bounded too: so it is the operation that tells, and not the result.
    """
    smooth = np.ones(state.lower.shape[:-1], dtype=bool)

    def noted(i: Instruction, operands: Sequence[IntervalForm]) -> IntervalForm:
        nonlocal smooth
        if i.kind == "atan2":
            y, x = operands
            smooth = smooth & ((x.lower > 0) | (y.lower > 0) | (y.upper < 0)).all(-1)
        elif i.kind in ("remainder", "fmod", "wrap"):
            low, high = (torch.from_numpy(np.ascontiguousarray(side)) for side in operands[0].bounds)
            smooth = smooth & within_a_period(i.kind, low, high, *map(float, i.constants)).all(-1).numpy()
        return evaluate_arrays(i, operands)

    found = run_on_arrays(program, state, w, numbers, evaluate=noted)
    return found, torch.from_numpy(np.ascontiguousarray(smooth))


def _number(bound: Tensor) -> Tensor:
    return torch.nan_to_num(bound, nan=torch.inf)


def _times(a: IntervalForm, least: float, most: float) -> tuple[Tensor, Tensor]:
    """An interval times a positive number between two that are known."""
    low = torch.minimum(a.lower * least, a.lower * most)
    high = torch.maximum(a.upper * least, a.upper * most)
    return torch.nan_to_num(round_down(low), nan=-torch.inf), torch.nan_to_num(round_up(high), nan=torch.inf)


def _watched(program: Program, state: IntervalForm, w: IntervalForm, numbers: IntervalForm | None) -> IntervalForm:
    """Of a program, the output ``control``, for all N parts."""
    found = run_on_arrays(program, state, w, numbers).control
    batch = torch.broadcast_shapes(found.lower.shape[:-1], state.lower.shape[:-1])
    return IntervalForm(*(side.expand(*batch, -1) for side in found.bounds))


@dataclass(frozen=True)
class _Flowed:
    """``B + [0, h] (f(X, U) + W)`` of a box X; unbounded where f may jump.

    Where p may be in force, of both: of f with p or u under w, and of f with u under what moves the solutions of
    constant disturbances.
    """

    programs: Expansion
    state: IntervalForm
    control: IntervalForm | None
    w: Box
    signal: Box
    held: Held | None

    def __call__(self, stay: IntervalForm) -> IntervalForm:
        """Of X."""
        low, high = rate_over(self.programs, stay, self.control, self.signal)
        if self.held is not None:
            slow, fast = rate_over(self.programs, stay, self.held.control, self.w)
            low, high = torch.minimum(low, slow), torch.maximum(high, fast)
        low, high = low.clamp(max=0.0) * self.programs.length, high.clamp(min=0.0) * self.programs.length
        state = self.state
        return IntervalForm(round_down(state.lower + round_down(low)), round_up(state.upper + round_up(high)))


def rate_over(
    programs: Expansion, stay: IntervalForm, control: IntervalForm | None, w: Box
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Bounds of ``f(X, U) + W``; infinite where f may jump."""
    found, smooth = run_smoothly(programs.rate, stay, IntervalForm(w.lower, w.upper), control)
    rate, smooth = found.next, smooth[..., None]
    low = torch.where(smooth, round_down(rate.lower + w.lower), -torch.inf)
    return low, torch.where(smooth, round_up(rate.upper + w.upper), torch.inf)


def _a_priori(state: IntervalForm, flowed: _Flowed) -> tuple[IntervalForm, IntervalForm]:
    """A box that no solution leaves within the part, ``(N, n)``, and its image, which is no larger; infinite where none
    was found.
    """
    trial = _widened(state, flowed(state))
    kept = torch.zeros(state.lower.shape[:-1], dtype=torch.bool)
    for _ in range(_ROUNDS):
        after = flowed(trial)
        kept = ((trial.lower <= after.lower) & (after.upper <= trial.upper)).all(-1)
        kept &= torch.isfinite(trial.lower).all(-1) & torch.isfinite(trial.upper).all(-1)
        if bool(kept.all()):
            return trial, after
        wider, fixed = _widened(state, after), kept[..., None]
        trial = IntervalForm(torch.where(fixed, trial.lower, wider.lower), torch.where(fixed, trial.upper, wider.upper))
    lost = torch.full_like(state.lower, torch.inf)
    stay = IntervalForm(
        torch.where(kept[..., None], trial.lower, -lost), torch.where(kept[..., None], trial.upper, lost)
    )
    return stay, flowed(stay)


def _widened(state: IntervalForm, after: IntervalForm) -> IntervalForm:
    """A box around both, wider by a share of how far the flow goes."""
    low, high = torch.minimum(state.lower, after.lower), torch.maximum(state.upper, after.upper)
    more = _GROWTH * ((state.lower - low) + (high - state.upper)) + 1e-14 * (low.abs() + high.abs()) + TINY
    return IntervalForm(round_down(low - more), round_up(high + more))


def _slopes(programs: Expansion, inside: IntervalForm, control: IntervalForm | None) -> IntervalForm:
    """Bounds of Df, ``(N, n, n)``."""
    n = inside.lower.shape[-1]
    unit = torch.eye(n, dtype=torch.float64)[:, None]  # directions are a batch in front of the parts
    parts = [side.expand(n, *side.shape) for side in inside.bounds]
    given = [unit.expand(n, len(inside.lower), n)] * 2
    if control is not None:
        given = [torch.cat([side.expand(n, *side.shape), e], -1) for side, e in zip(control.bounds, given, strict=True)]
    nothing = torch.zeros(n, dtype=torch.float64)
    slope = _watched(programs.tangent, IntervalForm(*parts), IntervalForm(nothing, nothing), IntervalForm(*given))
    return IntervalForm(*(side.permute(1, 2, 0) for side in slope.bounds))


_MORE = 1 + 1e-9
"""More than all that is rounded in the sums below."""


def _largest(slopes: IntervalForm) -> Tensor:
    return torch.maximum(slopes.lower.abs(), slopes.upper.abs())


def _swung(radius: Tensor, h: float) -> Tensor:
    """``3/4 h^2 r_W``."""
    return (0.75 * h * h * _MORE) * radius


def _pushed(programs: Expansion, inside: IntervalForm, held: Held, w: Box) -> Tensor:
    """``d^2 / 2 |D_x (f(x, p) - f(x, u)) x'|``, d the seconds that p is in force for."""
    assert programs.change is not None
    low, high = rate_over(programs, inside, held.control, w)
    parts = zip(held.control.bounds, held.less.bounds, (low, high), strict=True)
    given = IntervalForm(*(torch.cat(sides, -1) for sides in parts))
    nothing = torch.zeros(inside.lower.shape[-1], dtype=torch.float64)
    turned = _watched(programs.change, inside, IntervalForm(nothing, nothing), given)
    square = (held.most * programs.length) ** 2 / 2 * _MORE
    return torch.where(held.most > 0, _number(square * torch.maximum(turned.lower.abs(), turned.upper.abs())), 0.0)


def _drift(slopes: IntervalForm, swung: Tensor, pushed: Tensor, h: float) -> Tensor:
    """``e >= pushed + A (swung + h e)``; infinite where none was found."""
    most = _largest(slopes)

    def after(e: Tensor) -> Tensor:
        moved = (most * (swung + h * _MORE * e)[..., None, :]).sum(-1)
        return (pushed + moved) * _MORE + TINY * (swung.amax() > 0)

    e = after(torch.zeros(most.shape[:-1], dtype=torch.float64))
    trial, kept = e, torch.zeros(most.shape[:-2], dtype=torch.bool)
    for _ in range(_ROUNDS):
        trial = 1.001 * e
        e = after(trial)
        kept = (e <= trial).all(-1)
        if bool(kept.all()):
            break
    return torch.where(kept[..., None], trial, torch.inf)


def _drift_at_the_end(slopes: IntervalForm, swung: Tensor, pushed: Tensor, h: float, drift: Tensor) -> Tensor:
    """``g = pushed + D swung + h A e``."""
    moved = (slopes.upper - slopes.lower) * swung[..., None, :]
    carried = _largest(slopes) * (h * _MORE * drift)[..., None, :]
    return _number((pushed + (moved + carried).sum(-1)) * _MORE + TINY)
