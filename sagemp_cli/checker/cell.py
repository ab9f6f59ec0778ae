"""One cell of one reference: its reach sets in ball arithmetic, and that they lie in the stored tube."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import BITS, Unproved, arb, arb_mat, ball, balls, ctx
from sagemp_cli.checker.form import Entry, Form, Step
from sagemp_cli.checker.functions import FUNCTIONS, clamp, leaky_relu
from sagemp_cli.checker.zonotope import Zonotope
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import UnsupportedOperationError


@dataclass(frozen=True)
class Policy:
    """The tracker as exact numbers: ``u = scale * MLP(error_scale * [p_{k+1} - x, ..., p_{k+N} - x]) + offset``, the
    network's output cut off at +-1 if it saturates.

    Attributes:
        weights, biases: per layer; leaky ReLU between layers.
        lookahead: N.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    error_scale: np.ndarray
    control_scale: np.ndarray
    control_offset: np.ndarray
    negative_slope: float
    lookahead: int
    saturate: bool = False


@dataclass(frozen=True)
class CellClaim:
    """What is claimed of one cell.

    Attributes:
        reference: ``(K+1, n)``.
        lower, upper: the cell, ``(n,)``.
        tube_lower, tube_upper: ``(K+1, n)``.
        control_lower, control_upper: ``(K, m)``; may be infinite.
        disturbance_lower, disturbance_upper: W.
        operations: name and number of entries, in the order of evaluation.
        slope, offset, radius: ``(K, E)``.
        kept: ``(K, bytes)`` or None.
        deviation: of the analytical model that a learned robot stands for, ``(K, n)``: the claim is then about that
            model; None for a claim about the robot itself.
        begin, end: steps at which the cell's set begins and ends.
        heir_lower, heir_upper: the cell that encloses it from there on; None if it ends at K.
    """

    reference: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    tube_lower: np.ndarray
    tube_upper: np.ndarray
    control_lower: np.ndarray
    control_upper: np.ndarray
    disturbance_lower: np.ndarray
    disturbance_upper: np.ndarray
    operations: tuple[tuple[str, int], ...]
    slope: np.ndarray
    offset: np.ndarray
    radius: np.ndarray
    kept: np.ndarray | None
    deviation: np.ndarray | None
    begin: int
    end: int
    heir_lower: np.ndarray | None = None
    heir_upper: np.ndarray | None = None


def prove_cell(claim: CellClaim, dynamics: Dynamics, policy: Policy) -> str:
    """Prove that every real-arithmetic rollout that is in the cell at the first step stays in the stored tube up to the
    last, under every disturbance in W^K and with every control within its stored bounds, and is in its heir then. The
    rollouts are those of the robot, or where a deviation is claimed those of its analytical model.

    The answer is empty, or says in one line what could not be proved.
    """
    with ctx.workprec(BITS), np.errstate(all="ignore"):  # what overflows is found out by Zonotope
        k = claim.begin
        try:
            loop = Loop(dynamics, policy, claim.reference)
            w = balls(claim.disturbance_lower), balls(claim.disturbance_upper)
            states, matrices = Zonotope.box(claim.lower, claim.upper), {}
            if not ((claim.tube_lower[k] <= claim.lower) & (claim.upper <= claim.tube_upper[k])).all():
                raise Unproved("the tube does not contain the cell")
            for k in range(claim.begin, claim.end):
                step = Step(states, *w, record=_record(claim, k), matrices=matrices)
                x = step.state()
                u = loop.control(step, k, x)
                asked = loop.within(step.bounds(u.rows()))
                _require_inside(asked, claim.control_lower[k], claim.control_upper[k], "control")
                after = _after(claim, dynamics, step, k, x, u)
                states = states.image(step.finish(after))
                if claim.kept is not None:
                    states = states.reduced(_mask(claim.kept[k], states.generators.shape[1]))
                _require_inside(states.bounds(), claim.tube_lower[k + 1], claim.tube_upper[k + 1], "state")
            if claim.heir_lower is not None and claim.heir_upper is not None:
                _require_inside(states.bounds(), claim.heir_lower, claim.heir_upper, "state of the merged set")
        except (Unproved, UnsupportedOperationError, ArithmeticError) as e:  # the last of a formula's own parameters
            return f"step {k}: {e}"
    return ""


def _after(claim: CellClaim, dynamics: Dynamics, step: Step, k: int, x: Form, u: Form) -> Form:
    """The next state: of the robot, or of its analytical model by way of the learned one.

    ``analytical.step(x, u, w) = learned.step(x, u, w + e)``, and of the deviation e only an enclosure is kept.
    """
    if claim.deviation is None:
        return dynamics.step(x, u, step.disturbance)
    derivative, deviation = dynamics.compared(x, u)
    _require_inside(step.bounds(deviation.rows()), -claim.deviation[k], claim.deviation[k], "deviation in state")
    folded = step.apply("identity", FUNCTIONS["identity"], deviation)
    return dynamics.advance(x, derivative, step.disturbance + folded)


class Loop:
    """The closed loop as a function of forms."""

    def __init__(self, dynamics: Dynamics, policy: Policy, reference: np.ndarray) -> None:
        self.dynamics, self.policy, self.horizon = dynamics, policy, len(reference) - 1
        n, lookahead = dynamics.state_dim, policy.lookahead
        weights = [arb_mat(*w.shape, balls(w.flat)) for w in policy.weights]
        first, scale = weights[0], balls(policy.error_scale)
        hidden = first.nrows()
        # First layer on [p_{k+1} - x, ..., p_{k+N} - x]: fixed weights on x, and a bias that depends on k.
        scaled = [[first[h, j] * scale[j % n] for j in range(lookahead * n)] for h in range(hidden)]
        on_state = [-sum(row[i::n], start=arb(0)) for row in scaled for i in range(n)]
        last = self.horizon
        windows = [ball(reference[min(k + 1 + j // n, last), j % n]) for j in range(lookahead * n) for k in range(last)]
        shift = arb_mat(scaled) * arb_mat(lookahead * n, last, windows)
        self._biases = [[shift[h, k] + ball(policy.biases[0][h]) for h in range(hidden)] for k in range(last)]
        self._layers = [arb_mat(hidden, n, on_state), *weights[1:]]
        self._shifts = [balls(b) for b in policy.biases[1:]]
        self._scale, self._offset = balls(policy.control_scale), balls(policy.control_offset)
        self._limit = clamp(-1.0, 1.0) if policy.saturate else None
        self._activation = leaky_relu(policy.negative_slope)

    def control(self, step: Step, k: int, x: Form) -> Form:
        """``u_k`` as a form of the state."""
        h = _shifted(self._layers[0] * x.rows(), self._biases[k])
        for weight, bias in zip(self._layers[1:], self._shifts, strict=True):
            h = _shifted(weight * step.relax("leaky_relu", self._activation, h), bias)
        if self._limit is not None:
            h = step.relax("clamp", self._limit, h)
        m = len(self._scale)
        scaled = arb_mat([[s if i == j else 0 for j in range(m)] for i, s in enumerate(self._scale)]) * h
        return step.split(_shifted(scaled, self._offset), (m,))

    def within(self, controls: Sequence[tuple[arb, arb]]) -> list[tuple[arb, arb]]:
        """Bounds of the controls, and what saturation says of them."""
        if self._limit is None:
            return list(controls)
        ends = [(o - abs(s), o + abs(s)) for s, o in zip(self._scale, self._offset, strict=True)]
        return [(low.max(a), high.min(b)) for (low, high), (a, b) in zip(controls, ends, strict=True)]


def _shifted(rows: arb_mat, shift: Sequence[arb]) -> arb_mat:
    """Rows plus constants."""
    for i, s in enumerate(shift):
        rows[i, 0] = rows[i, 0] + s
    return rows


def _record(claim: CellClaim, k: int) -> list[tuple[str, list[Entry]]]:
    columns = (claim.slope[k].tolist(), claim.offset[k].tolist(), claim.radius[k].tolist())
    entries = list(zip(*columns, strict=True))
    record, begin = [], 0
    for name, width in claim.operations:
        record.append((name, entries[begin : begin + width]))
        begin += width
    return record


def _mask(row: np.ndarray, count: int) -> np.ndarray:
    bits = np.unpackbits(row, bitorder="little")
    if bits.size < count or bits[count:].any():
        raise Unproved(f"the record of kept generators does not fit {count} generators")
    return bits[:count].astype(bool)


def _require_inside(bounds: Sequence[tuple[arb, arb]], lower: np.ndarray, upper: np.ndarray, what: str) -> None:
    """Each interval must lie between the stored numbers."""
    for i, (low, high) in enumerate(bounds):
        if not ((np.isneginf(lower[i]) or ball(lower[i]) <= low) and (np.isposinf(upper[i]) or high <= ball(upper[i]))):
            found, stored = f"[{float(low):.9g}, {float(high):.9g}]", f"[{lower[i]:.9g}, {upper[i]:.9g}]"
            raise Unproved(f"{what} {i} is only proved to lie in {found}, the file says {stored}")
