"""``sagemp recheck``: stored tubes in another scene, without propagating anything (paper, section V-E)."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sagemp_cli.config.folders import load_scene
from sagemp_cli.errors import UsageError
from sagemp_cli.library.builder import REASON_OF, REASONS
from sagemp_cli.pipeline.tubes import flows_of, judged, selected
from sagemp_cli.scenes.scene import Scene, scene_from_mapping
from sagemp_cli.sets import Between, Box, Bulge, Tube
from sagemp_cli.storage import (
    Certificate,
    Library,
    LoopRecord,
    Tubes,
    read_any_artifact,
    refuse_existing,
    write_artifact,
)
from sagemp_cli.verification.bounding_volumes import BoundingVolumes
from sagemp_cli.verification.verdict import Assessment, Outcome, Verdict, answer_of, assess, positions_over_time


@dataclass(frozen=True)
class Rechecked:
    """What stored tubes say about another scene.

    Attributes:
        before: verdict of each reference in the file's own scene.
        verdicts: in the other scene.
        seconds: that the test of all tubes took, apart from reading the file and preparing its boxes.
        written: the file of the other scene, if one was asked for and there is something to write.
    """

    before: tuple[str, ...]
    verdicts: tuple[Verdict, ...]
    seconds: float
    written: Path | None = None


def recheck(path: Path, scene: str, *, output: Path | None = None, overwrite: bool = False) -> Rechecked:
    """Judge the tubes of a certificate or a library in another scene.

    They are taken from the file as they are: that the robot stays in them is proved by ``sagemp check``. The goal is
    the other scene's too. With ``output`` the same file is written for the other scene, with the new verdicts: of a
    library the references that are still certified, the others join the rejected; ``sagemp check`` proves it.

    Args:
        path: certificate or library.
        scene: name or file of the other scene.
        output: file to write; it is not written if it would be a library of nothing.
        overwrite: whether it may replace one.

    Raises:
        ArtifactError: the file cannot be read.
        ConfigError: the scene does not fit its states.
        UsageError: another kind of file, or its tubes say nothing of the time between samples.
    """
    began = time.monotonic()
    if output is not None:
        refuse_existing(output, overwrite)
    _, artifact = read_any_artifact(path)
    if not isinstance(artifact.record, Certificate | Library):
        raise UsageError(f"{path}: tubes are in certificates and libraries, this is neither")
    if isinstance(artifact.record, Certificate) and artifact.record.requirements is not None:
        raise UsageError(f"{path}: is about requirements of an ODE of one's own, not about a scene; prove it again")
    if not artifact.unchanged:
        raise UsageError(f"{path}: the content was changed after it was written (its hash differs)")
    tubes, loop, content = artifact.record.tubes, artifact.record.loop, load_scene(scene)
    other = scene_from_mapping(content, state_dim=len(loop.state_names), position_dim=len(loop.position))
    if tubes.between == Between.SAMPLES:
        raise UsageError(f"{path}: its tubes hold at the samples only, and say nothing of the time between them")
    clear, seconds = _clear(tubes, loop, other)
    found = _assessed(tubes, loop, other, None if output is not None else ~clear)
    if output is None:
        safe = Verdict(Outcome.SAFE)
        left = iter(found.verdicts)
        return Rechecked(tubes.verdict, tuple(safe if c else next(left) for c in clear), seconds)
    if isinstance(artifact.record, Library):
        if all(v.outcome is not Outcome.SAFE for v in found.verdicts):
            return Rechecked(tubes.verdict, found.verdicts, seconds)
        record: Any = kept_library(artifact.record, other, found)
    else:
        record = _certificate(artifact.record, loop, other, found)
    header = dataclasses.replace(
        artifact.header,
        stage="recheck",
        config=dict(artifact.header.config) | {"scene": content},
        parents=(artifact.as_parent("tubes", output.parent),),
        seconds=time.monotonic() - began,
        created_utc="",
        version="",
        packages={},
    )
    return Rechecked(
        tubes.verdict, found.verdicts, seconds, write_artifact(output, record, header, overwrite=overwrite)
    )


def _lines(tubes: Tubes, loop: LoopRecord) -> tuple[Tube, tuple[Tube, Bulge] | None]:
    """The tubes, and in continuous time what is known between the instants."""
    tube = Tube(torch.from_numpy(tubes.tube_lower), torch.from_numpy(tubes.tube_upper))
    if tubes.flow is None or loop.dt is None:
        return tube, None
    w = Box(torch.from_numpy(tubes.disturbance_lower), torch.from_numpy(tubes.disturbance_upper))
    ((_, flow),) = flows_of(tubes.flow, tube)  # the cells of robots of ours are divided alike
    return tube, flow.lines(tube, w, loop.dt)


def _clear(tubes: Tubes, loop: LoopRecord, scene: Scene) -> tuple[NDArray[np.bool_], float]:
    """Whether each reference is SAFE, ``(R,)``, and the seconds that this took."""
    tube, lines = _lines(tubes, loop)
    over = positions_over_time(tube, loop.position.tolist(), Between(tubes.between), lines)
    volumes = BoundingVolumes.of(over)
    began = time.perf_counter()
    clear = volumes.clear(scene)
    clear &= scene.goal.contains(Box(tube.lower[:, -1], tube.upper[:, -1])).numpy()
    clear &= tube.bounded.numpy()
    safe = np.ones(len(tubes.verdict), dtype=np.bool_)
    safe[tubes.cell_reference[~clear]] = False
    return safe, time.perf_counter() - began


def _assessed(tubes: Tubes, loop: LoopRecord, scene: Scene, some: NDArray[np.bool_] | None = None) -> Assessment:
    """The full judgement, of all references or of some ``(R,)``."""
    if some is not None:
        tubes = selected(tubes, np.flatnonzero(some))
    if not len(tubes.verdict):
        return Assessment((), torch.zeros(0, 1), torch.zeros(0, len(loop.state_names)))
    tube, lines = _lines(tubes, loop)
    return assess(
        tube,
        scene,
        cell_reference=torch.from_numpy(tubes.cell_reference),
        position=loop.position.tolist(),
        state_names=loop.state_names,
        between=Between(tubes.between),
        lines=lines,
    )


def _certificate(record: Certificate, loop: LoopRecord, scene: Scene, found: Assessment) -> Certificate:
    """For the other scene, which the counterexamples and the further plans are not about."""
    true = record.true_model
    if true is not None:
        own = judged(true.tubes, _assessed(true.tubes, loop, scene), scene.constraint_names)
        true = dataclasses.replace(true, tubes=own)
    return dataclasses.replace(
        record,
        tubes=judged(record.tubes, found, scene.constraint_names),
        counterexamples=(),
        falsifier_rollouts=0,
        verdict=str(answer_of(found.verdicts)),
        true_model=true,
        samples=None,
    )


def kept_library(record: Library, scene: Scene, found: Assessment) -> Library:
    """The library of the references that are certified in another scene; the others join the rejected."""
    safe = np.array([v.outcome is Outcome.SAFE for v in found.verdicts])
    tubes, lost = record.tubes, np.flatnonzero(~safe)
    assert tubes.references is not None  # of a library
    reasons = [REASON_OF[found.verdicts[r].outcome] for r in lost]
    names = tuple(dict.fromkeys((*record.reason_names, *REASONS)))
    counts = Counter(dict(zip(record.reason_names, record.reason_counts.tolist(), strict=True))) + Counter(reasons)
    return dataclasses.replace(
        record,
        tubes=selected(judged(tubes, found, scene.constraint_names), np.flatnonzero(safe)),
        mode=tuple(mode for mode, kept in zip(record.mode, safe, strict=True) if kept),
        rejected_references=np.concatenate([record.rejected_references, tubes.references[lost]]),
        rejected_reason=(*record.rejected_reason, *reasons),
        reason_names=names,
        reason_counts=np.array([counts[name] for name in names], dtype=np.int64),
    )
