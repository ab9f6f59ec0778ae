"""A certificate of anybody's loop: no reference, no tracker of ours, scene and goal if there are any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.pipeline.loop_record import strangers_loop_record
from sagemp_cli.pipeline.tubes import relaxations_record
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.sets import Box, Tube
from sagemp_cli.storage import Certificate, Tubes
from sagemp_cli.verification.verdict import Assessment, Outcome, Verdict, answer_of, assess


@dataclass(frozen=True)
class LoopProof:
    """What a propagator found about a recorded loop.

    Attributes:
        loop: the loop.
        start, disturbance: X_I and W, ``(n,)`` and ``(d,)``.
        cells: parts of X_I that cover it together, ``(C, n)``.
        tube: of each, ``(C, K+1, n)``.
        recording: the relaxations, of a propagator that records them; without them nobody can check the file.
        propagator, rigorous, seconds: what made the tubes, whether rounding is in them, how long it took.
    """

    loop: RecordedLoop
    start: Box
    disturbance: Box
    cells: Box
    tube: Tube
    recording: Recording | None
    propagator: str
    rigorous: bool
    seconds: float = 0.0


def certificate_of(
    proof: LoopProof,
    *,
    name: str = "loop",
    scene: Mapping[str, Any] | None = None,
    position: Sequence[int] = (),
    state_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    dt: float | None = None,
) -> tuple[Certificate, dict[str, Any]]:
    """A loop's certificate and the config that belongs beside it, ready for
    :func:`~sagemp_cli.storage.write_artifact`.

    Args:
        proof: what is claimed.
        name: of the problem; said, not proved.
        scene: a config section with workspace, obstacles and goal; None claims the tube alone.
        position: entries of the state that are the position in the scene.
        state_names, state_units, dt: see :func:`~sagemp_cli.pipeline.loop_record.strangers_loop_record`.

    Raises:
        UsageError: names, positions or tubes that do not fit the loop.
        ConfigError: the scene is none.
    """
    loop, tube = proof.loop, proof.tube
    record = strangers_loop_record(loop, state_names=state_names, state_units=state_units, position=position, dt=dt)
    cells, rows, n = tube.lower.shape
    if rows != loop.horizon + 1 or proof.cells.lower.shape != (cells, n):
        raise UsageError(f"the loop has {loop.horizon} steps, the tubes {rows - 1} of {cells} cells")
    owner = torch.zeros(cells, dtype=torch.int64)
    constraints: tuple[str, ...] = ()
    if scene is None:
        found = _unbounded_or_safe(tube, record.state_names)
    else:
        built = scene_from_mapping(dict(scene), state_dim=n, position_dim=len(position))
        constraints = built.constraint_names
        found = assess(tube, built, cell_reference=owner, position=position, state_names=record.state_names)
    (verdict,) = found.verdicts
    m = len(record.control_names)
    tubes = Tubes(
        start_lower=proof.start.lower.numpy()[None],
        start_upper=proof.start.upper.numpy()[None],
        disturbance_lower=proof.disturbance.lower.numpy(),
        disturbance_upper=proof.disturbance.upper.numpy(),
        cell_reference=owner.numpy(),
        cell_lower=proof.cells.lower.numpy(),
        cell_upper=proof.cells.upper.numpy(),
        tube_lower=tube.lower.numpy(),
        tube_upper=tube.upper.numpy(),
        control_lower=np.full((1, loop.horizon, m), -np.inf),
        control_upper=np.full((1, loop.horizon, m), np.inf),
        verdict=(str(verdict.outcome),),
        step=np.array([verdict.step]),
        constraint=(verdict.constraint,),
        constraint_names=constraints,
        clearance=found.clearance.numpy(),
        goal_margin=found.goal_margin.numpy(),
        seconds=np.array([proof.seconds]),
        propagator=proof.propagator,
        rigorous=proof.rigorous,
        relaxations=None if proof.recording is None else relaxations_record(proof.recording),
    )
    certificate = Certificate(
        tubes=tubes, loop=record, counterexamples=(), falsifier_rollouts=0, verdict=str(answer_of(found.verdicts))
    )
    sets = {"start": proof.start, "disturbance": proof.disturbance}
    config = {
        "name": name,
        "horizon": loop.horizon,
        **{key: {"lower": box.lower.tolist(), "upper": box.upper.tolist()} for key, box in sets.items()},
        **({} if scene is None else {"scene": dict(scene)}),
    }
    return certificate, config


def _unbounded_or_safe(tube: Tube, names: Sequence[str]) -> Assessment:
    """Of a claim about nothing but the tube: whether it is finite."""
    bad = ~(torch.isfinite(tube.lower) & torch.isfinite(tube.upper)).all(0)
    n = tube.lower.shape[-1]
    verdict = Verdict(Outcome.SAFE)
    if bool(bad.any()):
        k, i = (int(v) for v in bad.nonzero()[0])
        verdict = Verdict(Outcome.UNBOUNDED, k, names[i])
    infinite = torch.full((1, n), torch.inf, dtype=torch.float64)
    return Assessment((verdict,), torch.zeros(1, 0, dtype=torch.float64), infinite)
