"""What a file claims, in full and in units: for people who must see at a glance that it is an easier problem.

Everything here is read off the numbers that a check is about: the sets, the scene, the program, the stored bounds.
What is only said by the file and proved by nothing (its experiment, names, seconds) is kept apart.

Longer than other files: whether the claim is told in full is to be seen in one place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sagemp_cli.checker.between import CONTINUOUS, SAMPLES
from sagemp_cli.checker.document import Document
from sagemp_cli.checker.equations import (
    Names,
    control_equations,
    equations,
    margin_equations,
    matrix_of,
    rate_equations,
)
from sagemp_cli.checker.lag import Lag
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.program import FLOAT32, MATRICES, Program
from sagemp_cli.checker.requirement import Required

_NETWORK = 8  # rows and columns from which on a matrix is called a network's
_MOST_REFERENCES = 12
_ARITHMETIC = (
    "float32 where the equations say float32: IEEE rounding, sums in any order, functions to 8 units in the last place "
    "(docs/program.md); real elsewhere"
)
_MOST_EQUATIONS, _LONGEST_EQUATION = 24, 160  # of an ODE that is printed in full


def claim_lines(document: Document, title: str) -> list[str]:
    """The claim under a title, and what the file only says, for people."""
    rows, said = claim_rows(document), said_rows(document)
    width = max(len(label) for label, _ in (*rows, *said))
    parts = ((title, rows), ("this is said by the file, not proved:", said))
    return [line for name, some in parts for line in (name, *(f"  {label:{width}}  {text}" for label, text in some))]


def claim_rows(document: Document) -> list[tuple[str, str]]:
    """What a check is about, as pairs of what and how much."""
    safe, sets = document.safe, document.sets
    names, units = document.state_names, document.state_units
    w_names = disturbance_names(document)
    rows = [
        ("for", _times(document)),
        *([("between", _between(document))] if document.constraints else []),
        ("X_I", _box(*sets[0].corners(), names, units)),
        ("W", _box(*sets[1].corners(), w_names, [""] * len(w_names))),
        *([("w enters", text) for text in [_entrance(document)] if text] if document.ode is None else []),
        *(_models(document) if document.ode is None else _ode(document, document.ode)),
    ]
    if any(i.kind in FLOAT32 for program in document.programs for i in program.instructions):
        rows.append(("arithmetic", _ARITHMETIC))
    tubes = document.tubes
    safe_ones = [r for r, v in enumerate(tubes["verdict"]) if v == "SAFE"] or list(range(len(tubes["verdict"])))
    rows.append(("proves", _aims(document)))
    if safe.workspace is not None:
        places = [names[i] for i in document.position], [units[i] for i in document.position]
        rows.append(("workspace", _box(*safe.workspace, *places)))
    rows += [("obstacle", _obstacle(o)) for o in safe.obstacles]
    rows += [row for one in document.requirements for row in _requirement(document, one)]
    if document.requirements:
        programs = ", ".join(one.margins.fingerprint()[:16] for one in document.requirements)
        rows.append(("their programs", f"sha256 {programs}"))
    if safe.goal is not None:
        rows.append(("goal at K" if document.ode is None else "goal at K dt", _box(*safe.goal, names, units)))
    if document.control_names and safe_ones:
        lower, upper = tubes["control_lower"][safe_ones].min((0, 1)), tubes["control_upper"][safe_ones].max((0, 1))
        rows.append(("controls", _box(lower, upper, document.control_names, document.control_units)))
    if tubes["references"] is not None:
        rows += [
            (f"reference {r}", f"from {_point(reference[0], names)} to {_point(reference[-1], names)}")
            for r, reference in enumerate(tubes["references"][:_MOST_REFERENCES])
        ]
        if len(tubes["references"]) > _MOST_REFERENCES:
            rows.append(("references", f"{len(tubes['references']) - _MOST_REFERENCES} more"))
    if document.ode is not None:
        rows.append(("how it is proved", _method(document)))
    return rows


def _times(document: Document) -> str:
    """What a claim quantifies over, and when it holds."""
    steps, dt = document.horizon, document.dt
    if document.ode is None or dt is None:
        return f"all starts in X_I and all w_k in W, k = 0, ..., K - 1; K = {steps} steps"
    return (
        f"all starts x(0) in X_I, all measurable w(t) in W and all times t in [0, K dt] = [0, {steps * dt:.6g}] s, "
        f"K = {steps} periods of dt = {dt!r} s"
    )


def _ode(document: Document, ode: Flow) -> list[tuple[str, str]]:
    """The right-hand side, in full if it is not long, and how the control is held."""
    rate = rate_equations(ode.rate, _disturbed_names(document))
    if len(rate) > _MOST_EQUATIONS or max(map(len, rate), default=0) > _LONGEST_EQUATION:
        chain = _chain(ode.rate, sorted(_behind(ode.rate, ode.rate.next)))
        rate = [f"x'(t) = f(x(t), u_k) + w(t), f {chain}; its equations: sagemp inspect --equations"]
    rows = [("ODE", text) for text in rate]
    rows.append(("rate program", f"sha256 {ode.rate.fingerprint()[:16]}"))
    (control,) = document.programs
    if control.control >= 0:
        chain = _chain(control, sorted(_behind(control, control.control)))
        rows.append(("control", f"{_held(ode.lag)}; {chain}"))
        rows.append(
            ("control program", f"sha256 {control.fingerprint()[:16]}, its equations: sagemp inspect --equations")
        )
    return rows


def _held(lag: Lag | None) -> str:
    """When the control is measured, and when it is in force."""
    if lag is None:
        return "of x(t_k) at t_k = k dt, held on [t_k, t_k + dt]"
    measured = f"of x(t_k - j_k), t_k = k dt, j_k {_seconds(lag.jitter)}" if lag.jitter[1] else "of x(t_k), t_k = k dt"
    late = f"t_k + d_k, d_k {_seconds(lag.delay)}," if lag.delay[1] else "t_k"
    first = " = ".join(name for name, side in (("d_0", lag.delay), ("j_0", lag.jitter)) if side[1])
    return f"{measured}; in force from {late} on until the next one is; whatever each of them is, but {first} = 0"


def _seconds(sides: tuple[float, float]) -> str:
    return f"= {sides[0]!r} s" if sides[0] == sides[1] else f"in [{sides[0]!r}, {sides[1]!r}] s"


def _method(document: Document) -> str:
    counts = np.bincount(document.cell_ode, minlength=len(document.odes)).tolist()
    ways = []
    for ode, count in zip(document.odes, counts, strict=True):
        parts = "each period as a whole" if ode.substeps == 1 else f"each period in {ode.substeps} parts"
        of = f"{count} cell{'s' * (count != 1)}: " if len(counts) > 1 else ""
        ways.append(f"{of}{parts}, Taylor polynomials of degree {ode.order}")
    return (
        f"{'; '.join(ways)}; with proved remainders, {document.parts} boxes along each part; {sum(counts)} "
        f"cell{'s' * (sum(counts) != 1)}"
    )


def _names(document: Document) -> Names:
    return Names(document.state_names, document.control_names, disturbance_names(document))


def _disturbed_names(document: Document) -> Names:
    """The same, without names of disturbances that are always 0."""
    tubes, names = document.tubes, _names(document)
    sides = zip(names.disturbances, tubes["disturbance_lower"], tubes["disturbance_upper"], strict=True)
    return Names(names.states, names.controls, [name if low or high else "" for name, low, high in sides])


def _between(document: Document) -> str:
    """What is claimed of the time between two samples."""
    if document.between == SAMPLES:
        return "samples: the safe set is kept at the samples; of the time between them NOTHING is claimed"
    if document.between == CONTINUOUS and not document.safe.names:
        return "continuous: every solution of the ODE does what is required, between the samples too"
    if document.between == CONTINUOUS:
        return "continuous: the safe set is kept at all of these times, by every solution of the ODE; the goal at K dt"
    return (
        f"segments: the safe set is kept over the whole of every step, on the straight line from x_k to x_k+1 "
        f"({document.parts} parts a step); the goal at step K"
    )


def said_rows(document: Document) -> list[tuple[str, str]]:
    """What the file says of itself and nothing proves."""
    robot = document.config.get("dynamics")
    said = {
        **document.said,
        "robot": str(robot.get("name", "?"))[:80] if isinstance(robot, Mapping) else None,
        "between samples": None if document.dt is None or document.ode is not None else f"{document.dt:.6g} s",
        "names, units": "of states and controls",
    }
    return [(key, f"{value:.6g}" if isinstance(value, float) else str(value)) for key, value in said.items()
            if value is not None]  # fmt: skip


def equation_lines(document: Document) -> list[str]:
    """The programs of a file as equations."""
    names, out = _names(document), list[str]()
    if document.ode is not None:
        out += [f"u_k, {_held(document.ode.lag)}, of that state x:", *control_equations(document.programs[0], names)]
        out += ["x'(t), at all times:", *rate_equations(document.ode.rate, _disturbed_names(document))]
    out += [f"{label}: {text}" for one in document.requirements for label, text in _requirement(document, one)]
    for i, program in enumerate(document.programs if document.ode is None else ()):
        if len(document.programs) > 1:
            steps = np.flatnonzero(document.step_program == i)
            out.append(f"steps {', '.join(map(str, steps[:8]))}{', ...' if len(steps) > 8 else ''}:")
        out += equations(program, names)
    if document.true_model is not None:
        out += ["the analytical model, by way of the network:", *equations(document.true_model.programs[0], names)]
    if document.lookahead:
        n = len(names.states)
        out.append(f"ref at step k: states k+1 to k+{document.lookahead} of the reference, {n} entries each, K at most")
    return out


def disturbance_names(document: Document) -> list[str]:
    """``w_x`` for each state x if there are as many, else numbers."""
    d, names = len(document.tubes["disturbance_lower"]), document.state_names
    return [f"w_{name}" for name in names] if d == len(names) else [f"w_{i}" for i in range(d)]


def _box(lower: Sequence[float], upper: Sequence[float], names: Sequence[str], units: Sequence[str]) -> str:
    """Intervals with names and units; what has no ends is left out."""
    parts = []
    for a, b, name, unit in zip(lower, upper, names, units, strict=True):
        low, high = float(a), float(b)
        unit = f" {unit}" if unit not in ("", "1") else ""
        if low == high:
            parts.append(f"{name} {low:.6g}{unit}")
        elif low == -np.inf and high == np.inf:
            continue
        elif high == np.inf:
            parts.append(f"{name} from {low:.6g}{unit}")
        elif low == -np.inf:
            parts.append(f"{name} up to {high:.6g}{unit}")
        else:
            parts.append(f"{name} {low:.6g} to {high:.6g}{unit}")
    return ", ".join(parts) or "no limits"


def _point(values: np.ndarray, names: Sequence[str]) -> str:
    return ", ".join(f"{name} {v:.4g}" for name, v in zip(names, values.tolist(), strict=True))


def _obstacle(obstacle: tuple[str, str, list[float], Any]) -> str:
    name, kind, first, second = obstacle
    place = ", ".join(f"{v:.6g}" for v in first)
    if kind == "ball":
        return f"{name}: ball around ({place}), radius {second:.6g}"
    return f"{name}: block from ({place}) to ({', '.join(f'{v:.6g}' for v in second)})"


def _aims(document: Document) -> str:
    """What a verdict of SAFE says."""
    safe, asked = document.safe, document.requirements
    first, last = ("x_k", "x_K") if document.ode is None else ("x(k dt)", "x(K dt)")
    parts = [f"{first} stays in its tube"]
    if safe.workspace is not None:
        parts.append("in the workspace")
    if asked:
        parts.append(f"{len(asked)} requirement{'s hold' if len(asked) > 1 else ' holds'}")
    if safe.obstacles or not asked:
        parts.append(f"clear of {len(safe.obstacles)} obstacles" if safe.obstacles else "no obstacle is claimed")
    if safe.goal is not None or not asked:
        parts.append(f"{last} is in the goal" if safe.goal is not None else "no goal is claimed")
    return ", ".join(parts)


def _requirement(document: Document, one: Required) -> list[tuple[str, str]]:
    """What has to hold, and when: bounds as bounds, all else as equations."""
    label, when = f"requirement {one.name}", _interval(document, one)
    sides = _sides(one, len(document.state_names))
    if sides is not None:
        box = _box(*sides, document.state_names, document.state_units)
        return [(label, f"{when}: {box}" if one.every else f"{when}: not in the box {box}")]
    lines = margin_equations(one.margins, _names(document))
    sign, names = ">" if one.strict else ">=", [line.split(" = ")[0] for line in lines[-one.margins.controls :]]
    if one.margins.controls == 1:
        lines[-1] = f"{lines[-1].split(' = ', 1)[1]} {sign} 0"
    else:
        lines.append(f"{'all' if one.every else 'at each time one'} of {', '.join(names)} {sign} 0")
    return [(label, f"{when}: {lines[0]}"), *((label, line) for line in lines[1:])]


def _interval(document: Document, one: Required) -> str:
    """When a requirement has to hold, in words and seconds."""
    last, dt = document.horizon, document.dt
    assert dt is not None
    if (one.first, one.last) == (0, last):
        return "at all these times"
    if one.first == one.last:
        return f"at t = {'K' if one.first == last else f'{one.first:.10g}'} dt = {one.first * dt:.6g} s"
    ends = f"{one.first:.10g} dt", "K dt" if one.last == last else f"{one.last:.10g} dt"
    return f"at all t in [{', '.join(ends)}] = [{one.first * dt:.6g}, {one.last * dt:.6g}] s"


def _sides(one: Required, n: int) -> tuple[list[float], list[float]] | None:
    """Of margins that are distances from faces of a box, that box; None of all others.

    All margins of a box that is to be kept are at least 0; of a box that is to be kept out of one is above 0.
    """
    i = one.margins.instructions[one.margins.control]
    if i.kind != "linear" or i.reads != (0,) or one.strict is one.every:
        return None
    lower, upper = [-np.inf] * n, [np.inf] * n
    for row, shift in zip(*matrix_of(i, n), strict=True):
        (places,) = np.nonzero(row)
        if len(places) != 1 or abs(row[places[0]]) != 1:
            return None
        place, rising = int(places[0]), bool(row[places[0]] > 0)
        side = lower if rising is one.every else upper
        if np.isfinite(side[place]):
            return None
        side[place] = float(-shift if rising else shift)
    return lower, upper


def _models(document: Document) -> list[tuple[str, str]]:
    """Where controls and the next state come from, of each program."""
    out = []
    for i, program in enumerate(document.programs):
        where = f" {i}" if len(document.programs) > 1 else ""
        behind = _behind(program, program.control) if program.control >= 0 else set()
        if behind:
            out.append((f"control{where}", _chain(program, sorted(behind))))
        out.append((f"step{where}", _chain(program, sorted(_behind(program, program.next) - behind))))
        out.append(
            (f"program{where}", f"sha256 {program.fingerprint()[:16]}, its equations: sagemp inspect --equations")
        )
    return out


def _behind(program: Program, slot: int) -> set[int]:
    """The slots that one is made of."""
    found: set[int] = set()
    todo = [slot]
    while todo:
        s = todo.pop()
        if s not in found:
            found.add(s)
            todo += program.instructions[s].reads
    return found


def _chain(program: Program, slots: Sequence[int]) -> str:
    """What is done there, in order; whether there are matrices as large as a network's."""
    words, constants, network = [], 0, False
    for slot in slots:
        instruction, width = program.instructions[slot], program.widths[slot]
        constants += len(instruction.constants)
        if instruction.kind in MATRICES:
            columns = program.widths[instruction.reads[0]]
            large = min(width, columns) > 1 and max(width, columns) >= _NETWORK
            network |= large
            words += [f"{width} x {columns}"] if large else []
        elif instruction.kind not in FLOAT32:
            words += [name for name, _ in program.relaxed[slot]]
    counted: list[list[Any]] = []
    for word in words:
        if counted and counted[-1][0] == word:
            counted[-1][1] += 1
        else:
            counted.append([word, 1])
    text = ", ".join(word if n == 1 else f"{n} {word}" for word, n in counted) or "linear"
    kind = "a network" if network else "formulas"
    return f"{kind} of {len(slots)} instructions and {constants} constants: {text}"


def _entrance(document: Document) -> str:
    """How w enters the next state, if as a fixed multiple."""
    texts = []
    for program in document.programs[:1]:
        found = disturbed(program)
        if found is None:
            return "not as fixed multiples (see the equations)"
        w = disturbance_names(document)
        for name, row in zip(document.state_names, found, strict=True):
            parts = [f"{v:.6g} {w[j]}" for j, v in enumerate(row) if v]
            if parts:
                texts.append(f"{name} + {' + '.join(parts)}")
    return ", ".join(texts) or "nowhere"


def disturbed(program: Program) -> np.ndarray | None:
    """The matrix ``(n, d)`` that multiplies w in the next state, rounded; None if w enters in another way."""
    found: list[np.ndarray | None] = []
    d, values = program.disturbances, _constants(program)
    for slot, instruction in enumerate(program.instructions):
        parts = [found[r] for r in instruction.reads]
        width, kind = program.widths[slot], instruction.kind
        nothing = np.zeros((width, d))
        if kind == "disturbance":
            found.append(np.eye(d))
        elif all(p is not None and not p.any() for p in parts):
            found.append(nothing)
        elif any(p is None for p in parts):
            found.append(None)
        else:
            found.append(_carried(program, slot, parts, values))  # type: ignore[arg-type]
    return found[program.next]


def _carried(
    program: Program, slot: int, parts: Sequence[np.ndarray], values: Sequence[np.ndarray | None]
) -> np.ndarray | None:
    """The same of an instruction of which an operand has w in it."""
    instruction, width = program.instructions[slot], program.widths[slot]
    kind = instruction.kind
    if kind == "pick":
        return parts[0][instruction.entries]
    if kind == "join":
        return np.concatenate(parts)
    if kind == "linear":
        return matrix_of(instruction, len(parts[0]))[0] @ parts[0]
    if kind == "neg":
        return -parts[0]
    if kind == "identity":
        return parts[0]
    if kind in ("add", "sub"):
        a, b = (np.broadcast_to(p, (width, p.shape[1])) for p in parts)
        return a + b if kind == "add" else a - b
    if kind in ("mul", "div"):
        numbers = [values[r] for r in instruction.reads]
        if kind == "mul" and numbers[0] is not None:
            return numbers[0][:, None] * parts[1]
        if numbers[1] is not None:
            return parts[0] / numbers[1][:, None] if kind == "div" else parts[0] * numbers[1][:, None]
    return None


def _constants(program: Program) -> list[np.ndarray | None]:
    """Values of the slots that are constant instructions."""
    return [i.constants if i.kind == "constant" else None for i in program.instructions]
