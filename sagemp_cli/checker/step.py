"""One step of a program on a set of states, in balls: every value is a list of rows, one for each entry.

Rows are those of :mod:`~sagemp_cli.checker.zonotope`, over the states, the disturbances and one variable for each
recorded relaxation. What is linear acts on rows. A nonlinear operation takes the next recorded relaxations, *proves*
that the recorded lines and radii enclose the function over the operand's own bounds, which are those of its row and of
its interval (:mod:`~sagemp_cli.checker.beside`), and gives its variables the radii that it found itself. So the record
is never trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import repeat
from typing import NamedTuple

from sagemp_cli.checker.angle import Turned, angle_excess
from sagemp_cli.checker.balls import arb, arb_mat, ball
from sagemp_cli.checker.beside import Beside
from sagemp_cli.checker.float32 import around, of_sums, sizes
from sagemp_cli.checker.functions import FUNCTIONS, SOFTPLUS
from sagemp_cli.checker.loop import Loop
from sagemp_cli.checker.points import functions_of
from sagemp_cli.checker.program import Instruction
from sagemp_cli.checker.ranges import Range
from sagemp_cli.checker.rows import (
    ZERO,
    Row,
    Rows,
    Weights,
    added,
    column,
    combined,
    joined,
    keeps_linear,
    repeated,
    subtracted,
    times,
    transformed,
)
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.checker.zonotope import Zonotope

_UNDERFLOW = 2.0**-800  # a recorded radius may be 0 instead; what goes on is the radius found here

Bounds = tuple[arb, arb]
"""Lower and upper end."""

Excess = Callable[[arb, arb, arb], tuple[arb, arb]]
"""Bounds of ``f(x) - slope x`` for all x of ``[lower, upper]``."""


class Entry(NamedTuple):
    """A recorded relaxation: slope (of a product the scale), offset, radius; or a direction's cosine, sine and 0."""

    slope: float
    offset: float
    radius: float


class Step:
    """The values of one step.

    Args:
        loop: what is evaluated.
        k: which step.
        states: the set at its beginning.
        box: bounds of the states, which the set may reach past; None: of them intervals know nothing, and say no more
            than what functions give whatever the state.
        record: recorded relaxations in order.
    """

    def __init__(
        self, loop: Loop, k: int, states: Zonotope, box: Sequence[Bounds] | None, record: Sequence[Entry]
    ) -> None:
        self._known = box is not None
        inputs = [None] * loop.folded.program.states if box is None else box
        self._beside = Beside(loop.folded.combinations, [*inputs, *loop.given(k)])
        self._loop, self._k, self._states, self._record = loop, k, states, record
        self._center = arb_mat(len(states.center), 1, states.center)
        program = loop.folded.program
        self._first = self._next = 1 + program.states + program.disturbances  # column of the first relaxation
        self._inputs = self._first
        self._taken = 0
        self._values: dict[int, Rows] = {}

    def run(self) -> tuple[Rows, Rows | None, Rows | None]:
        """Rows of the next state, of the control, and of the deviation.

        Raises:
            Unproved: a recorded relaxation is wrong.
        """
        folded = self._loop.folded
        for slot, instruction in enumerate(folded.program.instructions):
            if folded.known[slot]:
                continue
            self._values[slot] = self._result(slot, instruction)
            for r in instruction.reads:
                if folded.last[r] == slot:
                    self._values.pop(r, None)
        program = folded.program
        control, deviation = (self._rows(slot) if slot >= 0 else None for slot in (program.control, program.deviation))
        return self._rows(program.next), control, deviation

    def bounds(self, rows: Rows) -> list[tuple[arb, arb]]:
        """Lower and upper bound of the value of every row."""
        radii = self._states.radii(joined(rows, self._inputs))
        return [((row[0] - r).lower(), (row[0] + r).upper()) for row, r in zip(rows, radii, strict=True)]

    def output(self, slot: int, bounds: Sequence[Bounds]) -> list[Bounds]:
        """Bounds of an output, from those of its rows."""
        return _within(bounds, self._beside.output(slot))

    def image(self, rows: Rows) -> Zonotope:
        """The set of the values of rows, over all variables of the step."""
        return self._states.image(joined(rows, self._first + self._loop.folded.program.variables))

    def _rows(self, slot: int) -> Rows:
        """A slot's value; numbers are rows of one entry."""
        folded = self._loop.folded
        if slot in folded.constants:
            return column(folded.constants[slot])
        if slot not in self._values:
            self._values[slot] = self._loop.rows(slot, self._k, self._center)
        return self._values[slot]

    def _result(self, slot: int, instruction: Instruction) -> Rows:
        folded, kind = self._loop.folded, instruction.kind
        operands = [self._rows(r) for r in instruction.reads]
        given = [folded.program.depends[r] for r in instruction.reads]
        if keeps_linear(folded.program, slot):
            return combined(instruction, operands, folded.weights.get(slot))
        within = self._beside.operands(slot)
        before = [list(side) for side in within]
        if kind == "mul":
            rows = self._product(*_pair(repeated(operands)), within)
        elif kind == "div":
            rows = self._quotient(operands[0], operands[1], within, numbers=not given[0])
        elif kind in ("maximum", "minimum"):
            rows = (
                self._extreme(kind, operands[0], operands[1], within)
                if all(given)
                else self._limited(kind, operands, given, within)
            )
        elif kind == "logaddexp":
            rows = self._log_of_sum(*_pair(repeated(operands)), within)
        elif kind == "atan2":
            rows = self._angle(*_pair(repeated(operands)), within)
        elif kind == "where":
            condition, left, right = repeated(operands)
            rows = self._choice(condition, left, right, within)
        elif kind == "float32_linear":
            rows = self._sums(folded.weights[slot], operands[0], within)
        else:
            functions = functions_of(instruction, len(operands[0]))
            rows = self._relaxed(kind, operands[0], [f.excess for f in functions], within[0])
        self._beside.know(slot, instruction, within if self._known else before)
        return rows

    def _relaxed(self, name: str, rows: Rows, functions: Sequence[Excess], within: list[Range]) -> Rows:
        """A function of the value of every row; what is known of the values is narrowed to what its rows say too."""
        entries = self._take(len(rows))
        slopes = [ball(e.slope) for e in entries]
        bounds = _within(self.bounds(rows), within)
        within[:] = bounds
        found = [f(s, low, high) for f, s, (low, high) in zip(functions, slopes, bounds, strict=True)]
        return [
            self._put(name, times(row, slope), bounds, entry)
            for row, slope, bounds, entry in zip(rows, slopes, found, entries, strict=True)
        ]

    def _sums(self, weights: Weights, rows: Rows, within: Sequence[list[Range]]) -> Rows:
        """Sums of products in float32: the exact ones, and an error that the sizes of what is summed bound."""
        ends = _within(self.bounds(rows), within[1])
        within[1][:] = ends
        functions = [partial(_around, of_sums(size, len(rows))) for size in sizes(*weights, ends)]
        return self._relaxed("float32_linear", transformed(weights, rows), functions, within[0])

    def _product(self, left: Rows, right: Rows, within: Sequence[list[Range]] | None) -> Rows:
        """Product of values whose deviations X and Y may be correlated: ``X Y = (P^2 - M^2) / 4`` with
        ``P = l X + Y / l`` and ``M = l X - Y / l``, for the recorded scale l as for any other.
        """
        entries = self._take(len(left))
        if not all(e.slope > 0 for e in entries):
            raise Unproved("the scale of a product must be positive")
        scales = [ball(e.slope) for e in entries]
        plus, minus = self._ends(left, right, scales)
        if within is not None:
            x, y = (
                [_far(row, b) for row, b in zip(*side, strict=True)] for side in self._narrowed(left, right, within)
            )
            most = [(a * s + b / s).upper() for a, b, s in zip(x, y, scales, strict=True)]
            plus, minus = ([a.min(b) for a, b in zip(side, most, strict=True)] for side in (plus, minus))
        out = []
        for a, b, p, m, entry in zip(left, right, plus, minus, entries, strict=True):
            row = added(times(a, b[0]), times(b, a[0]))
            row[0] = a[0] * b[0]
            out.append(self._put("product", row, (-(m**2) / 4, p**2 / 4), entry))
        return out

    def _narrowed(self, left: Rows, right: Rows, within: Sequence[list[Range]]) -> list[tuple[Rows, list[Bounds]]]:
        """Both factors with their bounds; what is known of their values is narrowed to them."""
        found = self.bounds([*left, *right])
        sides = _within(found[: len(left)], within[0]), _within(found[len(left) :], within[1])
        within[0][:], within[1][:] = sides
        return list(zip((left, right), sides, strict=True))

    def _ends(self, left: Rows, right: Rows, scales: Sequence[arb]) -> tuple[list[arb], list[arb]]:
        """Radii of ``P = l X + Y / l`` and ``M = l X - Y / l``, X and Y the deviations of rows."""
        pairs = [(times(a, s), times(b, 1 / s)) for a, b, s in zip(left, right, scales, strict=True)]
        both = [added(x, y) for x, y in pairs] + [subtracted(x, y) for x, y in pairs]
        radii = self._states.radii(joined(both, self._inputs))
        return radii[: len(pairs)], radii[len(pairs) :]

    def _quotient(self, left: Rows, right: Rows, within: Sequence[list[Range]], *, numbers: bool) -> Rows:
        """``a / b = q + (a - q b) (1 / b)``, for q near the centres' quotient as for any other; of a number a only
        ``a (1 / b)``.
        """
        known = within[1][: len(right)]  # one divisor may be that of all entries
        inverse = self._relaxed("reciprocal", right, [FUNCTIONS["reciprocal"].excess] * len(right), known)
        within[1][:] = known * (len(within[1]) // len(known))
        left, right, inverse = repeated([left, right, inverse])
        if numbers:
            return [times(b, a[0]) for a, b in zip(left, inverse, strict=True)]
        near = [(a[0] / b[0]).mid() for a, b in zip(left, right, strict=True)]
        q = [ball(float(v)) if v.is_finite() else ZERO for v in near]
        rest = [subtracted(a, times(b, v)) for a, b, v in zip(left, right, q, strict=True)]
        out = self._product(rest, inverse, None)
        for row, v in zip(out, q, strict=True):
            row[0] = row[0] + v
        return out

    def _extreme(self, kind: str, left: Rows, right: Rows, within: Sequence[list[Range]]) -> Rows:
        """``maximum(a, b) = b + relu(a - b)`` and ``minimum(a, b) = a - relu(a - b)``."""
        left, right = repeated([left, right])
        rest = [subtracted(a, b) for a, b in zip(left, right, strict=True)]
        above = self._relaxed("relu", rest, [FUNCTIONS["relu"].excess] * len(rest), within[2])
        if kind == "maximum":
            return [added(b, c) for b, c in zip(right, above, strict=True)]
        return [subtracted(a, c) for a, c in zip(left, above, strict=True)]

    def _log_of_sum(self, left: Rows, right: Rows, within: Sequence[list[Range]]) -> Rows:
        """``log(exp(a) + exp(b)) = b + softplus(a - b)``."""
        rest = [subtracted(a, b) for a, b in zip(left, right, strict=True)]
        above = self._relaxed("softplus", rest, [SOFTPLUS.excess] * len(rest), within[2])
        return [added(b, c) for b, c in zip(right, above, strict=True)]

    def _limited(
        self, kind: str, operands: Sequence[Rows], given: Sequence[bool], within: Sequence[list[Range]]
    ) -> Rows:
        """The same with numbers on one side: a clamp."""
        value, limits = repeated(operands if given[0] else operands[::-1])
        return self._relaxed("clamp", value, [_limit(kind, c[0]) for c in limits], within[0 if given[0] else 1])

    def _angle(self, y: Rows, x: Rows, within: Sequence[list[Range]]) -> Rows:
        """``atan2(y, x)``, around the recorded line of how far the point is across the recorded direction."""
        entries, directions = self._take(len(y)), self._take(len(y))
        cosines, sines = [ball(d.slope) for d in directions], [ball(d.offset) for d in directions]
        turns = list(zip(y, x, cosines, sines, strict=True))
        across = [subtracted(times(b, c), times(a, s)) for b, a, c, s in turns]
        along = [added(times(a, c), times(b, s)) for b, a, c, s in turns]
        v, u = self.bounds(across), self.bounds(along)
        scales = [_ratio(u[i][1] - u[i][0], v[i][1] - v[i][0]) for i in range(len(y))]
        plus, minus = self._ends(across, along, scales)
        sides = (_within(self.bounds(rows), known) for rows, known in zip((y, x), within, strict=True))
        boxes = list(zip(*sides, strict=True))
        out = []
        for i, entry in enumerate(entries):
            turned = Turned(cosines[i], sines[i], v[i], u[i], across[i][0], along[i][0], plus[i], minus[i])
            slope = ball(entry.slope)
            of_y, of_x = boxes[i]
            found = angle_excess(slope, of_y, of_x, turned)
            out.append(self._put("atan2", times(across[i], slope), found, entry))
        return out

    def _choice(self, condition: Rows, left: Rows, right: Rows, within: Sequence[list[Range]]) -> Rows:
        """``b`` and, where c is positive, ``d = a - b``; where the record says that it is known which, a or b itself.

        Around ``s d``, s the recorded slope, what is left is ``(1 - s) d`` where c is positive and ``-s d`` elsewhere;
        on either side d is ``r c + rest`` for the recorded ratio r as for any other, c between 0 and its own end.
        """
        entries, beside = self._take(len(left)), self._take(len(left))
        ratios = [ball(e.slope) for e in beside]
        rows = [subtracted(a, b) for a, b in zip(left, right, strict=True)]
        rest = [subtracted(d, times(c, r)) for d, c, r in zip(rows, condition, ratios, strict=True)]
        c = _within(self.bounds(condition), within[0])
        within[0][:] = c
        d, free = _within(self.bounds(rows), within[3]), self.bounds(rest)
        out = []
        for i, entry in enumerate(entries):
            if beside[i].offset:
                first = beside[i].offset > 0
                if not (c[i][0] > 0 if first else c[i][1] <= 0):
                    raise Unproved("a condition is not decided as it is recorded")
                out.append(self._put("where", list(left[i] if first else right[i]), (ZERO, ZERO), entry, offset=False))
                continue
            slope = ball(entry.slope)
            ends = []
            for share, end in ((1 - slope, c[i][1].max(ZERO)), (-slope, c[i][0].min(ZERO))):
                reach = ratios[i] * end
                low, high = free[i][0] + reach.min(ZERO), free[i][1] + reach.max(ZERO)
                low, high = low.max(d[i][0]), high.min(d[i][1])
                if not low > high:  # else nothing is on this side
                    ends += [share * low, share * high]
            if not ends:
                raise Unproved("no value of a condition is left")
            least, most = ends[0], ends[0]
            for end in ends[1:]:
                least, most = least.min(end), most.max(end)
            row = added(right[i], times(rows[i], slope))
            out.append(self._put("where", row, (least, most), entry))
        return out

    def _take(self, count: int) -> Sequence[Entry]:
        entries = self._record[self._taken : self._taken + count]
        self._taken += count
        if len(entries) != count:
            raise Unproved("the step takes more relaxations than are recorded")
        return entries

    def _put(self, name: str, row: Row, bounds: tuple[arb, arb], entry: Entry, *, offset: bool = True) -> Row:
        """Add what lies within bounds to a row: the recorded offset, if it has one, and a new variable around it."""
        least, most = bounds
        middle = ball(entry.offset) if offset else ZERO
        radius = (most - middle).max(middle - least).upper()
        if not (radius <= ball(entry.radius) or radius <= ball(_UNDERFLOW)):
            raise Unproved(
                f"a recorded relaxation of '{name}' is wrong: its radius is {float(radius):.9g}, not {entry.radius:.9g}"
            )
        row[0] = row[0] + middle
        row += repeat(ZERO, self._next - len(row))
        row.append(radius)
        self._next += 1
        return row


def _around(error: arb, slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
    return around(slope, lower, upper, error)


def _within(bounds: Sequence[Bounds], known: Sequence[Range]) -> list[Bounds]:
    """Bounds of rows, within intervals."""
    return [a if b is None else (a[0].max(b[0]), a[1].min(b[1])) for a, b in zip(bounds, known, strict=True)]


def _far(row: Row, bounds: Bounds) -> arb:
    """How far a value within bounds may be from a row's first entry."""
    return (bounds[1] - row[0]).max(row[0] - bounds[0]).upper()


def _limit(kind: str, c: arb) -> Excess:
    """``max(x, c) = c + relu(x - c)``, or ``min(x, c) = x - relu(x - c)``."""
    relu = FUNCTIONS["relu"]

    def above(slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
        least, most = relu.excess(slope, lower - c, upper - c)
        shift = c * (1 - slope)
        return least + shift, most + shift

    def below(slope: arb, lower: arb, upper: arb) -> tuple[arb, arb]:
        least, most = relu.excess(1 - slope, lower - c, upper - c)
        shift = c * (1 - slope)
        return shift - most, shift - least

    return above if kind == "maximum" else below


def _ratio(a: arb, b: arb) -> arb:
    """A number near the root of a quotient; 1 where there is none."""
    root = (a / b).sqrt().mid()
    return root if root.is_finite() and root > 0 else arb(1)


def _pair(operands: Sequence[Rows]) -> tuple[Rows, Rows]:
    """Two operands."""
    first, second = operands
    return first, second
