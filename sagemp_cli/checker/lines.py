"""Where the position of a cell's states is between the samples, according to the stored bounds."""

from __future__ import annotations

import numpy as np

from sagemp_cli.checker.balls import ball, balls
from sagemp_cli.checker.between import SAMPLES, Line, boxes_of
from sagemp_cli.checker.document import Document


def lines_of(document: Document, c: int) -> list[Line]:
    """Lines of a cell over the position, from sample to sample or, in continuous time, from part to part of a period;
    points, if nothing is claimed but of the samples.

    Raises:
        Unproved: a bound is not finite.
    """
    place, tubes, odes = list(document.position), document.tubes, document.odes
    ode = odes[document.cell_ode[c]] if odes else None
    flow = document.flow_of(c) if odes else {}

    def over(side: str) -> np.ndarray:
        tube = tubes[f"tube_{side}"][c]
        if ode is None:
            return tube[:, place]
        rows = np.concatenate([tube[:-1, None], flow[f"inner_{side}"]], axis=1).reshape(-1, tube.shape[1])
        return np.concatenate([rows, tube[-1:]])[:, place]

    boxes = boxes_of(over("lower"), over("upper"))
    if document.between == SAMPLES:
        return [Line(box, box) for box in boxes]
    ends = list(zip(boxes[:-1], boxes[1:], strict=True))
    if ode is None:
        return [Line(first, last) for first, last in ends]
    lower, upper, curve, drift, jump = (
        [balls(row[place]) for row in flow[name].reshape(len(ends), -1)]
        for name in ("lower", "upper", "curve", "drift", "jump")
    )
    w = zip(*(balls(tubes[f"disturbance_{side}"][place]) for side in ("lower", "upper")), strict=True)
    swing = [ball(ode.length) * (b - a) for a, b in w]  # 2 h r_W
    return [
        Line(
            *pair,
            bend=[b + s + ball(ode.length) * g for b, s, g in zip(curve[i], swing, jump[i], strict=True)],
            rest=[2 * e for e in drift[i]],
            stay=(lower[i], upper[i]),
        )
        for i, pair in enumerate(ends)
    ]
