"""A small certificate of a stranger's ODE with requirements of every kind, whose cells are divided in two ways."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sagemp_cli.checker.requirement import Required
from sagemp_cli.pipeline.ode_record import ode_certificate
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.observed import observed_ode
from sagemp_cli.scenes.requirements import Holds, Inside, Outside
from sagemp_cli.sets import Box
from sagemp_cli.storage import Certificate, Header, write_artifact
from sagemp_cli.verification.continuous.proof import OdeProof, verify_ode
from sagemp_cli.verification.verdict import Answer

from .by_hand import run

NAMES, UNITS = ("angle", "rate"), ("rad", "rad/s")
PERIOD, K, FINE = 0.125, 4, 16
START = ((0.2, -0.1), (0.3, 0.1))
W = ((-0.02, -0.1), (0.02, 0.1))


def control(x):
    return torch.relu(-2 * x[..., :1] - x[..., 1:] + 1) - torch.relu(2 * x[..., :1] + x[..., 1:] + 1)


def rate(x, u):
    return torch.cat([x[..., 1:], torch.sin(x[..., :1]) - 0.2 * x[..., 1:] + 1.5 * u], -1)


def energy(x):
    """A norm: smooth where the body is not at rest in the middle."""
    return 1.5 - torch.sqrt(x[..., :1] ** 2 + x[..., 1:] ** 2 + 0.01)


def kinked(x):
    """No derivative where the angle is 0."""
    return torch.cat([2.0 - x[..., :1].abs() - x[..., 1:], torch.relu(x[..., 1:]) + 1.0], -1)


REQUIREMENTS = (
    Inside({"angle": (-0.5, 0.5), "rate": (-2.0, 0.5)}),
    Inside({"angle": (-0.2, 0.29)}, when=(0.25, 0.5), name="later"),
    Inside({"rate": (-0.99, 0.0)}, when="end", name="slow"),
    Outside({"angle": (0.2, 0.3), "rate": (-2.0, -0.6)}, name="corner"),
    Holds(energy, name="energy"),
    Holds(kinked, name="kinked", strict=True, when=(0.05, 0.3)),
)


def box(sides: tuple[tuple[float, ...], tuple[float, ...]]) -> Box:
    return Box(*(torch.tensor(side, dtype=torch.float64) for side in sides))


def proof(requirements=REQUIREMENTS, *, start=START, disturbance=W, horizon=K, **options: Any) -> OdeProof:
    seen = observed_ode(rate, control, box(start), box(disturbance), period=PERIOD, horizon=horizon)
    formulas = [r.formula(NAMES) for r in requirements]
    given = {"counts": [1, 1], "restarts": 0, "generator": torch.Generator().manual_seed(0)} | options
    return verify_ode(seen, Affine(), formulas, **given)


def in_two_ways(requirements=REQUIREMENTS, *, parts: int = 4, **options: Any) -> OdeProof:
    """One half of X_I with a period as a whole, the other with so many parts of it."""
    middle = 0.25
    low = proof(requirements, start=(START[0], (middle, START[1][1])), substeps=1, order=3, **options)
    high = proof(requirements, start=((middle, START[0][1]), START[1]), substeps=parts, order=2, **options)
    order = [Answer.FALSIFIED, Answer.UNKNOWN, Answer.VERIFIED]
    verdicts = tuple(
        dataclasses.replace(a, margin=min(a.margin, b.margin), answer=min(a.answer, b.answer, key=order.index))
        for a, b in zip(low.verdicts, high.verdicts, strict=True)
    )
    return dataclasses.replace(low, start=box(START), pieces=(*low.pieces, *high.pieces), verdicts=verdicts)


def config(horizon: int) -> dict[str, Any]:
    sets = {"start": START, "disturbance": W}
    return {"name": "body", "horizon": horizon} | {
        name: {"lower": list(sides[0]), "upper": list(sides[1])} for name, sides in sets.items()
    }


def written(made: OdeProof, path: Path) -> Certificate:
    record = ode_certificate(made, state_names=NAMES, state_units=UNITS)
    header = Header(stage="prove", experiment="body", config=config(made.loop.horizon))
    write_artifact(path, record, header, overwrite=True)
    return record


def margin_of(one: Required, states: np.ndarray) -> np.ndarray:
    """What decides, of states ``(..., n)``, by numpy."""
    made = dataclasses.replace(one.margins, next=one.margins.control)
    flat = states.reshape(-1, states.shape[-1])
    margins = run(made, flat, np.zeros_like(flat)).reshape(*states.shape[:-1], -1)
    return margins.min(-1) if one.every else margins.max(-1)
