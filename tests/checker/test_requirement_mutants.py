"""Tampered certificates of what a stranger's ODE has to do: none is proved that is not a true one of what is printed.

Each mutant changes what is asked, when, with which margin, how cells are divided, or the ODE; or a counterexample. One
that is accepted has to hold: every simulated solution of *its* ODE keeps *its* requirements at *its* times with the
margins that it says, or its solution breaks one; and it is printed as another claim if it is one.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sagemp_cli.checker.check import check_document
from sagemp_cli.checker.claim import claim_rows
from sagemp_cli.checker.document import Document, read_document
from sagemp_cli.checker.ode import flow_of
from sagemp_cli.checker.requirement import Required
from sagemp_cli.scenes.requirements import Holds, Inside, Outside

from .required import energy, in_two_ways, kinked, margin_of, proof, written
from .test_flow_mutants import FINE, ONE, changed, solutions

K = 2
WANTED = {
    "margin": 30, "shifted": 40, "times": 40, "sense": 30, "margins_of": 50, "exchanged": 20, "uncovered": 20,
    "divided": 25, "boxes": 25, "rate": 40, "control": 20, "period": 20, "example": 60,
}  # fmt: skip
NONE_HOLDS = ("margin", "shifted", "uncovered", "divided", "boxes")

ASKED = (
    Inside({"angle": (-0.5, 0.5), "rate": (-2.0, 0.5)}),
    Inside({"rate": (-1.0, -0.05)}, when=(0.2, 0.25), name="late"),
    Outside({"angle": (0.2, 0.3), "rate": (-2.0, -0.9)}, name="corner"),
    Holds(energy, name="energy"),
    Holds(kinked, name="kinked", strict=True, when=(0.05, 0.2)),
)

Mutant = Document | None
"""None: a file that says so is refused."""


@dataclasses.dataclass(frozen=True)
class Truth:
    """A document, what solutions do, and a document with a counterexample."""

    document: Document
    states: np.ndarray
    broken: Document
    rng: np.random.Generator

    def any(self) -> int:
        return int(self.rng.integers(len(self.document.requirements)))


def least(one: Required, states: np.ndarray) -> float:
    """Of solutions ``(count, K FINE + 1, n)``, at the times that are asked for and were looked at."""
    times = np.arange(states.shape[1]) / FINE
    asked = (one.first <= times) & (times <= one.last)
    return float(margin_of(one, states[:, asked]).min()) if asked.any() else np.inf


def require_true(document: Document, states: np.ndarray) -> None:
    tubes, slack, at = document.tubes, 1e-8, states[:, ::FINE]
    lower, upper = tubes["tube_lower"].min(0), tubes["tube_upper"].max(0)
    assert (lower - slack <= at).all() and (at <= upper + slack).all()
    for one, margin in zip(document.requirements, tubes["clearance"][0], strict=True):
        assert (margin > 0) if one.strict else (margin >= 0)
        assert least(one, states) >= margin - slack, one.name


def asked_of(document: Document) -> list[tuple[Any, ...]]:
    """All that is meant; of one margin all are one of them."""
    return [
        (r.margins.fingerprint(), r.every or r.margins.controls == 1, r.strict, r.first, r.last)
        for r in document.requirements
    ]


def asking(document: Document, i: int, **values: Any) -> Document | None:
    """With another requirement in the place of one; None if it is none."""
    every = list(document.requirements)
    every[i] = dataclasses.replace(every[i], **values)
    try:
        every[i].require_sense(2, document.horizon)
    except ValueError:
        return None
    return dataclasses.replace(document, requirements=tuple(every))


def saying(document: Document, name: str, place: Any, value: Any) -> Document:
    array = document.tubes[name].copy()
    array[place] = value
    return dataclasses.replace(document, tubes={**document.tubes, name: array})


# -- classes whose mutants are none of them proved ---------------------------------------------------------------------


def margin(t: Truth) -> Iterator[Mutant]:
    """More than some solution has."""
    while True:
        i = t.any()
        most = least(t.document.requirements[i], t.states)
        value = float(t.rng.choice([most + 10.0 ** t.rng.uniform(-6, 0), np.inf, np.nan, -1e-12]))
        yield saying(t.document, "clearance", (0, i), value)


def shifted(t: Truth) -> Iterator[Mutant]:
    """Its faces are moved to where a solution is beyond them: by its margin, and a little."""
    while True:
        i = t.any()
        one, program = t.document.requirements[i], t.document.requirements[i].margins
        slot = program.instructions[program.control]
        if slot.kind != "linear":
            continue
        constants, rows = slot.constants.copy(), program.controls
        constants[-rows:] -= least(one, t.states) + 10.0 ** t.rng.uniform(-6, 0)
        lines = list(program.instructions)
        lines[program.control] = dataclasses.replace(slot, constants=constants)
        made = asking(t.document, i, margins=dataclasses.replace(program, instructions=tuple(lines)))
        yield made if made is None else saying(made, "clearance", (0, i), 1e-9)


def uncovered(t: Truth) -> Iterator[Mutant]:
    """A cell is smaller, or there is one cell less."""
    while True:
        c, i, cut = int(t.rng.integers(2)), int(t.rng.integers(2)), 10.0 ** t.rng.uniform(-15, -2)
        side = str(t.rng.choice(["lower", "upper"]))
        cells = t.document.tubes[f"cell_{side}"]
        yield saying(t.document, f"cell_{side}", (c, i), cells[c, i] + (cut if side == "lower" else -cut))
        yield saying(t.document, "cell_reference", (c,), 1)


def divided(t: Truth) -> Iterator[Mutant]:
    """Cells take each other's division, or one that nothing is said of."""
    while True:
        which = t.document.cell_ode.copy()
        c = int(t.rng.integers(2))
        which[c] = 1 - which[c]
        odes = t.document.odes
        if t.rng.random() < 0.6:
            j = int(t.rng.integers(2))
            order = int(t.rng.choice([o for o in (1, 2, 3, 4) if o != odes[j].order]))
            made = flow_of(t.document.programs[0], odes[0].rate, period=t.document.dt, substeps=odes[j].substeps,
                           order=order)  # fmt: skip
            yield dataclasses.replace(t.document, odes=(made, odes[1]) if j == 0 else (odes[0], made))
        else:
            yield dataclasses.replace(t.document, cell_ode=which)


def boxes(t: Truth) -> Iterator[Mutant]:
    """X, its remainder or its drift is smaller than it may be, in cells with one part and with more."""
    while True:
        c = int(t.rng.integers(2))
        place = c, int(t.rng.integers(K)), int(t.rng.integers(t.document.odes[t.document.cell_ode[c]].substeps)), int(
            t.rng.integers(2)
        )  # fmt: skip
        name = str(t.rng.choice(["upper", "remainder_upper", "curve"]))
        array = t.document.flow[name].copy()
        low = t.document.flow[name.replace("upper", "lower")][place]
        share = float(t.rng.uniform(0.3, 1.2))
        array[place] = (
            low + (1 - share) * (array[place] - low) if name != "curve" else array[place] * (1 - share) - 1e-9
        )
        yield dataclasses.replace(t.document, flow={**t.document.flow, name: array})


# -- classes in which one may hold -------------------------------------------------------------------------------------


def times(t: Truth) -> Iterator[Mutant]:
    while True:
        first, last = sorted(t.rng.choice([0.0, 1.0, K, *t.rng.uniform(-0.1, K + 0.1, 3)], 2))
        i = 1 if t.rng.random() < 0.7 else t.any()  # the one that does not hold always
        yield asking(t.document, i, first=float(first), last=float(last))


def sense(t: Truth) -> Iterator[Mutant]:
    """All margins or one of them, above 0 or not; both, or negated."""
    while True:
        i = t.any()
        one = t.document.requirements[i]
        flips = t.rng.random(2) < 0.6
        made = asking(t.document, i, every=one.every ^ bool(flips[0]), strict=one.strict ^ bool(flips[1]))
        yield made if t.rng.random() < 0.5 or made is None else saying(made, "clearance", (0, i), 0.0)


def margins_of(t: Truth) -> Iterator[Mutant]:
    """A constant, an operand or a kind of its program is another one."""
    while True:
        i = t.any()
        made = changed(t.document.requirements[i].margins, t.rng, (*ONE, "sqrt", "log"))
        if made is not None:
            yield asking(t.document, i, margins=made)


def exchanged(t: Truth) -> Iterator[Mutant]:
    """One says what another one said: of its margins, its times, or its figure."""
    while True:
        i, j = t.rng.permutation(len(t.document.requirements))[:2].tolist()
        other = t.document.requirements[j]
        if t.rng.random() < 0.3:
            yield saying(t.document, "clearance", (0, i), t.document.tubes["clearance"][0, j])
        else:
            yield asking(t.document, i, **{str(k): getattr(other, k) for k in t.rng.choice(["margins", "first"], 1)})


def _ode(document: Document, **values: Any) -> Mutant:
    given = {"control": document.programs[0], "rate": document.odes[0].rate, "period": document.dt} | values
    try:
        odes = tuple(
            flow_of(given["control"], given["rate"], period=given["period"], substeps=o.substeps, order=o.order)
            for o in document.odes
        )
    except ValueError:
        return None
    if [o.step.relaxations for o in odes] != [o.step.relaxations for o in document.odes]:
        return None
    return dataclasses.replace(document, odes=odes, programs=(given["control"],), dt=given["period"])


def rate(t: Truth) -> Iterator[Mutant]:
    while True:
        made = changed(t.document.odes[0].rate, t.rng, ONE)
        if made is not None:
            yield _ode(t.document, rate=made)


def control(t: Truth) -> Iterator[Mutant]:
    while True:
        made = changed(t.document.programs[0], t.rng, ONE)
        if made is not None:
            yield _ode(t.document, control=made)


def period(t: Truth) -> Iterator[Mutant]:
    while True:
        change = float(t.rng.choice([-1, 1]) * 10.0 ** t.rng.uniform(-15, -1))
        yield _ode(t.document, period=t.document.dt + change)


def example(t: Truth) -> Iterator[Mutant]:
    """Start, signal or time of a counterexample, or what it is said to break."""
    while True:
        (given,) = t.broken.counterexamples
        made = dict(given)
        what = t.rng.integers(5)
        if what == 0:
            made["states"] = given["states"] + 10.0 ** t.rng.uniform(-12, 0) * t.rng.normal(size=(1, 2))
        elif what == 1:
            w = given["disturbances"]
            made["disturbances"] = (
                w * float(t.rng.choice([-1, 0, 1 + 1e-9, np.nan])) if t.rng.random() < 0.5 else w[:-1]
            )
        elif what == 2:
            made["step"], made["fraction"] = (
                int(t.rng.integers(-1, K + 2)),
                float(t.rng.choice([0, 0.125, 0.5, 1, -0.5])),
            )
        elif what == 3:
            yield asking(t.broken, 0, first=float(given["step"] + given["fraction"]) + 1e-9, last=float(K))
            continue
        else:
            bound = t.broken.requirements[0].margins
            slot = bound.instructions[bound.control]
            shift = slot.constants.copy()
            shift[-bound.controls :] += 10.0 ** t.rng.uniform(-6, 0)
            lines = list(bound.instructions)
            lines[bound.control] = dataclasses.replace(slot, constants=shift)
            yield asking(t.broken, 0, margins=dataclasses.replace(bound, instructions=tuple(lines)))
            continue
        yield dataclasses.replace(t.broken, counterexamples=(made,))


def require_broken(document: Document) -> None:
    """By a fine simulation, up to its error."""
    (given,) = document.counterexamples
    start, w = given["states"][0], given["disturbances"]
    tubes = document.tubes
    assert ((tubes["start_lower"][0] <= start) & (start <= tubes["start_upper"][0])).all()
    assert ((tubes["disturbance_lower"] <= w) & (w <= tubes["disturbance_upper"])).all()
    time = given["step"] + given["fraction"]
    one = dataclasses.replace(
        document,
        tubes={**tubes, "cell_lower": start[None], "cell_upper": start[None]},
    )
    (states,) = solutions(one, np.random.default_rng(0), count=1, signal=np.repeat(w, FINE * K // len(w), axis=0))
    at = states[0, round(time * FINE)]
    asked = [r for r in document.requirements if r.first <= time <= r.last]
    assert any(margin_of(r, at[None])[0] <= 1e-6 for r in asked)


CLASSES: dict[str, Callable[[Truth], Iterator[Mutant]]] = {
    f.__name__: f
    for f in (margin, shifted, uncovered, divided, boxes, times, sense, margins_of, exchanged, rate, control, period,
              example)
}  # fmt: skip


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> tuple[Document, np.ndarray, Document]:
    """Two cells, two periods, of one and of two parts; and a solution that breaks a bound."""
    folder = tmp_path_factory.mktemp("required")
    written(in_two_ways(ASKED, horizon=K, parts=2), folder / "holds.h5")
    written(proof([Inside({"angle": (-0.5, 0.29)})], restarts=1, horizon=K), folder / "broken.h5")
    holds, broken = (read_document(folder / f"{name}.h5") for name in ("holds", "broken"))
    assert check_document(holds, folder).answer == "VERIFIED"
    assert check_document(broken, folder).answer == "FALSIFIED"
    return holds, np.concatenate(solutions(holds, np.random.default_rng(1), count=200)), broken


def test_there_are_three_hundred_mutants_of_requirements():
    assert set(CLASSES) == set(WANTED) and sum(WANTED.values()) >= 300


def test_what_was_certified_is_true_of_solutions(known):
    require_true(known[0], known[1])


@pytest.mark.parametrize("name", CLASSES)
def test_no_mutant_of_what_is_required_passes_that_does_not_hold(name, known):
    document, states, broken = known
    found: Counter[str] = Counter()
    for mutant in CLASSES[name](Truth(document, states, broken, np.random.default_rng(len(name)))):
        if sum(found.values()) >= WANTED[name]:
            break
        answer = "refused" if mutant is None else check_document(mutant, Path("mutant")).answer
        if mutant is None or answer not in ("VERIFIED", "FALSIFIED"):
            found["rejected"] += 1
            continue
        found["true"] += 1
        if answer == "FALSIFIED":
            require_broken(mutant)
            continue
        own = mutant.odes is document.odes
        require_true(mutant, states if own else np.concatenate(solutions(mutant, np.random.default_rng(2))))
        same = own and asked_of(mutant) == asked_of(document)
        assert same or claim_rows(mutant) != claim_rows(document), "another claim that is printed as this one"
    print(name, dict(found))
    assert name not in NONE_HOLDS or not found["true"]
    assert found["rejected"] >= 0.2 * WANTED[name]
