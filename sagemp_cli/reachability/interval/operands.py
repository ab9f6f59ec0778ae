"""What goes into every operation of a step, by interval arithmetic: a second opinion for affine forms.

A form is a centre and what deviates from it, so a sum of squares or of exponentials may reach below 0 where its
interval does not, and a root, a logarithm or a quotient of it has no band. One step on intervals gives bounds of all
operands, in the order and under the names that the other propagators evaluate them, to be handed on as hints.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sagemp_cli.reachability.affine.compiled.hints import Hint, Hints
from sagemp_cli.reachability.interval.form import IntervalForm, evaluate
from sagemp_cli.reachability.program.program import Instruction, Program
from sagemp_cli.reachability.relaxations.registry import OPERATIONS, relaxation


def operands(program: Program, state: IntervalForm, disturbance: IntervalForm, numbers: IntervalForm) -> list[Hint]:
    """Bounds of what goes into every operation of one step, but of products and angles.

    Args:
        program: the step.
        state, disturbance, numbers: of a batch of cells, ``(B, n)``, ``(d,)``, ``(g,)`` or ``(B, g)``.
    """
    noted: list[Hint] = []
    cells = len(state.lower)

    def note(i: Instruction, values: Sequence[IntervalForm]) -> IntervalForm:
        fixed = [program.instructions[slot].kind == "constant" for slot in i.operands]

        def bounded(name: str, form: IntervalForm) -> None:
            lower, upper = (side.expand(cells, i.size) for side in form.bounds)
            noted.append(Hint(name, i.size, lower, upper))

        if i.kind in ("maximum", "minimum"):
            if any(fixed):
                bounded("clamp", values[fixed.index(False)])
            else:
                difference = Instruction("sub", i.size, i.operands)
                bounded("relu", evaluate(difference, values))
        elif i.kind == "div" and not fixed[1]:
            bounded("reciprocal", values[1])
        elif i.kind == "atan2":
            noted.append(Hint("atan2", i.size))
        elif i.kind in OPERATIONS:
            bounded(relaxation(i.kind, i.constants).name, values[0])
        if i.kind in ("mul", "div") and not any(fixed):
            noted.append(Hint("product", i.size))
        return evaluate(i, values)

    program.run(state, disturbance, numbers, evaluate=note)
    return noted


def sharper(found: Sequence[Hint], known: Hints | None, *, where: Tensor) -> list[Hint]:
    """What is known of a step's operations, and in some cells what :func:`operands` found.

    Args:
        found: from there.
        known: from elsewhere.
        where: cells ``(B,)``; the others are not disturbed.
    """
    here = [
        hint
        if hint.lower is None or hint.upper is None
        else hint._replace(
            lower=torch.where(where[:, None], hint.lower, -torch.inf),
            upper=torch.where(where[:, None], hint.upper, torch.inf),
        )
        for hint in found
    ]
    return here if known is None else [a.intersected(b) for a, b in zip(here, known, strict=True)]
