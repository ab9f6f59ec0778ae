"""``sagemp prove`` of a robot as an ODE, and the same from Python: a verdict about all times, and a figure."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.loop.onnx_format.lowering import read_network
from sagemp_cli.pipeline.ode_record import ode_certificate
from sagemp_cli.reachability.any_loop import counts_of, propagator_of
from sagemp_cli.reachability.continuous.observed import observed_ode
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.report.figure import save_figure
from sagemp_cli.report.ode import draw_ode
from sagemp_cli.scenes.requirements import Inside, Requirement, of_scene
from sagemp_cli.sets import Box
from sagemp_cli.sets.between import Between
from sagemp_cli.stages.prove import claim_of, corners, scene_data
from sagemp_cli.storage import Header, refuse_existing, write_artifact
from sagemp_cli.verification.continuous.proof import OdeProof, verify_ode


@dataclass(frozen=True)
class Plant:
    """What a stranger's object says of a robot as an ODE under a controller.

    Attributes:
        rate: ``f(x, u)``.
        control: ``u`` of ``x``.
        period: seconds between two samples; None where it does not say.
        horizon: periods; None where it does not say.
        start, disturbance: boxes; None where it does not say.
        state_names: None where it does not say.
        requirements: what it says must hold.
    """

    rate: Callable[[Any, Any], Any]
    control: Callable[[Any], Any]
    period: float | None
    horizon: int | None
    start: Box | None
    disturbance: Box | None
    state_names: tuple[str, ...] | None
    requirements: tuple[Requirement, ...]


def is_plant(target: Any) -> bool:
    """Whether an object, or what a class makes, is a robot as an ODE: whether it says a rate."""
    return callable(getattr(target, "rate", None))


def plant_of(target: Any, network: Path | None = None) -> Plant:
    """What an object says, or an object of a class; its controller with the network of an ONNX file, if one is given.

    The object has ``rate(x, u)`` and ``control(x)``, or ``control(x, network)`` where a network is given, which alone
    is the controller if there is none. What else it may have: ``period``, ``horizon``, ``start`` and ``disturbance``
    (a pair of numbers for each state), ``state_names``, ``requirements``.

    Raises:
        UsageError: it says something that cannot be.
        ArtifactError: the file is missing, or holds what is not supported.
    """
    if isinstance(target, type):
        try:
            target = target()
        except Exception as e:  # a stranger's code may raise anything
            raise UsageError(f"{target.__name__} cannot be made without arguments: {e}") from None
    if not is_plant(target):
        raise UsageError("a robot as an ODE needs rate(x, u)")
    control = getattr(target, "control", None)
    if network is not None:
        if not Path(network).is_file():
            raise ArtifactError(f"{network}: no such file")
        layers = read_network(Path(network))
        given = control
        control = layers if given is None else lambda x: given(x, layers)
    elif control is not None and _needs_a_network(control):
        named = getattr(target, "network", None)
        wanted = f", for instance {named}" if isinstance(named, str) else ""
        raise UsageError(f"control takes a network; say which: --network FILE{wanted}")
    if not callable(control):
        raise UsageError("a robot as an ODE needs control(x), or a network: --network FILE")
    names = getattr(target, "state_names", None)
    asked = getattr(target, "requirements", ())
    if not isinstance(asked, Sequence) or not all(callable(getattr(r, "formula", None)) for r in asked):
        raise UsageError("requirements must be a list of Inside, Outside and Holds")
    return Plant(
        target.rate,
        control,
        getattr(target, "period", None),
        getattr(target, "horizon", None),
        _box("start", getattr(target, "start", None)),
        _box("disturbance", getattr(target, "disturbance", None)),
        None if names is None else tuple(names),
        tuple(asked),
    )


def _needs_a_network(control: Any) -> bool:
    try:
        wanted = inspect.signature(control).parameters.values()
    except (TypeError, ValueError):
        return False
    return (
        len([p for p in wanted if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]) > 1
    )


def _box(name: str, given: Any) -> Box | None:
    if given is None or isinstance(given, Box):
        return given
    try:
        lower, upper = (torch.tensor([float(pair[i]) for pair in given], dtype=torch.float64) for i in (0, 1))
    except (TypeError, ValueError, IndexError):
        raise UsageError(f"{name} must be a pair of numbers for each state, found {given!r}") from None
    if not bool((lower <= upper).all()):
        raise UsageError(f"{name} must be a pair (lower, upper) for each state, found {given!r}")
    return Box(lower, upper)


def prove_ode(
    plant: Plant,
    *,
    start: Box | None = None,
    disturbance: Box | None = None,
    horizon: int | None = None,
    period: float | None = None,
    requirements: Sequence[Requirement] = (),
    scene: Mapping[str, Any] | None = None,
    goal: Box | None = None,
    position: Sequence[int | str] | None = None,
    state_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    propagator: str | Propagator = "affine",
    partitions: int | str | Sequence[int] = "auto",
    budget: int = 64,
    substeps: int | None = None,
    order: int | None = None,
    restarts: int = 1,
    seed: int = 0,
    certificate: Path | str | None = None,
    overwrite: bool = False,
    figure: Path | str | None = None,
    name: str = "loop",
) -> OdeProof:
    """Prove that every solution of ``x' = f(x, u_k) + w(t)``, ``u_k = c(x(t_k))`` held for a period, keeps its
    requirements at all times that they speak of, or find one that does not.

    For all starts in X_I and all measurable signals in W, in real arithmetic, of the functions as they were recorded.

    Args:
        plant: the robot and its controller, see :func:`plant_of`; what follows goes before what it says.
        start, disturbance: X_I and W, ``(n,)``.
        horizon: periods.
        period: seconds.
        requirements: beside the plant's own.
        scene, goal, position: as of :func:`~sagemp_cli.stages.prove.prove`; they are requirements as well.
        state_names, state_units: n words each.
        propagator: ``affine``.
        partitions: cells as of :func:`~sagemp_cli.reachability.any_loop.reach`; ``"auto"`` takes as many as the proof
            needs.
        budget: cells at most with ``"auto"``.
        substeps, order: how a period is cut and expanded; as fine as the proof needs by default.
        restarts: 0 for no attack.
        seed: of the attack.
        certificate: file to write; None writes nothing.
        overwrite: replace it if it is there.
        figure: file to draw; None draws nothing.
        name: what the loop is called in both.

    Raises:
        UsageError: an argument that does not fit, or functions that are not functions of their arguments.
        ArtifactError: the file is there already.
        UnsupportedOperationError: an operation that cannot be bounded.
    """
    began, path = time.monotonic(), None if certificate is None else Path(certificate)
    if path is not None:
        refuse_existing(path, overwrite)
    start = plant.start if start is None else start
    if start is None:
        raise UsageError("no start box is given: --start")
    n = start.dim
    names = (
        tuple(f"x{i}" for i in range(n))
        if state_names is None and plant.state_names is None
        else tuple(state_names if state_names is not None else plant.state_names or ())
    )
    if len(names) != n or len(set(names)) != n:
        raise UsageError(f"state_names: {n} states need {n} different words, found {', '.join(map(str, names))}")
    units = ("",) * n if state_units is None else tuple(state_units)
    if len(units) != n:
        raise UsageError(f"state_units: {n} states need {n} words, found {len(units)}")
    period, horizon = plant.period if period is None else period, plant.horizon if horizon is None else horizon
    if period is None:
        raise UsageError("no period is given: --period SECONDS between two samples")
    if horizon is None:
        raise UsageError("no horizon is given: --horizon, in periods")
    claim = claim_of(scene_data(scene, goal), names, position, Between.SEGMENTS)
    asked = (*plant.requirements, *requirements, *of_scene(claim.scene, claim.position))
    formulas = [requirement.formula(names) for requirement in asked]
    counts, chosen = counts_of(partitions, start), propagator_of(propagator)
    w = plant.disturbance if disturbance is None else disturbance
    seen = observed_ode(plant.rate, plant.control, start, w, period=period, horizon=horizon)
    proof = verify_ode(
        seen,
        chosen,
        formulas,
        counts=counts,
        budget=budget,
        substeps=substeps,
        order=order,
        restarts=restarts,
        generator=torch.Generator().manual_seed(seed),
    )
    if path is not None:
        config = {
            "name": name,
            "horizon": seen.loop.horizon,
            "seed": seed,
            "start": corners(seen.start),
            "disturbance": corners(seen.disturbance),
        }
        header = Header(stage="prove", experiment=name, config=config, seed=seed, seconds=time.monotonic() - began)
        record = ode_certificate(proof, state_names=names, state_units=units)
        write_artifact(path, record, header, overwrite=overwrite)
    if figure is not None:
        save_figure(draw_ode(proof, name, names, units, _limits(asked, names)), Path(figure))
    return proof


def _limits(asked: Sequence[Requirement], names: Sequence[str]) -> Mapping[int, list[tuple[float, float]]]:
    """Bounds that a figure can show, of each state."""
    found: dict[int, list[tuple[float, float]]] = {}
    for requirement in asked:
        if isinstance(requirement, Inside):
            for state, sides in requirement.bounds.items():
                i = names.index(state) if isinstance(state, str) else state
                found.setdefault(i, []).append(sides)
    return found
