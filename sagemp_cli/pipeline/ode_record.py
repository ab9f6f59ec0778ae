"""The proof of a stranger's ODE as a certificate: its requirements as programs, all cells, however each is divided."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from sagemp_cli.pipeline.loop_record import continuous_loop_record
from sagemp_cli.pipeline.tubes import flow_record, relaxations_record
from sagemp_cli.reachability.flow import Division, Flow
from sagemp_cli.reachability.program.stored import to_record
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets import PARTS, Between, Box, Tube
from sagemp_cli.storage import Certificate, Counterexample, Relaxations, RequirementRecord, Tubes
from sagemp_cli.verification.continuous.attack import Violation
from sagemp_cli.verification.continuous.proof import OdeProof
from sagemp_cli.verification.verdict import Answer, Outcome, Verdict


def ode_certificate(proof: OdeProof, *, state_names: Sequence[str], state_units: Sequence[str]) -> Certificate:
    """A proof as stored; a claim that is not proved is stored as what it is."""
    found = proof.violation
    return Certificate(
        tubes=_tubes(proof),
        loop=continuous_loop_record(proof.loop, state_names=state_names, state_units=state_units),
        counterexamples=() if found is None or not found.proved else (_counterexample(proof, found),),
        falsifier_rollouts=proof.rollouts,
        verdict=str(proof.answer),
        true_model=None,
        requirements=tuple(
            RequirementRecord(
                name=one.formula.name,
                margins=to_record(one.margins.value),
                every=one.formula.every,
                strict=one.formula.strict,
                first=one.first,
                last=one.last,
            )
            for one in proof.requirements
        ),
    )


def _tubes(proof: OdeProof) -> Tubes:
    loop, n = proof.loop, proof.loop.state_dim
    verdict = _verdict(proof)
    if proof.pieces:
        cells = Box(*(torch.cat([getattr(p.cells, side) for p in proof.pieces]) for side in ("lower", "upper")))
        tube = Tube(*(torch.cat([getattr(p.reach.tube, side) for p in proof.pieces]) for side in ("lower", "upper")))
        flows = [p.reach.flow for p in proof.pieces if p.reach.flow is not None]
        controls = [
            _joined([getattr(p.reach, f"control_{side}") for p in proof.pieces], (loop.horizon, loop.controls), sign)
            for side, sign in (("lower", -1), ("upper", 1))
        ]
    else:  # refuted before anything was bounded
        cells = Box(proof.start.lower[None], proof.start.upper[None])
        tube, flows = _unknown(cells, loop.horizon)
        controls = [torch.full((1, loop.horizon, loop.controls), sign * torch.inf) for sign in (-1, 1)]
    assert len(flows) == max(1, len(proof.pieces))
    nothing = np.full((1, n), np.inf)
    return Tubes(
        references=None,
        start_lower=proof.start.lower[None].numpy(),
        start_upper=proof.start.upper[None].numpy(),
        disturbance_lower=proof.disturbance.lower.numpy(),
        disturbance_upper=proof.disturbance.upper.numpy(),
        cell_reference=np.zeros(len(cells.lower), np.int64),
        cell_lower=cells.lower.numpy(),
        cell_upper=cells.upper.numpy(),
        tube_lower=tube.lower.numpy(),
        tube_upper=tube.upper.numpy(),
        control_lower=controls[0].amin(0)[None].numpy(),
        control_upper=controls[1].amax(0)[None].numpy(),
        verdict=(str(verdict.outcome),),
        step=np.array([verdict.step]),
        fraction=np.array([verdict.fraction]),
        constraint=(verdict.constraint,),
        constraint_names=tuple(v.name for v in proof.verdicts),
        clearance=np.array([[v.margin for v in proof.verdicts]]).reshape(1, -1),
        goal_margin=nothing,
        seconds=np.array([proof.seconds]),
        propagator=proof.propagator,
        rigorous=True,
        between=str(Between.CONTINUOUS),
        parts=PARTS,
        relaxations=_relaxations([p.reach.recording for p in proof.pieces]),
        flow=flow_record(flows),
    )


def _joined(sides: Sequence[Tensor | None], shape: tuple[int, int], sign: int) -> Tensor:
    """Bounds of the controls of all cells, ``(C, K, m)``; infinite where a piece knows none."""
    return torch.cat([torch.full((1, *shape), sign * torch.inf) if s is None else s for s in sides])


def _unknown(cells: Box, periods: int) -> tuple[Tube, list[Flow]]:
    """Of cells of which nothing is known but where they are."""
    count, n = cells.lower.shape
    sides = []
    for side, sign in ((cells.lower, -1), (cells.upper, 1)):
        rest = torch.full((count, periods, n), sign * torch.inf, dtype=torch.float64)
        sides.append(torch.cat([side[:, None], rest], 1))
    nothing = torch.zeros(count, periods, 1, n, dtype=torch.float64)
    flow = Flow(Division(1, 1), *(nothing,) * 11).known_until(torch.zeros(count, dtype=torch.int64))
    return Tube(*sides), [flow]


def _relaxations(recordings: Sequence[Recording | None]) -> Relaxations | None:
    """Of all pieces one after the other, each filled up with zeros to the one with most; None if one has none."""
    known = [relaxations_record(r) for r in recordings if r is not None]
    if not known or len(known) < len(recordings) or len({r.kept is None for r in known}) > 1:
        return None

    def every(name: str) -> np.ndarray:
        parts = [getattr(r, name) for r in known]
        most = max(p.shape[-1] for p in parts)
        return np.concatenate([np.pad(p, ((0, 0), (0, 0), (0, most - p.shape[-1]))) for p in parts])

    return Relaxations(
        slope=every("slope"),
        offset=every("offset"),
        radius=every("radius"),
        kept=None if known[0].kept is None else every("kept"),
    )


def _verdict(proof: OdeProof) -> Verdict:
    """The one verdict of a file."""
    found = proof.violation
    if proof.answer is Answer.FALSIFIED and found is not None:
        return Verdict(Outcome.UNSAFE, found.step, found.requirement, found.fraction)
    if proof.answer is Answer.VERIFIED:
        return Verdict(Outcome.SAFE)
    open_ones = [v for v in proof.verdicts if v.answer is not Answer.VERIFIED]
    if not proof.bounded or not open_ones:
        lost = ~(torch.isfinite(proof.tube.lower) & torch.isfinite(proof.tube.upper)).all(-1)
        return Verdict(Outcome.UNBOUNDED, int(lost.to(torch.int8).argmax()), "the tube")
    first = min(open_ones, key=lambda v: v.time)
    place = min(first.time / proof.loop.period, float(proof.loop.horizon))
    return Verdict(Outcome.MAY_VIOLATE, int(place), first.name, place - int(place))


def _counterexample(proof: OdeProof, found: Violation) -> Counterexample:
    pieces = len(found.signal) // proof.loop.horizon
    return Counterexample(
        reference=0,
        kind="requirement",
        step=found.step,
        fraction=found.fraction,
        constraint=found.requirement,
        depth=found.depth,
        states=found.states[::pieces].numpy(),
        disturbances=found.signal.numpy(),
    )
