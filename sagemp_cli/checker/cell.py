"""One cell of one reference: its reach sets in ball arithmetic, and that they lie in the stored tube."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sagemp_cli.checker.balls import BITS, arb, ball, balls, ctx
from sagemp_cli.checker.loop import Folded, Loop
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.part import FlowClaim, PartProver
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


def prove_cell(claim: CellClaim, programs: Sequence[Folded], flow: Flow | None = None) -> str:
    """Prove that every real-arithmetic rollout of the programs that starts in the cell stays in the stored tube, under
    every disturbance in its box and with every control and deviation within its stored bounds.

    In continuous time the program is that of a period, and what the boxes of its disturbance stand for is proved of
    the flow as well: then every solution of the ODE is such a rollout.

    The answer is empty, or says in one line what could not be proved.
    """
    with ctx.workprec(BITS), np.errstate(all="ignore"):  # what overflows is found out by Zonotope
        k = 0
        try:
            w = claim.disturbance_lower, claim.disturbance_upper
            loops = [Loop(folded, claim.windows, *w) for folded in programs]
            parts = None if flow is None else PartProver(flow, *(side[0, : flow.rate.states] for side in w))
            states, box = Zonotope.box(claim.lower, claim.upper), _box(claim.lower, claim.upper)
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
                    if claim.flow is None:
                        raise Unproved("nothing is said of the flow between the instants")
                    _prove_period(parts, claim.flow, k, box, asked[:m], asked[m:])
                if claim.deviation is not None:
                    if deviation is None:
                        raise Unproved("the program has no deviation")
                    found = step.output(folded.program.deviation, step.bounds(deviation))
                    _require_inside(found, -claim.deviation[k], claim.deviation[k], "deviation in state")
                states = step.image(after)
                box = step.output(folded.program.next, states.bounds())
                if claim.kept is not None:
                    states = states.reduced(_mask(claim.kept[k], states.generators.shape[1]))
                _require_inside(box, claim.tube_lower[k + 1], claim.tube_upper[k + 1], "state")
        except (Unproved, ArithmeticError) as e:
            return f"step {k}: {e}"
    return ""


def _prove_period(
    parts: PartProver, flow: FlowClaim, k: int, begin: list[Bounds], control: list[Bounds], inner: list[Bounds]
) -> None:
    """Prove what is claimed between two instants; ``inner`` bounds the states at the beginning of parts 2 to S."""
    n = len(begin)
    for j in range(flow.lower.shape[1]):
        if j:
            begin = inner[(j - 1) * n : j * n]
            _require_inside(begin, flow.inner_lower[k, j - 1], flow.inner_upper[k, j - 1], f"part {j}: state")
        try:
            parts.prove(flow, (k, j), begin, control)
        except Unproved as e:
            raise Unproved(f"part {j}: {e}") from None


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
