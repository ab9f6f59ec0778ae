"""A step program as a short list of nonlinear operations, with all that is linear between them folded into matrices.

Most instructions of a step are linear: errors of a lookahead, layers, scales, ``x + dt (...)``. Evaluated on a set,
each costs several operations on a few numbers. So every slot is written as a fixed combination of the step's *basic*
values: 1, the numbers of the step, the states, the disturbances, and the results of the nonlinear operations before.
What comes out, the :class:`Compiled`, says which nonlinear operations there are and which combinations go into them;
:mod:`sagemp_cli.reachability.affine.compiled.run` evaluates them, one after the other in the order of the program.

Rounding. A coefficient as computed differs from the exact one by at most ``error`` times its entry in ``sizes``, which
obeys the same recurrences with absolute values (:mod:`sagemp_cli.sets.rounding`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from sagemp_cli.reachability.program.kinds import INPUTS
from sagemp_cli.reachability.program.program import Instruction, Outputs, Program
from sagemp_cli.reachability.relaxations.registry import Relaxation, relaxation
from sagemp_cli.sets.rounding import TINY, dot, gamma

Rule = Literal["function", "product", "quotient", "angle", "maximum", "minimum", "logaddexp", "choice", "sums"]


_SMOOTH = torch.tensor(1.0, dtype=torch.float64), torch.tensor(1e300, dtype=torch.float64)
"""Beta and threshold of a softplus that is smooth throughout."""


class Combination(NamedTuple):
    """Vectors ``(rows,)`` of values as combinations of the basic ones.

    Attributes:
        matrix, sizes: ``(rows, columns)``; columns are 1, numbers, states, disturbances, results; those to come are 0.
        error: of an entry of the matrix, relative to that of ``sizes``.
        copies: which rows are one of the basic values, or minus one, and so are not rounded at all, ``(rows, 1)``; None
            if none is.
    """

    matrix: Tensor
    sizes: Tensor
    error: float = 0.0
    copies: Tensor | None = None

    @staticmethod
    def constant(value: Tensor) -> Combination:
        """Fixed numbers."""
        return Combination(value[:, None], value[:, None].abs())

    def moved(self, map_: Callable[[Tensor], Tensor]) -> Combination:
        """What a map that only moves rows makes of it (exact)."""
        copies = None if self.copies is None else map_(self.copies)
        return Combination(map_(self.matrix), map_(self.sizes), self.error, copies)

    def padded(self, columns: int) -> Combination:
        """With as many columns."""
        missing = columns - self.matrix.shape[-1]
        if not missing:
            return self
        matrix, sizes = (pad(t, (0, missing)) for t in self[:2])
        return Combination(matrix, sizes, self.error, self.copies)


class Node(NamedTuple):
    """A nonlinear operation.

    Attributes:
        rule: "function", of one variable; "product"; "quotient", whose third operand is the reciprocal of the second;
            "angle", whose operands are y and x; "maximum", "minimum" or "logaddexp" of a and b, whose operands are
            a - b, a and b;
            "choice" of a where c is positive, else b, whose operands are a - b, c, a and b;
            "sums" in float32, whose operands are the exact sums and what was summed.
        operands: its operands, one after the other.
        size: entries of its result.
        relaxation: of a function, an angle, a choice or sums; of a maximum or minimum that of ``relu(a - b)``, of a
            logaddexp that of a softplus.
        square: whether a product is of one value with itself.
    """

    rule: Rule
    operands: Combination
    size: int
    relaxation: Relaxation | None = None
    square: bool = False


@dataclass(frozen=True, eq=False)
class Compiled:
    """A step.

    Attributes:
        numbers, states, disturbances: how many there are.
        nodes: in the order of evaluation.
        outputs: combinations.
    """

    numbers: int
    states: int
    disturbances: int
    nodes: tuple[Node, ...]
    outputs: Outputs

    @property
    def watched(self) -> Combination | None:
        """Control and deviation, one after the other, as far as the program says them."""
        parts = [part for part in (self.outputs.control, self.outputs.deviation) if part is not None]
        return _joined(parts) if parts else None

    @property
    def columns(self) -> list[int]:
        """Where the columns of 1, numbers, states, disturbances and each result begin, and where the last ones end."""
        sizes = [1, self.numbers, self.states, self.disturbances, *(node.size for node in self.nodes)]
        return [0, *itertools.accumulate(sizes)]


def compiled(program: Program) -> Compiled:
    """The program, folded."""
    return _Folding(program).result()


class _Folding:
    """The operations so far, and how many basic values there are."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self._nodes: list[Node] = []
        self._columns = 1
        self._inputs = {}
        for kind, size in zip(
            ("numbers", "state", "disturbance"), (program.numbers, program.states, program.disturbances), strict=True
        ):
            self._inputs[kind] = self._basic(size)

    def result(self) -> Compiled:
        """What the program is."""
        p = self._program
        outputs = p.run(*(self._inputs[kind] for kind in INPUTS), evaluate=self._evaluated)
        return Compiled(p.numbers, p.states, p.disturbances, tuple(self._nodes), outputs)

    def _basic(self, size: int) -> Combination:
        first, self._columns = self._columns, self._columns + size
        rows = torch.eye(self._columns, dtype=torch.float64)[first:]
        return Combination(rows, rows, copies=torch.ones(size, 1, dtype=torch.bool))

    def _node(
        self, rule: Rule, size: int, operands: Combination, how: Relaxation | None = None, *, square: bool = False
    ) -> Combination:
        self._nodes.append(Node(rule, operands, size, how, square))
        return self._basic(size)

    def _evaluated(self, i: Instruction, operands: Sequence[Combination]) -> Combination:
        if i.kind in ("constant", "pick", "join", "linear"):
            return self._linear(i, operands)
        if i.kind == "neg":
            return operands[0]._replace(matrix=-operands[0].matrix)
        if i.kind == "float32_linear":
            exact = self._linear(i, operands)
            return self._node("sums", i.size, _joined([exact, operands[0]]), relaxation(i.kind, i.constants))
        if len(operands) == 1:
            return self._node("function", i.size, operands[0], relaxation(i.kind, i.constants))
        *condition, a, b = (o if len(o.matrix) == i.size else o.moved(lambda t: t.expand(i.size, -1)) for o in operands)
        if i.kind == "where":
            return self._node("choice", i.size, _joined([_sum(a, b, -1.0), *condition, a, b]), relaxation(i.kind))
        constant = [_is_constant(o) for o in (a, b)]
        if i.kind in ("add", "sub"):
            return _sum(a, b, 1.0 if i.kind == "add" else -1.0)
        if i.kind == "mul":
            if any(constant):
                return _scaled(a, b) if constant[1] else _scaled(b, a)
            return self._node("product", i.size, _joined([a, b]), square=operands[0] is operands[1])
        if i.kind == "div":
            return self._quotient(i, a, b, operands[1], constant)
        if i.kind == "atan2":
            return self._node("angle", i.size, _joined([a, b]), relaxation(i.kind))
        if i.kind == "logaddexp":
            how = relaxation("softplus", _SMOOTH)
            return self._node("logaddexp", i.size, _joined([_sum(a, b, -1.0), a, b]), how)
        return self._extreme(i, a, b, constant)

    def _linear(self, i: Instruction, operands: Sequence[Combination]) -> Combination:
        if i.kind == "constant":
            return Combination.constant(i.constants[0])
        if i.kind == "pick":
            entries = torch.tensor(i.entries)
            return operands[0].moved(lambda t: t[entries])
        if i.kind == "join":
            return _joined(operands)
        weight, bias = i.constants
        (x,) = operands
        sizes = weight.abs() @ x.sizes
        y = Combination(weight @ x.matrix, sizes + _tiny(sizes), x.error + dot(weight.shape[-1]))
        return _sum(y, Combination.constant(bias)) if bool(bias.any()) or bias.requires_grad else y

    def _quotient(
        self, i: Instruction, a: Combination, b: Combination, divisor: Combination, constant: Sequence[bool]
    ) -> Combination:
        """Of one divisor for all entries there is one reciprocal."""
        if constant[1]:
            value = b.matrix[:, :1]
            return Combination(a.matrix / value, a.sizes / value.abs() + _tiny(a.sizes), a.error + gamma(1))
        count = len(divisor.matrix)
        reciprocal = self._node("function", count, divisor, relaxation("reciprocal"))
        if count != i.size:
            reciprocal = reciprocal.moved(lambda t: t.expand(i.size, -1))
        if constant[0]:
            return _scaled(reciprocal, a)
        return self._node("quotient", i.size, _joined([a, b, reciprocal]))

    def _extreme(self, i: Instruction, a: Combination, b: Combination, constant: Sequence[bool]) -> Combination:
        """With a fixed number a clamp; else one operation, in whose ``a - b`` what both share cancels."""
        largest = i.kind == "maximum"
        if any(constant):
            value, limit = (a, b) if constant[1] else (b, a)
            limit = limit.matrix[:, 0]
            none = torch.full_like(limit, -torch.inf if largest else torch.inf)
            limits = (limit, -none) if largest else (-none, limit)
            return self._node("function", i.size, value, relaxation("clamp", limits))
        rule: Rule = "maximum" if largest else "minimum"
        return self._node(rule, i.size, _joined([_sum(a, b, -1.0), a, b]), relaxation("relu"))


def _is_constant(a: Combination) -> bool:
    return a.matrix.shape[-1] == 1


def _joined(parts: Sequence[Combination]) -> Combination:
    """One after the other."""
    columns = max(part.matrix.shape[-1] for part in parts)
    rows = [part.padded(columns) for part in parts]
    copies = torch.cat([torch.zeros(len(r[0]), 1, dtype=torch.bool) if r.copies is None else r.copies for r in rows])
    matrix, sizes = torch.cat([r.matrix for r in rows]), torch.cat([r.sizes for r in rows])
    return Combination(matrix, sizes, max(r.error for r in rows), copies)


def _sum(a: Combination, b: Combination, sign: float = 1.0) -> Combination:
    """``a + sign b``."""
    columns = max(a.matrix.shape[-1], b.matrix.shape[-1])
    a, b = a.padded(columns), b.padded(columns)
    return Combination(torch.add(a.matrix, b.matrix, alpha=sign), a.sizes + b.sizes, max(a.error, b.error) + gamma(1))


def _scaled(a: Combination, constant: Combination) -> Combination:
    """A multiple of each row."""
    value = constant.matrix
    return Combination(a.matrix * value, a.sizes * value.abs() + _tiny(a.sizes), a.error + gamma(1))


def _tiny(sizes: Tensor) -> Tensor:
    """What absorbs underflow, where there is an entry at all."""
    return TINY * (sizes > 0)
