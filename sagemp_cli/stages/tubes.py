"""Verifications to the record that certificates and libraries store, and back."""

from __future__ import annotations

import numpy as np
import torch

from sagemp_cli.errors import ArtifactError
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.reachability.verdict import Outcome, Verdict
from sagemp_cli.reachability.verification import Verification
from sagemp_cli.sets import Box, Tube
from sagemp_cli.storage import Relaxations, Tubes


def tubes_record(v: Verification) -> Tubes:
    """A verification as stored: the cells of all references in one list."""
    count, cells = v.cells.lower.shape[:2]
    return Tubes(
        references=v.references.numpy(),
        start_lower=v.start.lower.numpy(),
        start_upper=v.start.upper.numpy(),
        disturbance_lower=v.disturbance.lower.numpy(),
        disturbance_upper=v.disturbance.upper.numpy(),
        cell_reference=np.repeat(np.arange(count), cells),
        cell_lower=v.cells.lower.flatten(0, 1).numpy(),
        cell_upper=v.cells.upper.flatten(0, 1).numpy(),
        tube_lower=v.tube.lower.flatten(0, 1).numpy(),
        tube_upper=v.tube.upper.flatten(0, 1).numpy(),
        control_lower=v.control_lower.numpy(),
        control_upper=v.control_upper.numpy(),
        verdict=tuple(str(x.outcome) for x in v.verdicts),
        step=np.array([x.step for x in v.verdicts], dtype=np.int64),
        constraint=tuple(x.constraint for x in v.verdicts),
        constraint_names=v.constraint_names,
        clearance=v.clearance.numpy(),
        goal_margin=v.goal_margin.numpy(),
        seconds=v.seconds.numpy(),
        propagator=v.propagator,
        rigorous=v.rigorous,
        relaxations=None if v.recording is None else _relaxations(v.recording.flatten()),
    )


def _relaxations(recording: Recording) -> Relaxations:
    return Relaxations(
        operations=recording.operations,
        widths=np.array(recording.widths, dtype=np.int64),
        slope=recording.slope.numpy(),
        offset=recording.offset.numpy(),
        radius=recording.radius.numpy(),
        kept=None if recording.kept is None else recording.kept.numpy(),
    )


def _recording(record: Relaxations, sizes: tuple[int, int]) -> Recording:
    return Recording(
        record.operations,
        tuple(record.widths.tolist()),
        torch.from_numpy(record.slope),
        torch.from_numpy(record.offset),
        torch.from_numpy(record.radius),
        None if record.kept is None else torch.from_numpy(record.kept),
    ).unflatten(sizes)


def verification_of(record: Tubes, where: str) -> Verification:
    """A stored record as a verification; ``where`` names the file in messages.

    Raises:
        ArtifactError: the cells are not sorted by reference with equally many each, or a verdict is unknown.
    """
    count = len(record.references)
    owner = record.cell_reference
    cells = len(owner) // max(count, 1)
    if count == 0 or cells * count != len(owner) or not np.array_equal(owner, np.repeat(np.arange(count), cells)):
        raise ArtifactError(f"{where}: /data/tubes/cell_reference must list equally many cells of each reference")
    unknown = [x for x in record.verdict if x not in list(Outcome)]
    if unknown:
        raise ArtifactError(f"{where}: /data/tubes/verdict holds '{unknown[0]}'; known: {', '.join(Outcome)}")

    def per_cell(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).unflatten(0, (count, cells))

    return Verification(
        references=torch.from_numpy(record.references),
        start=Box(torch.from_numpy(record.start_lower), torch.from_numpy(record.start_upper)),
        disturbance=Box(torch.from_numpy(record.disturbance_lower), torch.from_numpy(record.disturbance_upper)),
        cells=Box(per_cell(record.cell_lower), per_cell(record.cell_upper)),
        tube=Tube(per_cell(record.tube_lower), per_cell(record.tube_upper)),
        control_lower=torch.from_numpy(record.control_lower),
        control_upper=torch.from_numpy(record.control_upper),
        verdicts=tuple(
            Verdict(Outcome(o), int(k), c)
            for o, k, c in zip(record.verdict, record.step, record.constraint, strict=True)
        ),
        constraint_names=record.constraint_names,
        clearance=torch.from_numpy(record.clearance),
        goal_margin=torch.from_numpy(record.goal_margin),
        seconds=torch.from_numpy(record.seconds),
        propagator=record.propagator,
        rigorous=bool(record.rigorous),
        recording=None if record.relaxations is None else _recording(record.relaxations, (count, cells)),
    )
