"""Proving a certificate or a library again, from the file alone."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sagemp_cli.checker.balls import BITS, ball, ctx
from sagemp_cli.checker.cell import CellClaim, prove_cell
from sagemp_cli.checker.clearance import clearances, goal_margins
from sagemp_cli.checker.counterexample import Ends, applies, prove_violation
from sagemp_cli.checker.cover import covered
from sagemp_cli.checker.document import Document, read_document
from sagemp_cli.checker.lines import lines_of
from sagemp_cli.checker.loop import Folded
from sagemp_cli.checker.ode import Flow
from sagemp_cli.checker.part import FlowClaim
from sagemp_cli.checker.program import Program
from sagemp_cli.checker.scene import SafeSet, SetOfConfig
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.progress import Progress, Silent

_ULP = 2.0**-52


@dataclass(frozen=True)
class Finding:
    """What was found about one reference.

    Attributes:
        reference: its index.
        claimed: the verdict in the file.
        proved: whether SAFE is claimed and was proved.
        reason: why not, in one line; empty if proved.
        clearance: least proved distance of the stored tube to each constraint, by name (m); empty if not proved.
        margins: proved of each requirement, by name, at least; empty if not proved.
        goal_margin: the same to the goal's faces, by state.
    """

    reference: int
    claimed: str
    proved: bool
    reason: str
    clearance: Mapping[str, float]
    goal_margin: Mapping[str, float]
    margins: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Report:
    """What was found about a file.

    Attributes:
        path: the file.
        kind: ``certificate`` or ``library``.
        claimed: the verdict in the file (a library claims VERIFIED).
        answer: VERIFIED if all references are proved, FALSIFIED if a violation is, else UNKNOWN.
        problems: what is wrong with the claim as a whole, one line each.
        findings: one for each reference.
        counterexamples: of each one its reference, and why it proves nothing; empty if its violation is proved.
        document: what the file says.
        true_model: of a learned robot, the same about its analytical model; None if the file says nothing of that.
        cells, horizon: how many.
        seconds, proof_seconds: time of this check, and of the proof according to the file.
    """

    path: Path
    kind: str
    claimed: str
    answer: str
    problems: tuple[str, ...]
    findings: tuple[Finding, ...]
    counterexamples: tuple[tuple[int, str], ...]
    document: Document = field(compare=False)
    true_model: tuple[Finding, ...] | None
    cells: int
    horizon: int
    seconds: float
    proof_seconds: float


def check(path: Path, *, processes: int = 1, progress: Progress | None = None) -> Report:
    """Prove what a file claims.

    The claim about a learned robot's analytical model is a second one of its own. If any part of it does not hold, that
    is a problem of the whole file, however well the first is proved.

    Args:
        path: a certificate or a library.
        processes: workers that share the cells; 1 works here.
        progress: reports cells.

    Raises:
        ArtifactError: the file is missing, damaged, changed, of a newer format or not one that can be checked.
    """
    return check_document(read_document(path), path, processes=processes, progress=progress)


def check_document(
    document: Document, path: Path, *, processes: int = 1, progress: Progress | None = None
) -> Report:  # fmt: skip
    """The same of what was read from a file already."""
    began = time.perf_counter()
    safe, sets = document.safe, document.sets
    tubes, true = document.tubes, None
    work = processes, progress or Silent()
    with ctx.workprec(BITS):
        problems = [*_problems(document, sets), *_unrecorded(document)]
        found = _findings(document, safe, *work, sound=not problems)
        replayed = () if problems else _replayed(document, safe, sets)
        falsified = document.verdict == "FALSIFIED" and _falsified(document, replayed)
        if document.true_model is not None:
            true = _findings(document.true_model, safe, *work, sound=not problems)
            problems += [
                f"the analytical model, reference {f.reference}: {f.reason}"
                for f in true
                if f.claimed == "SAFE" and not f.proved
            ]
    verified = bool(found) and not problems and all(f.proved for f in found)
    return Report(
        path=path,
        kind=document.kind,
        claimed=document.verdict or "VERIFIED",
        answer="VERIFIED" if verified else "FALSIFIED" if falsified else "UNKNOWN",
        problems=tuple(problems),
        findings=found,
        counterexamples=replayed,
        document=document,
        true_model=true,
        cells=len(tubes["cell_reference"]),
        horizon=document.horizon,
        seconds=time.perf_counter() - began,
        proof_seconds=sum(float(np.sum(d.tubes["seconds"])) for d in (document, document.true_model) if d is not None),
    )


def recheck(path: Path) -> str:
    """What is wrong with a file, as far as that can be told without making its reach sets again; empty if nothing is.

    Whether the sets are those of its config, the cells cover X_I, the stored tubes begin with their cells, keep clear
    of the scene, end in the goal and say what the figures say, and whether counterexamples hold. It takes a small part
    of a check and proves nothing: that the loop stays in the tubes is left out.

    Raises:
        ArtifactError: as :func:`check`.
    """
    document = read_document(path)
    safe, sets = document.safe, document.sets
    with ctx.workprec(BITS):
        for problem in _problems(document, sets):
            return problem
        for part in (document, *([] if document.true_model is None else [document.true_model])):
            tubes = part.tubes
            claims = [r for r, verdict in enumerate(tubes["verdict"]) if verdict == "SAFE"]
            for r, reason in _geometry(part, safe, claims)[0].items():
                if reason:
                    return f"reference {r}: {reason}"
            lower, upper = tubes["tube_lower"][:, 0], tubes["tube_upper"][:, 0]
            if not ((lower <= tubes["cell_lower"]) & (tubes["cell_upper"] <= upper)).all():
                return "a tube does not begin with its cell"
        if document.verdict == "FALSIFIED":
            replayed = _replayed(document, safe, sets)
            if not _falsified(document, replayed):
                return next((f"a counterexample: {why}" for _, why in replayed if why), "no counterexample is there")
    return ""


def _findings(
    document: Document, safe: SafeSet, processes: int, progress: Progress, *, sound: bool
) -> tuple[Finding, ...]:
    """What is found about every reference; nothing is proved unless the file as a whole is sound."""
    tubes, count = document.tubes, len(document.tubes["verdict"])
    claims = [r for r in range(count) if tubes["verdict"][r] == "SAFE"] if sound else []
    reasons, margins = _geometry(document, safe, claims)
    open_ = [r for r in claims if not reasons[r]]
    for r, reason in _reach_sets(document, open_, processes, progress):
        reasons[r] = reasons[r] or reason
    return tuple(_finding(document, r, reasons.get(r), margins.get(r)) for r in range(count))


def _problems(document: Document, sets: tuple[SetOfConfig, SetOfConfig]) -> Iterator[str]:
    """What is wrong with the claim as a whole: W, X_I, finite numbers, and the verdict of all."""
    yield from _problems_of_tubes(document, sets)
    follows = _answer(document.tubes["verdict"])
    if document.kind == "certificate" and document.verdict != follows:
        yield f"the verdict is {document.verdict}, but {follows} follows from those of the references"
    true = document.true_model
    if true is not None:
        yield from (f"the analytical model: {problem}" for problem in _problems_of_tubes(true, sets))
        if not np.array_equal(true.tubes["references"], document.tubes["references"]):
            yield "the analytical model: its references are others than the robot's"
        if len(document.programs) != 1 or not true.programs[0].is_deviating(document.programs[0]):
            yield "the analytical model: its step is not that of the network with the deviation added to w"


def _problems_of_tubes(document: Document, sets: tuple[SetOfConfig, SetOfConfig]) -> Iterator[str]:
    """The same of one claim, without the verdict of all."""
    tubes = document.tubes
    for name in ("references", "start_lower", "start_upper", "cell_lower", "cell_upper"):
        if tubes[name] is not None and not np.isfinite(tubes[name]).all():
            yield f"{name} holds a number that is not finite"
    try:
        boxes = [("W", tubes["disturbance_lower"], tubes["disturbance_upper"], sets[1])]
        boxes += [("X_I", a, b, sets[0]) for a, b in zip(tubes["start_lower"], tubes["start_upper"], strict=True)]
        for name, lower, upper, given in boxes:
            pairs = zip(lower, upper, sides(given), strict=True)
            if not all(ball(a) <= low and high <= ball(b) for a, b, (low, high) in pairs):
                yield f"{name} of the file does not contain that of its config"
                break
    except Unproved as e:
        yield str(e)
    if tuple(tubes["constraint_names"]) != document.constraints:
        named = ", ".join(tubes["constraint_names"])
        yield f"the constraints are {', '.join(document.constraints)}, the file names {named}"


def _unrecorded(document: Document) -> Iterator[str]:
    """Of tubes that are claimed and cannot be made again, why not."""
    if not document.relaxations and "SAFE" in document.tubes["verdict"]:
        yield (
            f"the tubes were made by propagator '{document.said['propagator']}', which records no relaxations: "
            f"they cannot be checked"
        )


def _answer(verdicts: Sequence[str]) -> str:
    if "UNSAFE" in verdicts:
        return "FALSIFIED"
    return "VERIFIED" if verdicts and all(v == "SAFE" for v in verdicts) else "UNKNOWN"


def sides(given: SetOfConfig) -> Ends:
    """Lower and upper end of a set in each dimension, exact."""
    pairs = [(ball(a), ball(b)) for a, b in zip(given.first, given.second, strict=True)]
    return [(c - r, c + r) for c, r in pairs] if given.around else pairs


def _geometry(
    document: Document, safe: SafeSet, claims: Sequence[int]
) -> tuple[dict[int, str], dict[int, tuple[dict[str, float], dict[str, float]]]]:
    """Of each reference claimed SAFE what does not hold of cells, scene and figures, and the margins proved."""
    tubes, names = document.tubes, document.state_names
    reasons, margins = {}, {}
    for r in claims:
        own = tubes["cell_reference"] == r
        lower, upper = tubes["tube_lower"][own], tubes["tube_upper"][own]
        try:
            start = tubes["start_lower"][r], tubes["start_upper"][r]
            if not covered(*start, tubes["cell_lower"][own], tubes["cell_upper"][own]):
                raise Unproved("its cells do not cover X_I")
            if not (np.isfinite(lower) & np.isfinite(upper) & (lower <= upper)).all():
                raise Unproved("its tube is not finite")
            if not all(np.isfinite(side[own]).all() for side in document.flow.values()):
                raise Unproved("what is said between its instants is not finite")
            if tubes["step"][r] != -1 or tubes["fraction"][r] != 0 or tubes["constraint"][r] != "":
                raise Unproved("it is called SAFE, but a step or constraint that decided is named")
            cells = np.flatnonzero(own).tolist() if safe.names else []
            distances = clearances(safe, [line for c in cells for line in lines_of(document, c)], document.parts)
            stored_margins = _margins(document, r)
            for one in document.requirements:
                if not one.holds(ball(stored_margins[one.name])):
                    raise Unproved(f"the margin of '{one.name}' is too small: {stored_margins[one.name]:.9g}")
            of_scene = tubes["clearance"][r][: len(safe.names)]
            for name, distance, stored in zip(safe.names, distances, of_scene, strict=True):
                if not distance > 0:
                    raise Unproved(f"its tube is not clear of '{name}'")
                if distance.is_finite() and not ball(stored) <= distance:
                    raise Unproved(f"the clearance to '{name}' is {float(distance):.9g}, the file says {stored:.9g}")
            goal = goal_margins(safe, lower[:, -1].min(axis=0), upper[:, -1].max(axis=0))
            for name, margin, stored in zip(names, goal, tubes["goal_margin"][r], strict=True):
                if margin is None:
                    continue
                if not margin >= 0:
                    raise Unproved(f"its tube does not end in the goal ({name})")
                if not ball(stored) <= margin * (1 + ball(2 * _ULP)):  # stored rounded to nearest
                    raise Unproved(f"the goal margin of {name} is {float(margin):.9g}, the file says {stored:.9g}")
            reasons[r] = ""
            named = list(zip(safe.names, map(float, distances), strict=True))
            margins[r] = (
                {name: min(d for other, d in named if other == name) for name in safe.names},
                {name: float(g) for name, g in zip(names, goal, strict=True) if g is not None},
            )
        except Unproved as e:
            reasons[r] = str(e)
    return reasons, margins


def _margins(document: Document, r: int) -> dict[str, float]:
    """What the file says of the requirements of a reference."""
    said = document.tubes["clearance"][r][len(document.safe.names) :].tolist()
    return {one.name: margin for one, margin in zip(document.requirements, said, strict=True)}


def _reach_sets(
    document: Document, claims: Sequence[int], processes: int, progress: Progress
) -> Iterator[tuple[int, str]]:
    """Reference and reason, empty if proved, for each of their cells."""
    owner = document.tubes["cell_reference"]
    cells = np.flatnonzero(np.isin(owner, claims)).tolist()
    jobs = (_claim(document, c) for c in cells)
    with progress.task("checking cells", len(cells)) as task:
        if processes <= 1 or len(cells) < 2:
            folded = _fold(document.steps)
            for c, claim in zip(cells, jobs, strict=True):
                reason = prove_cell(claim, folded, document.odes)
                task.advance(1)
                yield int(owner[c]), reason and f"cell {c}, {reason}"
            return
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(
            min(processes, len(cells)), mp_context=context, initializer=_begin, initargs=(document.steps, document.odes)
        ) as pool:
            for c, reason in zip(cells, pool.map(_prove_elsewhere, jobs), strict=True):
                task.advance(1)
                yield int(owner[c]), reason and f"cell {c}, {reason}"


def _fold(programs: Sequence[Program]) -> list[Folded]:
    with ctx.workprec(BITS):
        return [Folded.of(program) for program in programs]


_KNOWN: list[tuple[list[Folded], Sequence[Flow]]] = []
"""Of a worker process: its programs."""


def _begin(programs: Sequence[Program], odes: Sequence[Flow]) -> None:
    _KNOWN[:] = [(_fold(programs), odes)]


def _prove_elsewhere(claim: CellClaim) -> str:
    return prove_cell(claim, *_KNOWN[0])


def _claim(document: Document, c: int) -> CellClaim:
    tubes, found = document.tubes, document.relaxations
    r = tubes["cell_reference"][c]
    margins = _margins(document, r)
    flow = document.flow_of(c) if document.odes else None
    w = tubes["disturbance_lower"], tubes["disturbance_upper"]
    if flow is None:
        sides = tuple(np.broadcast_to(side, (document.horizon, len(side))) for side in w)
    else:  # of each part two means in W and a remainder, and what a lag needs
        rest, measured = ((flow[f"{name}_lower"], flow[f"{name}_upper"]) for name in ("remainder", "measured"))
        sides = document.odes[document.cell_ode[c]].given(w, rest, measured)
    return CellClaim(
        program=np.full(document.horizon, document.cell_ode[c]) if document.odes else document.step_program,
        windows=document.windows(r),
        lower=tubes["cell_lower"][c],
        upper=tubes["cell_upper"][c],
        tube_lower=tubes["tube_lower"][c],
        tube_upper=tubes["tube_upper"][c],
        control_lower=tubes["control_lower"][r],
        control_upper=tubes["control_upper"][r],
        disturbance_lower=sides[0],
        disturbance_upper=sides[1],
        slope=found["slope"][c],
        offset=found["offset"][c],
        radius=found["radius"][c],
        kept=found["kept"][c] if "kept" in found else None,
        deviation=None if document.deviation is None else document.deviation[r],
        flow=None if flow is None else FlowClaim(**flow),
        required=tuple((one, margins[one.name]) for one in document.requirements),
    )


def _finding(
    document: Document, r: int, reason: str | None, margins: tuple[dict[str, float], dict[str, float]] | None
) -> Finding:  # fmt: skip
    claimed = document.tubes["verdict"][r]
    if reason is None:
        reason = "the file does not claim that it is safe" if claimed != "SAFE" else "see the problems of the file"
    proved = not reason
    clearance, goal = margins if margins is not None and proved else ({}, {})
    return Finding(r, claimed, proved, reason, clearance, goal, _margins(document, r) if proved else {})


def _replayed(document: Document, safe: SafeSet, sets: tuple[SetOfConfig, SetOfConfig]) -> tuple[tuple[int, str], ...]:
    """Of each counterexample its reference, and why it proves nothing; empty if its violation is proved."""
    ends = sides(sets[0]), sides(sets[1])
    out = []
    for example in document.counterexamples:
        if not applies(example, document):
            out.append((-1, "it has not the fields and shapes of a counterexample to one of the references"))
        else:
            out.append((int(example["reference"]), prove_violation(document, example, ends, safe)))
    return tuple(out)


def _falsified(document: Document, replayed: Sequence[tuple[int, str]]) -> bool:
    """Whether there are references that the file calls UNSAFE, each with a counterexample whose violation is proved."""
    refuted = {r for r, reason in replayed if not reason}
    unsafe = {r for r, v in enumerate(document.tubes["verdict"]) if v == "UNSAFE"}
    return bool(unsafe) and refuted >= unsafe
