"""Verifications to the records that certificates and libraries store, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sagemp_cli.errors import ArtifactError
from sagemp_cli.reachability.flow import Division, Flow
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets import PARTS, Between, Box, Tube
from sagemp_cli.storage import Counterexample, FlowBounds, Relaxations, Tubes
from sagemp_cli.verification.attack.falsifier import Counterexample as Found
from sagemp_cli.verification.verdict import Assessment, Outcome, Verdict
from sagemp_cli.verification.verification import Verification


def tubes_record(v: Verification) -> Tubes:
    """A verification as stored."""
    return Tubes(
        references=v.references.numpy(),
        start_lower=v.start.lower.numpy(),
        start_upper=v.start.upper.numpy(),
        disturbance_lower=v.disturbance.lower.numpy(),
        disturbance_upper=v.disturbance.upper.numpy(),
        cell_reference=v.cell_reference.numpy(),
        cell_lower=v.cells.lower.numpy(),
        cell_upper=v.cells.upper.numpy(),
        tube_lower=v.tube.lower.numpy(),
        tube_upper=v.tube.upper.numpy(),
        control_lower=v.control_lower.numpy(),
        control_upper=v.control_upper.numpy(),
        **_verdicts(v, v.constraint_names),
        seconds=v.seconds.numpy(),
        propagator=v.propagator,
        rigorous=v.rigorous,
        between=str(v.between),
        parts=1 if v.between is Between.SAMPLES else PARTS,
        relaxations=None if v.recording is None else relaxations_record(v.recording),
        flow=None if v.flow is None else flow_record([v.flow]),
    )


def judged(tubes: Tubes, found: Assessment, constraint_names: tuple[str, ...]) -> Tubes:
    """The same tubes with the verdicts of another scene."""
    return dataclasses.replace(tubes, **_verdicts(found, constraint_names))


def _verdicts(found: Assessment | Verification, constraint_names: tuple[str, ...]) -> dict[str, Any]:
    return {
        "verdict": tuple(str(x.outcome) for x in found.verdicts),
        "step": np.array([x.step for x in found.verdicts], dtype=np.int64),
        "fraction": np.array([x.fraction for x in found.verdicts]),
        "constraint": tuple(x.constraint for x in found.verdicts),
        "constraint_names": constraint_names,
        "clearance": found.clearance.numpy(),
        "goal_margin": found.goal_margin.numpy(),
    }


def flows_of(record: FlowBounds, tube: Tube) -> list[tuple[np.ndarray, Flow]]:
    """What is stored of the time between the instants, with the tube ``(C, K+1, n)`` at them: of all cells that are
    divided alike their indices and their flow."""
    found = []
    for substeps, order in sorted(set(zip(record.substeps.tolist(), record.order.tolist(), strict=True))):
        own = np.flatnonzero((record.substeps == substeps) & (record.order == order))
        ends = [
            torch.cat([side[own][:, :-1, None], torch.from_numpy(inner[own][:, :, : substeps - 1])], 2)
            for side, inner in ((tube.lower, record.inner_lower), (tube.upper, record.inner_upper))
        ]
        jump = np.zeros_like(record.lower) if record.jump is None else record.jump
        sides = (record.lower, record.upper, record.remainder_lower, record.remainder_upper, record.curve, record.drift)
        parts = [torch.from_numpy(side[own][:, :, :substeps]) for side in (*sides, jump)]
        none = np.zeros_like(record.lower[:, :, 0])
        measured = [
            torch.from_numpy((none if side is None else side)[own][:, :, None])
            for side in (record.measured_lower, record.measured_upper)
        ]
        found.append((own, Flow(Division(substeps, order), *ends, *parts, *measured)))
    return found


def flow_record(flows: Sequence[Flow]) -> FlowBounds:
    """What was proved within periods, of the cells of one flow after the other, as stored; the states at the beginning
    of periods are those of the tube."""
    most = max(flow.division.substeps for flow in flows)

    def every(side: str, first: int = 0) -> np.ndarray:
        parts = [getattr(flow, side)[:, :, first:] for flow in flows]
        padded = [torch.nn.functional.pad(p, (0, 0, 0, most - first - p.shape[2])) for p in parts]
        return torch.cat(padded).numpy()

    cells = [len(flow.lower) for flow in flows]
    return FlowBounds(
        substeps=np.repeat([flow.division.substeps for flow in flows], cells),
        order=np.repeat([flow.division.order for flow in flows], cells),
        inner_lower=every("state_lower", 1),
        inner_upper=every("state_upper", 1),
        **{
            side: every(side)
            for side in ("lower", "upper", "remainder_lower", "remainder_upper", "curve", "drift")
        },
        jump=every("jump") if any(bool((flow.jump != 0).any()) for flow in flows) else None,
        **_measured(flows),
    )  # fmt: skip


def _measured(flows: Sequence[Flow]) -> dict[str, np.ndarray]:
    """What is left out of measured states, where there is anything."""
    found = {name: torch.cat([getattr(flow, name)[:, :, 0] for flow in flows]) for name in _MEASURED}
    return {name: side.numpy() for name, side in found.items()} if any(bool(s.any()) for s in found.values()) else {}


_MEASURED = ("measured_lower", "measured_upper")


def relaxations_record(recording: Recording) -> Relaxations:
    """What a proof recorded, as stored."""
    return Relaxations(
        slope=recording.slope.numpy(),
        offset=recording.offset.numpy(),
        radius=recording.radius.numpy(),
        kept=None if recording.kept is None else recording.kept.numpy(),
    )


def verification_of(record: Tubes, where: str) -> Verification:
    """A stored record as a verification, without what it can be done again from; ``where`` names the file in messages.

    Raises:
        ArtifactError: there are no references, the cells are not sorted by reference, a reference has none, a
            verdict is unknown, or what it says of the time between samples.
    """
    if record.references is None:
        raise ArtifactError(f"{where}: /data/tubes holds no references")
    count, owner = len(record.references), record.cell_reference
    if count == 0 or (np.diff(owner) < 0).any() or not np.array_equal(np.unique(owner), np.arange(count)):
        raise ArtifactError(
            f"{where}: /data/tubes/cell_reference must list the cells of each of {count} references in turn"
        )
    unknown = [x for x in record.verdict if x not in list(Outcome)]
    if unknown:
        raise ArtifactError(f"{where}: /data/tubes/verdict holds '{unknown[0]}'; known: {', '.join(Outcome)}")
    if record.between not in list(Between):
        raise ArtifactError(f"{where}: /data/tubes/between is '{record.between}'; known: {', '.join(Between)}")
    return Verification(
        references=torch.from_numpy(record.references),
        start=Box(torch.from_numpy(record.start_lower), torch.from_numpy(record.start_upper)),
        disturbance=Box(torch.from_numpy(record.disturbance_lower), torch.from_numpy(record.disturbance_upper)),
        cell_reference=torch.from_numpy(owner),
        cells=Box(torch.from_numpy(record.cell_lower), torch.from_numpy(record.cell_upper)),
        tube=Tube(torch.from_numpy(record.tube_lower), torch.from_numpy(record.tube_upper)),
        control_lower=torch.from_numpy(record.control_lower),
        control_upper=torch.from_numpy(record.control_upper),
        verdicts=tuple(
            Verdict(Outcome(o), int(k), c, float(s))
            for o, k, c, s in zip(record.verdict, record.step, record.constraint, record.fraction, strict=True)
        ),
        constraint_names=record.constraint_names,
        clearance=torch.from_numpy(record.clearance),
        goal_margin=torch.from_numpy(record.goal_margin),
        seconds=torch.from_numpy(record.seconds),
        propagator=record.propagator,
        rigorous=bool(record.rigorous),
        recording=None,
        between=Between(record.between),
    )


def selected(tubes: Tubes, references: NDArray[np.integer]) -> Tubes:
    """The same for some of the references, in the given order, with their cells; by the declared dimensions."""
    cells = [np.flatnonzero(tubes.cell_reference == r) for r in references]
    owner = np.repeat(np.arange(len(cells)), [len(c) for c in cells])
    index = {"count": np.asarray(references), "cells": np.concatenate([np.zeros(0, np.int64), *cells])}
    return dataclasses.replace(_taken(tubes, index), cell_reference=owner)


def _taken(record: Any, index: Mapping[str, NDArray[np.integer]]) -> Any:
    """A record with some entries of each array whose first dimension is named."""
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        value, first = getattr(record, field.name), field.metadata.get("dims", ("",))[0]
        if dataclasses.is_dataclass(value):
            changed[field.name] = _taken(value, index)
        elif first in index and value is not None:
            picked = index[first]
            changed[field.name] = value[picked] if isinstance(value, np.ndarray) else tuple(value[i] for i in picked)
    return dataclasses.replace(record, **changed)


def counterexample_record(reference: int, found: Found, constraint: str) -> Counterexample:
    """A counterexample of a reference, which breaks this constraint, as stored; an obstacle is a 'collision' there."""
    return Counterexample(
        reference=reference,
        kind="collision" if found.kind == "obstacle" else found.kind,
        step=found.step,
        fraction=found.fraction,
        constraint=constraint,
        depth=found.depth,
        states=found.states.numpy(),
        disturbances=found.disturbances.numpy(),
    )
