"""``sagemp prove``, and the same from Python: a verdict, a figure and a certificate for any step in torch."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from sagemp_cli.errors import UsageError, did_you_mean
from sagemp_cli.pipeline.loop_record import strangers_loop_record
from sagemp_cli.pipeline.tubes import counterexample_record, tubes_record
from sagemp_cli.reachability.any_loop import counts_of, propagator_of
from sagemp_cli.reachability.observed import observed
from sagemp_cli.reachability.propagator import Loop, Propagator
from sagemp_cli.report.figure import save_figure
from sagemp_cli.report.strangers_loop import LoopSetting, draw_loop
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.sets import Between, Box
from sagemp_cli.storage import Certificate, Header, refuse_existing, write_artifact
from sagemp_cli.verification.strangers_loop import LoopClaim, LoopProof, verify_loop

SCENE_KEYS = ("workspace", "obstacles", "goal", "name", "description")
"""What a scene may say here, none of which it must."""


def prove(
    step: Callable[..., Any] | Loop,
    start: Box,
    disturbance: Box | None = None,
    horizon: int | None = None,
    *,
    scene: Mapping[str, Any] | None = None,
    goal: Box | None = None,
    position: Sequence[int | str] | None = None,
    between: str = "segments",
    state_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    dt: float | None = None,
    propagator: str | Propagator = "affine",
    partitions: int | str | Sequence[int] = "auto",
    budget: int = 64,
    restarts: int = 16,
    seed: int = 0,
    certificate: Path | str | None = None,
    overwrite: bool = False,
    name: str = "loop",
) -> LoopProof:
    """Prove that every rollout ``x_{k+1} = step(x_k, w_k)`` keeps clear and ends in the goal, or find one that does
    not.

    For all starts in X_I and all disturbances, in real arithmetic, of the step as it was recorded
    (:func:`~sagemp_cli.reachability.any_loop.reach` says what that means and what is only tested).

    Args:
        step, start, disturbance, horizon, propagator: as of :func:`~sagemp_cli.reachability.any_loop.reach`.
        scene: ``workspace`` and ``obstacles`` over the position, ``goal`` over the state, as in a scene's file; each
            may be missing.
        goal: box over the state ``(n,)`` at step K, infinite where any value will do; instead of the scene's.
        position: the states that the scene is about, by number or name; by default the first ones, as many as it has
            dimensions.
        between: ``"segments"``: the position moves along a straight line within a step, as under forward Euler, and has
            to keep clear over the whole of it. ``"samples"``: it has to at the samples only, for a step that is no
            such motion; the verdict then says nothing of the time between them.
        state_names, state_units: n words each; ``x0``, ``x1``, ... by default.
        dt: seconds between samples, for the figure.
        partitions: cells as of ``reach``; ``"auto"`` splits where the claim is not proved yet.
        budget: cells at most with ``"auto"``.
        restarts: attacks per constraint on a claim that is not proved; 0 for none.
        seed: of the attacks.
        certificate: file to write; a figure is drawn beside it. None writes nothing.
        overwrite: replace it if it is there.
        name: what the loop is called in both.

    Returns:
        The verdict (``.answer``), the tube (``.tube``) and what they are about.

    Raises:
        UsageError: an argument that does not fit; errors of ``reach``.
        ArtifactError: the file is there already.
    """
    began, path = time.monotonic(), None if certificate is None else Path(certificate)
    if path is not None:
        refuse_existing(path, overwrite)
    n = start.dim if isinstance(start, Box) else 0
    names = _words("state_names", state_names, [f"x{i}" for i in range(n)])
    units = _words("state_units", state_units, [""] * n)
    problem = scene_data(scene, goal)
    if between not in (Between.SEGMENTS, Between.SAMPLES):
        raise UsageError(f"between must be '{Between.SEGMENTS}' or '{Between.SAMPLES}', found {between!r}")
    claim = claim_of(problem, names, position, Between(between))
    if dt is not None and not (isinstance(dt, int | float) and 0 < dt < math.inf):
        raise UsageError(f"dt must be a positive number of seconds, found {dt!r}")
    chosen, counts = propagator_of(propagator), counts_of(partitions, start)
    seen = observed(step, start, disturbance, horizon)
    proof = verify_loop(
        seen,
        chosen,
        claim,
        counts=counts,
        budget=budget,
        restarts=restarts,
        generator=torch.Generator().manual_seed(seed),
    )
    if path is None:
        return proof
    config = {
        "name": name,
        "horizon": seen.loop.horizon,
        "seed": seed,
        "start": corners(seen.start),
        "disturbance": corners(seen.disturbance),
        **({"scene": problem} if problem else {}),
    }
    found, decided = proof.counterexample, proof.verification.verdicts[0].constraint
    record = Certificate(
        tubes=dataclasses.replace(tubes_record(proof.verification), references=None),
        loop=strangers_loop_record(
            seen.loop,
            state_names=names,
            state_units=units,
            position=claim.position if problem.keys() & {"workspace", "obstacles"} else (),
            dt=dt,
        ),
        counterexamples=() if found is None else (counterexample_record(0, found, decided),),
        falsifier_rollouts=proof.rollouts,
        verdict=str(proof.answer),
        true_model=None,
    )
    header = Header(stage="prove", experiment=name, config=config, seed=seed, seconds=time.monotonic() - began)
    write_artifact(path, record, header, overwrite=overwrite)
    setting = LoopSetting(name, names, units, claim.position if _dimensions(problem) else (), claim.scene, dt)
    save_figure(draw_loop(record.tubes, setting, record.verdict, record.counterexamples), path.with_suffix(".png"))
    return proof


def _words(key: str, given: Sequence[str] | None, default: Sequence[str]) -> tuple[str, ...]:
    words = tuple(default if given is None else given)
    if len(words) != len(default) or any(not isinstance(w, str) for w in words):
        raise UsageError(f"{key}: {len(default)} states need {len(default)} words, found {len(words)}")
    if key == "state_names" and (len(set(words)) != len(words) or not all(words)):
        raise UsageError(f"{key} must be different words, found {', '.join(words)}")
    return words


def scene_data(given: Mapping[str, Any] | None, goal: Box | None) -> dict[str, Any]:
    """The scene as plain data with the goal in it; empty if there is nothing in it."""
    if given is not None and not isinstance(given, Mapping):
        raise UsageError(f"scene must be a mapping with some of {', '.join(SCENE_KEYS)}, found {type(given).__name__}")
    scene = dict(given or {})
    for key in scene:
        if key not in (*SCENE_KEYS, "landmarks"):
            near = did_you_mean(str(key), SCENE_KEYS) or f"; known: {', '.join(SCENE_KEYS)}"
            raise UsageError(f"scene: unknown key '{key}'{near}")
    if goal is not None:
        if "goal" in scene:
            raise UsageError("the scene has a goal, and another one is given beside it; give one of them")
        scene["goal"] = corners(goal)
    return scene if scene.keys() & {"workspace", "obstacles", "goal"} else {}


def claim_of(
    scene: Mapping[str, Any], names: tuple[str, ...], position: Sequence[int | str] | None, between: Between
) -> LoopClaim:
    """What a scene claims; what it does not say is infinite."""
    n = len(names)
    d = _dimensions(scene)
    chosen = range(d) if position is None else [_state(p, names) for p in position]
    if d and len(chosen) != d:
        raise UsageError(f"the scene is about {d} states, position names {len(chosen)}")
    if d > n or len(set(chosen)) != len(chosen):
        raise UsageError(f"position must be {d} different ones of {', '.join(names)}")
    chosen = chosen if d else [0]
    everywhere = lambda size: {"lower": [-math.inf] * size, "upper": [math.inf] * size}  # noqa: E731
    full = {"workspace": everywhere(len(chosen)), "obstacles": [], "goal": everywhere(n)} | dict(scene)
    made = scene_from_mapping(full, state_dim=n, position_dim=len(chosen))
    return LoopClaim(made, tuple(chosen), names, between)


def _dimensions(scene: Mapping[str, Any]) -> int:
    """Of the space that a scene is about: as many as its first corner or centre has numbers; 0 if it has none."""
    obstacles = scene.get("obstacles") or []
    for part in (scene.get("workspace"), *(obstacles if isinstance(obstacles, Sequence) else ())):
        for key in ("lower", "center"):
            if isinstance(part, Mapping) and isinstance(part.get(key), Sequence):
                return len(part[key])
    return 0


def _state(given: int | str, names: Sequence[str]) -> int:
    if isinstance(given, str) and given in names:
        return names.index(given)
    number = int(given) if isinstance(given, str) and given.isdigit() else given
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(names):
        raise UsageError(f"position: no state {given!r}; known: {', '.join(names)}, or 0 to {len(names) - 1}")
    return number


def corners(box: Box) -> dict[str, list[float]]:
    """A box as plain data."""
    return {"lower": box.lower.tolist(), "upper": box.upper.tolist()}
