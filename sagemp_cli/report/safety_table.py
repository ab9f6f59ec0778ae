"""Table: how many references are safe open loop, under the tracker, and certified, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sagemp_cli.errors import ArtifactError
from sagemp_cli.storage import Artifact, SafetyRates, Trials, read_artifact

OPEN_LOOP, CLOSED_LOOP, CERTIFIED = "open loop", "closed loop", "certified"
PAPER = {
    "planar_diffusion": (126, {OPEN_LOOP: 0.785, CLOSED_LOOP: 0.944, CERTIFIED: 1.0}),
    "planar_cfm": (108, {OPEN_LOOP: 0.685, CLOSED_LOOP: 0.815, CERTIFIED: 1.0}),
}
"""References and safe shares in the paper's text, by experiment. It does not say how many rollouts each reference had,
under which disturbances, nor whether 100 % is the share of all sampled references or of the certified ones."""


@dataclass(frozen=True)
class SafetyRow:
    """One way of executing one experiment's references. Safe means: in the safe set at all steps.

    Attributes:
        experiment: folder of the artifact.
        way: ``open loop``, ``closed loop`` or ``certified``.
        sampled: references sampled from the planner.
        rollouts: rollouts of each reference under each kind of disturbance.
        safe: references of which all rollouts were safe; in the row of the certified ones, those certified.
        reaching: references of which all rollouts were safe and reached the goal; certified ones are proved to.
        rollouts_safe: share of the rollouts that were safe, by kind of disturbance; in the row of the certified ones,
            of their closed-loop rollouts, which must be all of them; None if there are none.
        paper: safe share in the paper, None where it has none, and for the toy problems, which are not the paper's.
        paper_sampled: references there.
    """

    experiment: str
    way: str
    sampled: int
    rollouts: int
    safe: int
    reaching: int
    rollouts_safe: Mapping[str, float | None]
    paper: float | None
    paper_sampled: int | None


def safety_rows(artifact: Artifact[SafetyRates]) -> tuple[SafetyRow, SafetyRow, SafetyRow]:
    """The three rows of an experiment."""
    record = artifact.record
    proved = certified(record)
    ours_alone = artifact.header.config.get("effort", {}).get("name") == "toy"  # its scene is another one
    sampled, published = (None, {}) if ours_alone else PAPER.get(artifact.header.experiment, (None, {}))

    def row(way: str, trials: Trials, those: np.ndarray, good: np.ndarray, reaching: np.ndarray) -> SafetyRow:
        clear = trials.clearance[those] > 0
        return SafetyRow(
            experiment=artifact.path.parent.name,
            way=way,
            sampled=len(record.references),
            rollouts=trials.clearance.shape[2],
            safe=int(good.sum()),
            reaching=int(reaching.sum()),
            rollouts_safe={
                kind: float(clear[:, i].mean()) if those.any() else None for i, kind in enumerate(record.disturbances)
            },
            paper=published.get(way),
            paper_sampled=sampled,
        )

    everyone = np.ones(len(record.references), dtype=bool)
    ways = ((OPEN_LOOP, record.open_loop), (CLOSED_LOOP, record.closed_loop))
    executed = [row(way, t, everyone, always_safe(t), always_safe(t) & t.reached.all((1, 2))) for way, t in ways]
    opened, closed = executed
    return (opened, closed, row(CERTIFIED, record.closed_loop, proved, proved, proved))


def always_safe(trials: Trials) -> np.ndarray:
    """Whether all rollouts of a reference stayed in the safe set, ``(count,)``."""
    return np.asarray((trials.clearance > 0).all((1, 2)))


def certified(record: SafetyRates) -> np.ndarray:
    """Whether a reference is certified from all of X_I, ``(count,)``."""
    return np.array([v == "SAFE" for v in record.verdict], dtype=bool)


def all_safety_rows(root: Path) -> list[SafetyRow]:
    """The rows of every experiment below a folder that has a ``safety.h5``.

    Raises:
        ArtifactError: none has one, or one is damaged.
    """
    paths = sorted(root.glob("*/safety.h5"))
    if not paths:
        raise ArtifactError(
            f"{root}: no experiment has a safety.h5; make one with 'sagemp safety-rates experiment=NAME'"
        )
    return [row for path in paths for row in safety_rows(read_artifact(path, SafetyRates))]


def table_lines(rows: Sequence[SafetyRow]) -> Iterator[str]:
    """The rows as text of aligned columns, with what they mean below."""
    kinds = list(dict.fromkeys(kind for row in rows for kind in row.rollouts_safe))
    head = ("experiment", "execution", "references safe", "and at goal", *(f"w {kind}" for kind in kinds), "paper")
    cells = [
        head,
        *(_cells(row, kinds, i > 0 and rows[i - 1].experiment == row.experiment) for i, row in enumerate(rows)),
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        yield "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip()
    yield ""
    yield "Safe: in the safe set over the whole of every step, from starts all over X_I. A reference is safe if all its"
    yield "rollouts are, under no, random and worst-case disturbances w; the columns w give the share of them that are."
    yield "Certified: proved from all of X_I under all w; its rollouts are the closed-loop ones of these references."


def _cells(row: SafetyRow, kinds: Sequence[str], repeated: bool) -> tuple[str, ...]:
    paper = "" if row.paper is None else f"{percentage(row.paper)} of {row.paper_sampled}"
    return (
        "" if repeated else row.experiment,
        row.way,
        f"{percentage(row.safe / row.sampled)} ({row.safe} of {row.sampled})",
        percentage(row.reaching / row.sampled),
        *(percentage(row.rollouts_safe.get(kind)) for kind in kinds),
        paper,
    )


def percentage(value: float | None) -> str:
    """A share in percent; it says 100 only of all and 0 only of none, and is a dash where there is none."""
    if value is None:
        return "-"
    return f"{100 * value:.0f} %" if value in (0, 1) else f"{min(max(100 * value, 0.1), 99.9):.1f} %"
