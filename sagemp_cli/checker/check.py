"""Proving a certificate or a library again, from the file alone."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagemp_cli.checker.balls import BITS, Unproved, arb, ball, ctx, number
from sagemp_cli.checker.cell import CellClaim, Policy, prove_cell
from sagemp_cli.checker.counterexample import applies, prove_violation
from sagemp_cli.checker.cover import covered
from sagemp_cli.checker.document import Document, read_document
from sagemp_cli.checker.scene import SafeSet, require_known
from sagemp_cli.config.binding import build, target_class
from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.errors import ArtifactError, SagempError
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
        goal_margin: the same to the goal's faces, by state.
    """

    reference: int
    claimed: str
    proved: bool
    reason: str
    clearance: Mapping[str, float]
    goal_margin: Mapping[str, float]


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
    began = time.perf_counter()
    document = read_document(path)
    try:
        dynamics = _dynamics(document.config, document.robot)
        safe = SafeSet.of(document.config["scene"])
        with ctx.workprec(BITS):
            problems = list(_problems(document, dynamics, safe))
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        RuntimeError,
        ImportError,
        OSError,
        MemoryError,
        SagempError,
    ) as e:
        raise ArtifactError(f"{path}: /config does not describe a problem ({' '.join(str(e).split())})") from None
    except Unproved as e:
        raise ArtifactError(f"{path}: /config: {e}") from None
    tubes, true = document.tubes, None
    work = processes, progress or Silent()
    with ctx.workprec(BITS):
        found = _findings(document, dynamics, safe, *work, sound=not problems)
        falsified = not problems and document.verdict == "FALSIFIED" and _falsified(document, dynamics, safe)
        if document.true_model is not None:
            true = _findings(document.true_model, dynamics, safe, *work, sound=not problems)
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
        true_model=true,
        cells=len(tubes["cell_reference"]),
        horizon=tubes["references"].shape[1] - 1,
        seconds=time.perf_counter() - began,
        proof_seconds=sum(float(np.sum(d.tubes["seconds"])) for d in (document, document.true_model) if d is not None),
    )


def _findings(
    document: Document, dynamics: Dynamics, safe: SafeSet, processes: int, progress: Progress, *, sound: bool
) -> tuple[Finding, ...]:
    """What is found about every reference; nothing is proved unless the file as a whole is sound."""
    tubes, count = document.tubes, len(document.tubes["references"])
    claims = [r for r in range(count) if tubes["verdict"][r] == "SAFE"] if sound else []
    reasons, margins = _geometry(document, dynamics, safe, claims)
    open_ = [r for r in claims if not reasons[r]]
    for r, reason in _reach_sets(document, dynamics, open_, processes, progress):
        reasons[r] = reasons[r] or reason
    return tuple(_finding(r, tubes["verdict"][r], reasons.get(r), margins.get(r)) for r in range(count))


def _dynamics(config: Mapping[str, Any], weights: Mapping[str, np.ndarray]) -> Dynamics:
    """The robot; a learned one with the weights that the file holds."""
    section = config["dynamics"]
    model = target_class(section, "dynamics")  # from an allow-list of this package's own classes
    if not issubclass(model, Dynamics):
        raise TypeError(f"dynamics: {model.__name__} is not a robot model")
    hidden, stored = section.get("hidden", []), sum(value.size for value in weights.values())
    if sum(hidden) + sum(a * b for a, b in zip(hidden, hidden[1:], strict=False)) > stored:
        raise ValueError(
            f"dynamics.hidden is {hidden}, but the file holds {stored} weights"
        )  # before room is made for it
    robot: Dynamics = build(section, "dynamics").double().eval()
    wanted = robot.state_dict()
    if weights.keys() != wanted.keys():
        odd = min(weights.keys() ^ wanted.keys())
        raise ValueError(f"dynamics: weight '{odd}' is {'not understood' if odd in weights else 'missing'}")
    for name, value in weights.items():
        if value.shape != tuple(wanted[name].shape) or value.dtype != np.float64 or not np.isfinite(value).all():
            raise ValueError(f"dynamics: weight '{name}' must be finite float64 of shape {tuple(wanted[name].shape)}")
    robot.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return robot


def _problems(document: Document, dynamics: Dynamics, safe: SafeSet) -> Iterator[str]:
    """What is wrong with the claim as a whole: sizes, W, X_I, finite numbers, and the verdict of all."""
    yield from _problems_of_tubes(document, dynamics, safe)
    follows = _answer(document.tubes["verdict"])
    if document.kind == "certificate" and document.verdict != follows:
        yield f"the verdict is {document.verdict}, but {follows} follows from those of the references"
    true = document.true_model
    if true is not None:
        yield from (f"the analytical model: {problem}" for problem in _problems_of_tubes(true, dynamics, safe))
        if not np.array_equal(true.tubes["references"], document.tubes["references"]):
            yield "the analytical model: its references are others than the robot's"


def _problems_of_tubes(document: Document, dynamics: Dynamics, safe: SafeSet) -> Iterator[str]:
    """The same of one claim, without the verdict of all."""
    tubes, config, n = document.tubes, document.config, dynamics.state_dim
    sizes = (tubes["references"].shape[2], tubes["control_lower"].shape[2], tubes["references"].shape[1] - 1)
    wanted = (n, dynamics.control_dim, config["horizon"])
    if sizes != wanted or (len(document.policy.error_scale), len(document.policy.control_scale)) != wanted[:2]:
        yield f"the file has {sizes} states, controls and steps, its config {wanted}"
        return
    flat = len(dynamics.position)
    shapes = [len(v) for o in safe.obstacles for v in o[2:] if isinstance(v, list)] + [len(v) for v in safe.workspace]
    if any(s != flat for s in shapes) or any(len(v) != n for v in safe.goal):
        yield "the scene does not have the dimensions of the robot's positions and states"
        return
    for name in ("references", "start_lower", "start_upper", "cell_lower", "cell_upper"):
        if not np.isfinite(tubes[name]).all():
            yield f"{name} holds a number that is not finite"
    start, w = config["start"], config["disturbance"]["radius"]
    require_known("start", start, "center", "radius")
    require_known("disturbance", config["disturbance"], "radius")
    try:
        boxes = [
            ("W", tubes["disturbance_lower"], tubes["disturbance_upper"], [0.0] * n, w),
            *(("X_I", a, b, start["center"], start["radius"])
              for a, b in zip(tubes["start_lower"], tubes["start_upper"], strict=True)),
        ]  # fmt: skip
        for name, lower, upper, center, radius in boxes:
            if not _contains(lower, upper, center, radius):
                yield f"{name} of the file does not contain that of its config"
                break
    except Unproved as e:
        yield str(e)
    if tuple(tubes["constraint_names"]) != safe.names:
        yield f"the constraints are {', '.join(safe.names)}, the file names {', '.join(tubes['constraint_names'])}"
    if not document.operations and "SAFE" in tubes["verdict"]:
        yield (
            f"the tubes were made by propagator '{document.propagator}', which records no relaxations: "
            f"they cannot be checked"
        )


def _answer(verdicts: Sequence[str]) -> str:
    if "UNSAFE" in verdicts:
        return "FALSIFIED"
    return "VERIFIED" if verdicts and all(v == "SAFE" for v in verdicts) else "UNKNOWN"


def _contains(lower: np.ndarray, upper: np.ndarray, center: Sequence[Any], radius: Sequence[Any]) -> bool:
    """Whether a stored box contains ``center +- radius``, exactly."""
    if not len(lower) == len(center) == len(radius):
        return False
    sides = zip(lower, upper, _sides(center, radius), radius, strict=True)
    return all(ball(a) <= low and high <= ball(b) and ball(r) >= 0 for a, b, (low, high), r in sides)


def _sides(center: Sequence[Any], radius: Sequence[Any]) -> list[tuple[arb, arb]]:
    """Lower and upper end of ``center +- radius`` in each dimension."""
    exact = [(ball(number(c)), ball(number(r))) for c, r in zip(center, radius, strict=True)]
    return [(c - r, c + r) for c, r in exact]


def _geometry(
    document: Document, dynamics: Dynamics, safe: SafeSet, claims: Sequence[int]
) -> tuple[dict[int, str], dict[int, tuple[dict[str, float], dict[str, float]]]]:
    """Of each reference claimed SAFE what does not hold of cells, scene and figures, and the margins proved."""
    tubes, index = document.tubes, list(dynamics.position)
    reasons, margins = {}, {}
    for r in claims:
        own = (tubes["cell_reference"] == r) & (tubes["cell_begin"] == 0)  # later cells lie in the tubes of these
        lower, upper = tubes["tube_lower"][own], tubes["tube_upper"][own]
        try:
            _require_heirs(tubes, r)
            start = tubes["start_lower"][r], tubes["start_upper"][r]
            if not covered(*start, tubes["cell_lower"][own], tubes["cell_upper"][own]):
                raise Unproved("its cells do not cover X_I")
            if not (np.isfinite(lower) & np.isfinite(upper) & (lower <= upper)).all():
                raise Unproved("its tube is not finite")
            if tubes["step"][r] != -1 or tubes["constraint"][r] != "":
                raise Unproved("it is called SAFE, but a step or constraint that decided is named")
            distances = safe.clearances(*(side[..., index].reshape(-1, len(index)) for side in (lower, upper)))
            for name, distance, stored in zip(safe.names, distances, tubes["clearance"][r], strict=True):
                if not distance > 0:
                    raise Unproved(f"its tube is not clear of '{name}'")
                if distance.is_finite() and not ball(stored) <= distance:
                    raise Unproved(f"the clearance to '{name}' is {float(distance):.9g}, the file says {stored:.9g}")
            goal = safe.goal_margins(lower[:, -1].min(axis=0), upper[:, -1].max(axis=0))
            for name, margin, stored in zip(dynamics.state_names, goal, tubes["goal_margin"][r], strict=True):
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
                {name: float(g) for name, g in zip(dynamics.state_names, goal, strict=True) if g is not None},
            )
        except Unproved as e:
            reasons[r] = str(e)
    return reasons, margins


def _require_heirs(tubes: Mapping[str, Any], r: int) -> None:
    """Of merged cells: each goes over into one that begins then, within its own stored tube from there on."""
    lower, upper, horizon = tubes["tube_lower"], tubes["tube_upper"], tubes["references"].shape[1] - 1
    for c in np.flatnonzero(tubes["cell_reference"] == r):
        begin, end, heir = (int(tubes[name][c]) for name in ("cell_begin", "cell_end", "cell_heir"))
        if not 0 <= begin < end <= horizon or (heir < 0) != (end == horizon) or heir >= len(tubes["cell_reference"]):
            raise Unproved(f"cell {c} does not last from one step to a later one, or its heir is missing")
        if heir < 0:
            continue
        if tubes["cell_reference"][heir] != r or tubes["cell_begin"][heir] != end:
            raise Unproved(f"cell {c} ends at step {end}, but its heir {heir} does not begin there")
        if not ((lower[c, end:] <= lower[heir, end:]) & (upper[heir, end:] <= upper[c, end:])).all():
            raise Unproved(f"the tube of cell {c} does not contain that of its heir {heir}")


def _reach_sets(
    document: Document, dynamics: Dynamics, claims: Sequence[int], processes: int, progress: Progress
) -> Iterator[tuple[int, str]]:
    """Reference and reason, empty if proved, for each of their cells."""
    owner = document.tubes["cell_reference"]
    cells = np.flatnonzero(np.isin(owner, claims)).tolist()
    jobs = ((_claim(document, c), (document.config["dynamics"], document.robot), document.policy) for c in cells)
    with progress.task("checking cells", len(cells)) as task:
        if processes <= 1 or len(cells) < 2:
            answers = (prove_cell(claim, dynamics, policy) for claim, _, policy in jobs)
            for c, reason in zip(cells, answers, strict=True):
                task.advance(1)
                yield int(owner[c]), reason and f"cell {c}, {reason}"
            return
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(processes, len(cells)), mp_context=context) as pool:
            for c, reason in zip(cells, pool.map(_prove_elsewhere, *zip(*jobs, strict=True)), strict=True):
                task.advance(1)
                yield int(owner[c]), reason and f"cell {c}, {reason}"


def _prove_elsewhere(
    claim: CellClaim, robot: tuple[Mapping[str, Any], Mapping[str, np.ndarray]], policy: Policy
) -> str:
    torch.set_num_threads(1)
    section, weights = robot
    return prove_cell(claim, _dynamics({"dynamics": section}, weights), policy)


def _claim(document: Document, c: int) -> CellClaim:
    tubes, found = document.tubes, document.relaxations
    r, heir = tubes["cell_reference"][c], int(tubes["cell_heir"][c])
    return CellClaim(
        reference=tubes["references"][r],
        lower=tubes["cell_lower"][c],
        upper=tubes["cell_upper"][c],
        tube_lower=tubes["tube_lower"][c],
        tube_upper=tubes["tube_upper"][c],
        control_lower=tubes["control_lower"][r],
        control_upper=tubes["control_upper"][r],
        disturbance_lower=tubes["disturbance_lower"],
        disturbance_upper=tubes["disturbance_upper"],
        operations=document.operations,
        slope=found["slope"][c],
        offset=found["offset"][c],
        radius=found["radius"][c],
        kept=found["kept"][c] if "kept" in found else None,
        deviation=None if document.deviation is None else document.deviation[r],
        begin=int(tubes["cell_begin"][c]),
        end=int(tubes["cell_end"][c]),
        heir_lower=None if heir < 0 else tubes["cell_lower"][heir],
        heir_upper=None if heir < 0 else tubes["cell_upper"][heir],
    )


def _finding(
    r: int, claimed: str, reason: str | None, margins: tuple[dict[str, float], dict[str, float]] | None
) -> Finding:
    if reason is None:
        reason = "the file does not claim that it is safe" if claimed != "SAFE" else "see the problems of the file"
    clearance, goal = margins if margins is not None and not reason else ({}, {})
    return Finding(r, claimed, not reason, reason, clearance, goal)


def _falsified(document: Document, dynamics: Dynamics, safe: SafeSet) -> bool:
    """Whether there are references that the file calls UNSAFE, each with a counterexample whose violation is proved."""
    start, w = document.config["start"], document.config["disturbance"]["radius"]
    sets = _sides(start["center"], start["radius"]), _sides([0.0] * len(w), w)
    refuted = {
        int(e["reference"])
        for e in document.counterexamples
        if applies(e, document.tubes)
        and not prove_violation(e, document.tubes, *sets, dynamics=dynamics, policy=document.policy, safe=safe)
    }
    unsafe = {r for r, v in enumerate(document.tubes["verdict"]) if v == "UNSAFE"}
    return bool(unsafe) and refuted >= unsafe
