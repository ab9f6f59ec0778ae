"""Tampered certificates in continuous time: none is proved that is not a true one of what is printed.

Each mutant changes what a document says between the instants, of the ODE or of its period. Those that follow from no
proof by their making have to be rejected; of the others, one that is accepted has to hold: no solution of *its* ODE
leaves what it says at any time, and it is printed as another claim if its ODE is another one.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sagemp_cli.checker.check import check_document
from sagemp_cli.checker.claim import claim_rows
from sagemp_cli.checker.document import Document, read_document
from sagemp_cli.checker.ode import flow_of
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.scene import SafeSet

from .by_hand import run
from .continuous import FlowCase, flow_case

K, S, FINE = 3, 2, 16
CLEARLY = 1e-7

WANTED = {
    "box": 60, "remainder": 60, "drift": 40, "bend": 40, "begin": 30, "instant": 30, "figure": 20, "obstacle": 30,
    "no_number": 50, "shifted": 40, "swapped": 30, "wider": 30, "disturbance": 30, "period": 30, "division": 20,
    "rate": 60, "control": 30,
}  # fmt: skip
SOME_HOLD = ("shifted", "swapped", "wider", "period", "rate", "control")
"""Classes in which a mutant may be a true certificate."""

Mutant = Document | None
"""None: no program, or not one that the records fit; a file that says so is refused."""


class Truth:
    """A document and what solutions do."""

    def __init__(self, case: FlowCase, document: Document, rng: np.random.Generator) -> None:
        self.case, self.document, self.rng = case, document, rng

    @cached_property
    def own(self) -> list[np.ndarray]:
        return solutions(self.document, self.rng)

    def place(self) -> tuple[int, int, int, int]:
        return tuple(int(self.rng.integers(size)) for size in (2, K, S, 3))  # type: ignore[return-value]

    def within(self, c: int, k: int, j: int, i: int) -> np.ndarray:
        """One state of all solutions over a part, its end left out."""
        per = FINE // S
        first = k * FINE + j * per
        return self.own[c][:, first : first + per, i]


def solutions(
    document: Document, rng: np.random.Generator, count: int = 48, signal: np.ndarray | None = None
) -> list[np.ndarray]:
    """Of each cell, states ``(count, K FINE + 1, n)`` by Runge and Kutta's method, under switching signals or one."""
    tubes, ode, (control,) = document.tubes, document.ode, document.programs
    steps, h, found = document.horizon * FINE, document.dt / FINE, []
    low, high = tubes["disturbance_lower"], tubes["disturbance_upper"]
    n = len(low)
    nothing = np.zeros((count, n))
    for lower, upper in zip(tubes["cell_lower"], tubes["cell_upper"], strict=True):
        x = rng.uniform(size=(count, n))
        x[: count // 2] = x[: count // 2].round()
        x = lower + x * (upper - lower)
        switches = rng.choice([steps, FINE, FINE // S, 4, 1], count)
        sides = np.stack([np.repeat(rng.integers(0, 2, (steps, n)), every, axis=0)[:steps] for every in switches])
        w, states = low + sides * (high - low) if signal is None else signal[None], [x]
        with np.errstate(all="ignore"):
            for i in range(steps):
                if i % FINE == 0:  # the control alone: its program with that as the next state
                    u = output_of(control, x)

                def slope(x: np.ndarray, u: np.ndarray = u, w: np.ndarray = w[:, i]) -> np.ndarray:
                    return run(ode.rate, x, nothing, u) + w

                a = slope(x)
                b = slope(x + h / 2 * a)
                d = slope(x + h / 2 * b)
                x = x + h / 6 * (a + 2 * b + 2 * d + slope(x + h * d))
                states.append(x)
        found.append(np.stack(states, 1))
    return found


def output_of(control: Program, x: np.ndarray) -> np.ndarray:
    made = dataclasses.replace(control, next=control.control)
    return run(made, x, np.zeros((len(x), control.disturbances)))


def require_true(document: Document, states: list[np.ndarray]) -> None:
    """No solution is outside of what the document says, at any time."""
    tubes, flow, per, slack = document.tubes, document.flow, FINE // S, 1e-8
    w = tubes["disturbance_upper"] - tubes["disturbance_lower"]
    s = (np.arange(per) / per)[:, None]
    for c, path in enumerate(states):
        at = path[:, ::FINE]
        assert (tubes["tube_lower"][c] - slack <= at).all() and (at <= tubes["tube_upper"][c] + slack).all()
        pieces = path[:, :-1].reshape(len(path), K, S, per, 3)
        lower, upper = flow["lower"][c][:, :, None], flow["upper"][c][:, :, None]
        assert (lower - slack <= pieces).all() and (pieces <= upper + slack).all()
        begin = pieces[:, :, 1:, 0]
        assert (flow["inner_lower"][c] - slack <= begin).all() and (begin <= flow["inner_upper"][c] + slack).all()
        ends = path[:, ::per]
        first, last = (side.reshape(len(path), K, S, 1, 3) for side in (ends[:, :-1], ends[:, 1:]))
        bulge = s * (1 - s) * (flow["curve"][c][:, :, None] + document.dt / S * w) + 2 * flow["drift"][c][:, :, None]
        assert (np.abs(pieces - first - s * (last - first)) <= bulge + slack).all()
        assert not hits(document.safe, path[..., list(document.position)]), "a solution that was called safe"


def hits(safe: SafeSet, path: np.ndarray) -> bool:
    low, high = map(np.array, safe.workspace)
    found = (path < low).any() or (path > high).any()
    for _, kind, first, second in safe.obstacles:
        if kind == "ball":
            found |= (np.linalg.norm(path - first, axis=-1) < second).any()
        else:
            found |= ((path > first) & (path < second)).all(-1).any()
    return bool(found)


def flow_with(document: Document, name: str, change: Callable[[np.ndarray], Any]) -> Document:
    """With one of the arrays between the instants changed in place, or replaced."""
    array = document.flow[name].copy()
    made = change(array)
    return dataclasses.replace(document, flow={**document.flow, name: array if made is None else made})


def tubes_with(document: Document, name: str, change: Callable[[np.ndarray], Any]) -> Document:
    array = document.tubes[name].copy()
    change(array)
    return dataclasses.replace(document, tubes={**document.tubes, name: array})


def put(place: Any, value: Any) -> Callable[[np.ndarray], Any]:
    def change(array: np.ndarray) -> None:
        array[place] = value(array[place]) if callable(value) else value

    return change


def ode_with(document: Document, **changes: Any) -> Mutant:
    """With another rate, control, period, order or number of parts; None if that is refused while it is read."""
    given = {"control": document.programs[0], "rate": document.ode.rate, "period": document.dt,
             "substeps": document.ode.substeps, "order": document.ode.order} | changes  # fmt: skip
    try:
        ode = flow_of(given["control"], given["rate"], **{n: given[n] for n in ("period", "substeps", "order")})
    except ValueError:
        return None
    made = dataclasses.replace(document, odes=(ode,), programs=(given["control"],), dt=given["period"])
    return made if ode.step.relaxations == document.relaxations["slope"].shape[-1] else None


# -- classes whose mutants are none of them proved ---------------------------------------------------------------------


def box(t: Truth) -> Iterator[Mutant]:
    """X ends where a solution is."""
    while True:
        *where, i = t.place()
        x = t.within(*where, i)
        side, face = ("upper", x.max() - CLEARLY) if t.rng.random() < 0.5 else ("lower", x.min() + CLEARLY)
        yield flow_with(t.document, side, put((*where, i), face))


def remainder(t: Truth) -> Iterator[Mutant]:
    """R leaves out a fifth of what it held, more than it was guessed too wide; or is moved, or turned round."""
    while True:
        place = t.place()
        low, high = (float(t.document.flow[f"remainder_{side}"][place]) for side in ("lower", "upper"))
        share = float(t.rng.uniform(0.2, 1.5)) * (high - low)
        side, value = ("upper", high - share) if t.rng.random() < 0.5 else ("lower", low + share)
        yield flow_with(t.document, f"remainder_{side}", put(place, value))


def drift(t: Truth) -> Iterator[Mutant]:
    """e is smaller than its own bound."""
    while True:
        place = t.place()
        if t.document.flow["drift"][place] > 1e-100:
            factor = float(t.rng.choice([t.rng.uniform(0.0, 0.98), 0.0, -1.0, 1e-3]))
            yield flow_with(t.document, "drift", put(place, lambda v, f=factor: v * f))


def bend(t: Truth) -> Iterator[Mutant]:
    """h^2 |c_2| is smaller than its bound."""
    while True:
        place = t.place()
        if t.document.flow["curve"][place] > 1e-100:
            factor = float(t.rng.choice([t.rng.uniform(0.0, 0.999), 0.0, -1.0, 1 - 1e-6]))
            yield flow_with(t.document, "curve", put(place, lambda v, f=factor: v * f))


def begin(t: Truth) -> Iterator[Mutant]:
    """The box at the beginning of a part leaves a solution out."""
    while True:
        c, k, _, i = t.place()
        x = t.within(c, k, 1, i)[:, 0]
        side, face = ("upper", x.max() - CLEARLY) if t.rng.random() < 0.5 else ("lower", x.min() + CLEARLY)
        yield flow_with(t.document, f"inner_{side}", put((c, k, 0, i), face))


def instant(t: Truth) -> Iterator[Mutant]:
    """So does the tube."""
    while True:
        c, _, _, i = t.place()
        k = int(t.rng.integers(K + 1))
        x = t.own[c][:, k * FINE, i]
        side, face = ("upper", x.max() - CLEARLY) if t.rng.random() < 0.5 else ("lower", x.min() + CLEARLY)
        yield tubes_with(t.document, f"tube_{side}", put((c, k, i), face))


def figure(t: Truth) -> Iterator[Mutant]:
    """A clearance or margin is larger than it is proved to be, or parts are fewer than it needs."""
    while True:
        grow = float(10.0 ** t.rng.uniform(-9, 0))
        name = str(t.rng.choice(["clearance", "goal_margin"]))
        yield tubes_with(t.document, name, put((0, int(t.rng.integers(3))), lambda v, g=grow: v + g))


def obstacle(t: Truth) -> Iterator[Mutant]:
    """A small ball where a solution is, at any time, or a disc that reaches it."""
    while True:
        c = int(t.rng.integers(2))
        p = t.own[c][int(t.rng.integers(48)), int(t.rng.integers(K * FINE)), :2]
        safe = t.document.safe
        if t.rng.random() < 0.5:
            disc = ("disc", "ball", p.tolist(), float(10.0 ** t.rng.uniform(-7, -2)))
        else:
            center = p + t.rng.normal(size=2)
            disc = ("disc", "ball", center.tolist(), float(np.linalg.norm(p - center)) + CLEARLY)
        yield dataclasses.replace(t.document, safe=dataclasses.replace(safe, obstacles=[disc, *safe.obstacles[1:]]))


def no_number(t: Truth) -> Iterator[Mutant]:
    """NaN or infinite, on the side that matters or the other."""
    while True:
        name = str(t.rng.choice(list(t.document.flow)))
        c, k, j, i = t.place()
        value = float(t.rng.choice([np.nan, np.inf, -np.inf]))
        part = () if t.document.flow[name].ndim < 4 else (0 if name.startswith("inner") else j,)
        yield flow_with(t.document, name, put((c, k, *part, i), value))


def disturbance(t: Truth) -> Iterator[Mutant]:
    """W is wider than what was proved; of the file alone, or of its config too."""
    while True:
        i, grow = int(t.rng.integers(3)), float(10.0 ** t.rng.uniform(-6, 0))
        wider = tubes_with(t.document, "disturbance_upper", put((i,), lambda v, g=grow: v + g))
        w = t.document.sets[1]
        second = [v + (grow if i == j else 0) for j, v in enumerate(w.second)]
        sets = t.document.sets[0], dataclasses.replace(w, second=second)
        both = t.rng.random() < 0.5
        yield dataclasses.replace(wider, sets=sets) if both else dataclasses.replace(t.document, sets=sets)
        yield wider


def division(t: Truth) -> Iterator[Mutant]:
    """Other parts or another degree, with the arrays that fit."""
    while True:
        if t.rng.random() < 0.5:
            yield ode_with(t.document, order=int(t.rng.choice([1, 3, 4])))
            continue
        parts = int(t.rng.choice([1, 4]))
        made = t.document
        for name, array in t.document.flow.items():
            if name.startswith("inner"):
                inner = array[:, :, :0] if parts == 1 else np.repeat(array, 3, axis=2)
                made = flow_with(made, name, lambda _, new=inner: new)
            elif array.ndim == 4:
                new = array[:, :, :1] if parts == 1 else np.repeat(array, 2, axis=2)
                made = flow_with(made, name, lambda _, new=new: new)
        yield ode_with(made, substeps=parts)


# -- classes in which one may hold -------------------------------------------------------------------------------------


def shifted(t: Truth) -> Iterator[Mutant]:
    """Arrays are those of the period or the part before or after."""
    while True:
        names = [n for n in t.document.flow if t.rng.random() < 0.3] or ["lower"]
        axis, by = (1, int(t.rng.choice([-1, 1]))) if t.rng.random() < 0.7 else (2, 1)
        made = t.document
        for name in names:
            made = flow_with(made, name, lambda a, axis=axis, by=by: np.roll(a, by, axis=axis))
        if any((made.flow[n] != t.document.flow[n]).any() for n in names):
            yield made


def swapped(t: Truth) -> Iterator[Mutant]:
    """Arrays are those of the other cell, or of another state."""
    while True:
        names = [n for n in t.document.flow if t.rng.random() < 0.3] or ["remainder_lower"]
        axis, made = (0 if t.rng.random() < 0.6 else -1), t.document
        for name in names:
            made = flow_with(made, name, lambda a, axis=axis: np.roll(a, 1, axis=axis))
        yield made


def wider(t: Truth) -> Iterator[Mutant]:
    """Bounds between the instants that say less: they hold, or their own consequences do not."""
    while True:
        place, grow = t.place(), float(10.0 ** t.rng.uniform(-12, 1))
        name = str(t.rng.choice(["lower", "upper", "curve", "drift", "remainder_lower", "remainder_upper"]))
        sign = -1 if name.endswith("lower") else 1
        yield flow_with(t.document, name, put(place, lambda v, g=grow, s=sign: v + s * g))


def period(t: Truth) -> Iterator[Mutant]:
    while True:
        change = float(t.rng.choice([-1, 1]) * 10.0 ** t.rng.uniform(-15, 0.3))
        yield ode_with(t.document, period=t.document.dt + change)


def changed(program: Program, rng: np.random.Generator, kinds: tuple[str, ...]) -> Program | None:
    """A constant, a kind, an operand or an entry is another one."""
    lines = list(program.instructions)
    first = 2 + (program.numbers > 0)
    slot = int(rng.integers(first, len(lines)))
    i = lines[slot]
    what = rng.random()
    if len(i.constants) and what < 0.7:
        constants = i.constants.copy()
        place = int(rng.integers(len(constants)))
        size = 10.0 ** rng.uniform(-10, 0.5)
        constants[place] = float(
            rng.choice([-constants[place], constants[place] + size, constants[place] * (1 - size)])
        )
        lines[slot] = dataclasses.replace(i, constants=constants)
    elif len(i.entries) and what < 0.7:
        lines[slot] = dataclasses.replace(i, entries=rng.integers(0, 3, len(i.entries)))
    elif i.reads and what < 0.85:
        reads = list(i.reads)
        reads[int(rng.integers(len(reads)))] = int(rng.integers(slot))
        lines[slot] = dataclasses.replace(i, reads=tuple(reads))
    elif len(i.reads) == 1 and not len(i.entries) and not len(i.constants):
        lines[slot] = dataclasses.replace(i, kind=str(rng.choice(kinds)))
    elif len(i.reads) == 2:
        lines[slot] = dataclasses.replace(i, kind=str(rng.choice(["add", "sub", "mul", "div", "maximum", "atan2"])))
    else:
        return None
    outputs = {n: s for n, s in (("next", program.next), ("control", program.control)) if s >= 0}
    sizes = {"states": program.states, "disturbances": program.disturbances, "numbers": program.numbers}
    try:
        made = Program.of(lines, outputs, **sizes)
    except ValueError:
        return None
    return None if made.fingerprint() == program.fingerprint() else made


ONE = ("sin", "cos", "neg", "tanh", "atan", "sigmoid", "relu", "identity", "exp", "abs")


def rate(t: Truth) -> Iterator[Mutant]:
    while True:
        made = changed(t.document.ode.rate, t.rng, ONE)
        if made is not None:
            yield ode_with(t.document, rate=made)


def control(t: Truth) -> Iterator[Mutant]:
    while True:
        made = changed(t.document.programs[0], t.rng, ONE)
        if made is not None:
            yield ode_with(t.document, control=made)


CLASSES = {
    f.__name__: f
    for f in (box, remainder, drift, bend, begin, instant, figure, obstacle, no_number, shifted, swapped, wider,
              disturbance, period, division, rate, control)
}  # fmt: skip


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> tuple[FlowCase, Document]:
    """Two cells, three periods of two parts each."""
    path = tmp_path_factory.mktemp("flow") / "certificate.h5"
    case = flow_case(path, horizon=K, substeps=S)
    document = read_document(path)
    assert check_document(document, path).answer == "VERIFIED"
    return case, document


def test_there_are_five_hundred_mutants_of_the_flow():
    assert set(CLASSES) == set(WANTED) and sum(WANTED.values()) >= 500


def test_what_was_certified_is_true_of_solutions(known):
    case, document = known
    require_true(document, solutions(document, np.random.default_rng(1)))


@pytest.mark.parametrize("name", CLASSES)
def test_no_mutant_of_the_flow_passes_that_does_not_hold(name, known):
    case, document = known
    truth = Truth(case, document, np.random.default_rng(len(name)))
    found: Counter[str] = Counter()
    for mutant in CLASSES[name](truth):
        if sum(found.values()) >= WANTED[name]:
            break
        if mutant is None or check_document(mutant, Path("mutant")).answer != "VERIFIED":
            found["rejected"] += 1
            continue
        found["true"] += 1
        same = mutant.ode is document.ode
        require_true(mutant, truth.own if same else solutions(mutant, truth.rng))
        assert same or claim_rows(mutant) != claim_rows(document), "an ODE that is printed as another one"
    print(name, dict(found))
    assert name in SOME_HOLD or not found["true"]
    assert found["rejected"] >= 0.3 * WANTED[name]
