"""One cell of one reference: its reach sets in ball arithmetic, and that they lie in the stored tube."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import BITS, arb, ball, balls, ctx
from sagemp_cli.checker.loop import Folded, Loop
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.part import Before, FlowClaim, PartProver
from sagemp_cli.checker.requirement import MarginProver, Required
from sagemp_cli.checker.step import Entry, Step
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.checker.zonotope import Zonotope

Bounds = tuple[arb, arb]


@dataclass(frozen=True)
class CellClaim:
    """What is claimed of one cell.

    Attributes:
        program: which of the programs each step is, ``(K,)``.
        windows: the numbers of each step, ``(K, g)``.
        lower, upper: the cell, ``(n,)``.
        tube_lower, tube_upper: ``(K+1, n)``.
        control_lower, control_upper: ``(K, m)``; may be infinite.
        disturbance_lower, disturbance_upper: of each step, ``(K, d)``; W, and in continuous time what a step is given
            beside it.
        slope, offset, radius: ``(K, E)``.
        kept: ``(K, bytes)`` or None.
        deviation: bounds of the output of that name, ``(K, n)``, or None.
        flow: in continuous time, what is claimed between the instants.
        required: what has to hold there, each with the margin that is claimed.
    """

    program: np.ndarray
    windows: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    tube_lower: np.ndarray
    tube_upper: np.ndarray
    control_lower: np.ndarray
    control_upper: np.ndarray
    disturbance_lower: np.ndarray
    disturbance_upper: np.ndarray
    slope: np.ndarray
    offset: np.ndarray
    radius: np.ndarray
    kept: np.ndarray | None
    deviation: np.ndarray | None
    flow: FlowClaim | None = None
    required: tuple[tuple[Required, float], ...] = ()


def prove_cell(claim: CellClaim, programs: Sequence[Folded], flows: Sequence[Flow] = ()) -> str:
    """Prove that every real-arithmetic rollout of the programs that starts in the cell stays in the stored tube, under
    every disturbance in its box and with every control and deviation within its stored bounds.

    In continuous time there is a flow for each program, which is that of a period, the same at all of them; what the
    boxes of its disturbance stand for is proved of the flow as well: then every solution of the ODE is such a rollout.
    Then what is required holds at all times with the claimed margins.

    The answer is empty, or says in one line what could not be proved.
    """
    with ctx.workprec(BITS), np.errstate(all="ignore"):  # what overflows is found out by Zonotope
        k = 0
        try:
            w = claim.disturbance_lower, claim.disturbance_upper
            loops = {i: Loop(programs[i], claim.windows, *w) for i in set(claim.program.tolist())}
            parts = _Parts(claim, flows[claim.program[0]], *w) if flows else None
            n = len(claim.lower)
            before = np.zeros(programs[claim.program[0]].program.states - n)  # of a lag: as yet nothing
            corners = [np.concatenate([side, before]) for side in (claim.lower, claim.upper)]
            states, box = Zonotope.box(*corners), _box(*corners)
            if not ((claim.tube_lower[0] <= claim.lower) & (claim.upper <= claim.tube_upper[0])).all():
                raise Unproved("the tube does not contain the cell")
            for k, which in enumerate(claim.program.tolist()):
                folded = programs[which]
                known = box if parts is None else None  # there no record rests on intervals of states
                step = Step(loops[which], k, states, known, _record(claim, k, folded))
                after, control, deviation = step.run()
                asked: list[Bounds] = []
                if control is not None:
                    asked = step.output(folded.program.control, step.bounds(control))
                m = claim.control_lower.shape[1]
                _require_inside(asked[:m], claim.control_lower[k], claim.control_upper[k], "control")
                if parts is not None:
                    parts.prove(k, box, asked)
                if claim.deviation is not None:
                    if deviation is None:
                        raise Unproved("the program has no deviation")
                    found = step.output(folded.program.deviation, step.bounds(deviation))
                    _require_inside(found, -claim.deviation[k], claim.deviation[k], "deviation in state")
                states = step.image(after)
                box = step.output(folded.program.next, states.bounds())
                if claim.kept is not None:
                    states = states.reduced(_mask(claim.kept[k], states.generators.shape[1]))
                _require_inside(box[:n], claim.tube_lower[k + 1], claim.tube_upper[k + 1], "state")
                if parts is not None:
                    parts.require(k, box[:n])
        except (Unproved, ArithmeticError) as e:
            return f"step {k}: {e}"
    return ""


class _Parts:
    """Proves what is claimed between two instants.

    Args:
        claim: of the cell.
        flow: the loop's programs.
        lower, upper: what every period is given.
    """

    def __init__(self, claim: CellClaim, flow: Flow, lower: np.ndarray, upper: np.ndarray) -> None:
        if claim.flow is None:
            raise Unproved("nothing is said of the flow between the instants")
        n = flow.rate.states
        first = 1 + 2 * n if flow.jitters else 0  # of the first mean of w
        w = lower[0, first : first + n], upper[0, first : first + n]
        self._ode, self._flow, self._count, self._prover = flow, claim.flow, flow.substeps, PartProver(flow, *w)
        self._required = [(MarginProver(one, flow, *w), margin) for one, margin in claim.required]
        self._begins: list[list[Bounds]] = []
        self._insides: list[list[Bounds]] = []
        self._control: list[Bounds] = []

    def prove(self, k: int, box: list[Bounds], asked: list[Bounds]) -> None:
        """The flow of period k.

        Args:
            k: which period.
            box: bounds of the state at its beginning and, of a control that lags, of the control before.
            asked: bounds of the control, of the states at the beginning of parts 2 to S and, of a control that lags, of
                what it changes the rate by in each part that it may be late in, and of what it changes itself.

        Raises:
            Unproved: it does not follow.
        """
        ode, flow, lag = self._ode, self._flow, self._ode.lag
        n, m = ode.rate.states, ode.controls
        control, begin, held = asked[:m], box[:n], box[n:]
        inner, jumps, less = _cut(asked[m:], [n * (ode.substeps - 1), n * ode.lagged])
        if lag is not None and ode.jitters:
            self._prover.measured(flow, k, lag.since(ode.period, ode.substeps), held)
        self._begins, self._control, self._insides = [begin], control, []
        for j in range(self._count):
            if j:
                begin = inner[(j - 1) * n : j * n]
                _require_inside(begin, flow.inner_lower[k, j - 1], flow.inner_upper[k, j - 1], f"part {j}: state")
                self._begins.append(begin)
            before = None
            if lag is not None and k and j < ode.lagged:
                both = [(a.min(c), b.max(d)) for (a, b), (c, d) in zip(control, held, strict=True)]
                least, most = (arb(s.numerator) / s.denominator for s in lag.share(j, ode.period, ode.substeps))
                weight = ball(max(side[1] for side in lag.means(j, ode.period, ode.substeps)))
                before = Before(both, jumps[j * n : (j + 1) * n], less, (least, most), weight)
            try:
                self._insides.append(self._prover.prove(flow, (k, j), begin, control, before))
            except Unproved as e:
                raise Unproved(f"part {j}: {e}") from None

    def require(self, k: int, end: list[Bounds]) -> None:
        """That what is required holds over the period that was proved last, which ends in a box.

        Raises:
            Unproved: it does not follow.
        """
        ends = [*self._begins[1:], end]
        for prover, margin in self._required:
            for j, boxes in enumerate(zip(self._begins, ends, self._insides, strict=True)):
                try:
                    found = prover.least(k * self._count + j, *boxes, self._control)
                except Unproved as e:
                    raise Unproved(f"part {j}: '{prover.required.name}' is not proved: {e}") from None
                if found is not None and not ball(margin) <= found:
                    raise Unproved(
                        f"part {j}: the margin of '{prover.required.name}' is only proved to be {float(found):.9g}, "
                        f"the file says {margin:.9g}"
                    )


def _cut(values: list[Bounds], sizes: Sequence[int]) -> list[list[Bounds]]:
    """Some in a row, and the rest."""
    found = []
    for size in sizes:
        found.append(values[:size])
        values = values[size:]
    return [*found, values]


def _record(claim: CellClaim, k: int, folded: Folded) -> list[Entry]:
    """The relaxations of a step; the file has room for the program that takes most."""
    columns = (part[k, : folded.program.relaxations].tolist() for part in (claim.slope, claim.offset, claim.radius))
    return [Entry(*entry) for entry in zip(*columns, strict=True)]


def _box(lower: np.ndarray, upper: np.ndarray) -> list[Bounds]:
    return list(zip(balls(lower), balls(upper), strict=True))


def _mask(row: np.ndarray, count: int) -> np.ndarray:
    bits = np.unpackbits(row, bitorder="little")
    if bits.size < count or bits[count:].any():
        raise Unproved(f"the record of kept generators does not fit {count} generators")
    return bits[:count].astype(bool)


def _require_inside(bounds: Sequence[Bounds], lower: np.ndarray, upper: np.ndarray, what: str) -> None:
    """Each interval must lie between the stored numbers."""
    for i, (low, high) in enumerate(bounds):
        if not ((np.isneginf(lower[i]) or ball(lower[i]) <= low) and (np.isposinf(upper[i]) or high <= ball(upper[i]))):
            found, stored = f"[{float(low):.9g}, {float(high):.9g}]", f"[{lower[i]:.9g}, {upper[i]:.9g}]"
            raise Unproved(f"{what} {i} is only proved to lie in {found}, the file says {stored}")
