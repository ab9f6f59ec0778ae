"""Figure: what was proved of a loop in continuous time. Every state over time, between the samples too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from sagemp_cli.report.canvas import (
    DANGER,
    GOAL,
    INK,
    MODES,
    VERDICT_COLOURS,
    blank_figure,
    headline,
    style_axes,
    unit_text,
)
from sagemp_cli.verification.continuous.proof import OdeProof

_SAYS = {
    "VERIFIED": "Certified: every solution does what is asked",
    "FALSIFIED": "Falsified: a solution breaks the claim, proved by an enclosure of it",
    "UNKNOWN": "Unknown: the tube does not prove it, and no counterexample was found",
}


def draw_ode(
    proof: OdeProof,
    name: str,
    state_names: Sequence[str],
    state_units: Sequence[str],
    limits: Mapping[int, Sequence[tuple[float, float]]],
) -> Figure:
    """Boxes that hold every state over each period, of each cell; a violation as a line; limits as lines.

    Args:
        proof: what was found out.
        name: of the loop.
        state_names, state_units: n words each.
        limits: bounds that are asked for of some of the states.
    """
    n, answer = len(state_names), str(proof.answer)
    columns = next(c for c in (3, 2, 1) if n % c == 0) if n < 5 else 3
    rows = -(-n // columns)
    figure = blank_figure(4.2 * columns, 2.4 * rows + 0.9)
    cells = f"{proof.cells} cell{'s' * (proof.cells != 1)}"
    about = f"{name}, {proof.loop.horizon} periods of {proof.loop.period:g} s, in continuous time, {cells}"
    said = _SAYS[answer] if proof.requirements or answer != "VERIFIED" else "Certified: every state stays bounded"
    headline(figure, said, about, colour=VERDICT_COLOURS.get(answer, INK))
    for i in range(n):
        axes = figure.add_subplot(rows, columns, i + 1)
        unit = f" [{unit_text(state_units[i])}]" if state_units[i] else ""
        style_axes(axes, xlabel="time [s]" if i >= n - columns else "", ylabel=f"{state_names[i]}{unit}")
        for piece in proof.pieces:
            flow = piece.reach.flow
            if flow is None:
                continue
            low, high = flow.lower[..., i].flatten(1).numpy(), flow.upper[..., i].flatten(1).numpy()
            time = np.repeat(np.arange(low.shape[1] + 1) * proof.loop.period / flow.division.substeps, 2)[1:-1]
            for bottom, top in zip(low, high, strict=True):
                known = np.isfinite(bottom) & np.isfinite(top)
                lower, upper = (np.repeat(np.where(known, side, np.nan), 2) for side in (bottom, top))
                axes.fill_between(time, lower, upper, color=MODES[0], alpha=0.35, linewidth=0)
        if proof.violation is not None:
            states = proof.violation.states[:, i].numpy()
            axes.plot(proof.violation.times.numpy(), states, color=DANGER, linewidth=1.2)
        for sides in limits.get(i, ()):
            for side in sides:
                if np.isfinite(side):
                    axes.axhline(side, color=GOAL, linewidth=0.9, linestyle=(0, (4, 3)))
    return figure
