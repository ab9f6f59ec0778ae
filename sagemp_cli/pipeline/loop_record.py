"""The closed loop of a claim as a certificate carries it: its step as a program, and what its numbers are called."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.program.loops import RecordedLoop
from sagemp_cli.reachability.program.stored import to_record
from sagemp_cli.storage import LoopRecord, ProgramRecord
from sagemp_cli.verification.cells import sampled_of, step_of


def loop_record(problem: Problem, tracker: Controller) -> LoopRecord:
    """The loop of a problem under a tracker; the same whatever the references."""
    dynamics = problem.dynamics
    if dynamics.continuous:
        return continuous_loop_record(
            sampled_of(problem, tracker),
            lookahead=tracker.lookahead,
            state_names=dynamics.state_names,
            state_units=dynamics.state_units,
            control_names=dynamics.control_names,
            control_units=dynamics.control_units,
            position=dynamics.position,
        )
    return LoopRecord(
        programs=tuple(map(to_record, step_of(problem, tracker))),
        step_program=np.zeros(problem.horizon, np.int64),
        lookahead=tracker.lookahead,
        state_names=dynamics.state_names,
        state_units=dynamics.state_units,
        control_names=dynamics.control_names,
        control_units=dynamics.control_units,
        position=np.array(dynamics.position, np.int64),
        dt=dynamics.dt,
    )


def deviation_record(problem: Problem, tracker: Controller) -> ProgramRecord:
    """The step of a learned robot's analytical model by way of the network: w enlarged by what the two differ by."""
    return to_record(step_of(problem, tracker, compared=True)[0])


def continuous_loop_record(
    loop: SampledLoop,
    *,
    lookahead: int = 0,
    state_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    control_names: Sequence[str] | None = None,
    control_units: Sequence[str] | None = None,
    position: Sequence[int] = (),
) -> LoopRecord:
    """A loop in continuous time: its control, its right-hand side and its period.

    Args:
        loop: it.
        lookahead: states of the reference that the numbers of an instant are; 0 if there is no reference.
        state_names, state_units, control_names, control_units: words; ``x0``, ``u0``, ... without units by default.
        position: entries of the state that are the position in the scene, if there is one.

    Raises:
        UsageError: its numbers are not those of the reference, or the names are not one for each state or control.
    """
    n, m, g = loop.state_dim, loop.controls, loop.control.numbers
    if g != lookahead * n:
        raise UsageError(
            f"the control has {g} numbers at every instant, {lookahead} states of a reference are {lookahead * n}"
        )
    return LoopRecord(
        programs=(to_record(loop.control),),
        step_program=np.zeros(loop.horizon, np.int64),
        lookahead=lookahead,
        state_names=_words(state_names, [f"x{i}" for i in range(n)], "states"),
        state_units=_words(state_units, [""] * n, "units of states"),
        control_names=_words(control_names, [f"u{i}" for i in range(m)], "controls"),
        control_units=_words(control_units, [""] * m, "units of controls"),
        position=np.array(list(position), np.int64),
        dt=loop.period,
        lag=None if loop.lag is None else torch.stack([loop.lag.lower, loop.lag.upper], -1).numpy(),
        rate=to_record(loop.rate),
    )


def _words(given: Sequence[str] | None, default: Sequence[str], what: str) -> tuple[str, ...]:
    words = tuple(default if given is None else given)
    if len(words) != len(default):
        raise UsageError(f"{len(default)} {what} need as many words, found {len(words)}")
    return words


def strangers_loop_record(
    loop: RecordedLoop,
    *,
    state_names: Sequence[str] | None = None,
    state_units: Sequence[str] | None = None,
    position: Sequence[int] = (),
    dt: float | None = None,
) -> LoopRecord:
    """A recorded loop of anybody's, without a reference.

    Args:
        loop: its programs; one for all steps, or one for each.
        state_names, state_units: n words each; ``x0``, ``x1``, ... without units by default.
        position: entries of the state that are the position in the scene, if there is one.
        dt: seconds between samples, if that means anything.

    Raises:
        UsageError: its steps have numbers of their own, or the names are not one for each state.
    """
    if loop.numbers.shape[-1]:
        raise UsageError("a loop whose steps have numbers of their own needs a reference to take them from")
    n, programs = loop.state_dim, loop.programs
    names = tuple(f"x{i}" for i in range(n)) if state_names is None else tuple(state_names)
    units = ("",) * n if state_units is None else tuple(state_units)
    if len(names) != n or len(units) != n:
        raise UsageError(f"{n} states need as many names and units, found {len(names)} and {len(units)}")
    control = programs[0].outputs.control
    m = 0 if control is None else programs[0].instructions[control].size
    which = np.arange(loop.horizon) if len(programs) > 1 else np.zeros(loop.horizon)
    return LoopRecord(
        programs=tuple(map(to_record, programs)),
        step_program=which.astype(np.int64),
        lookahead=0,
        state_names=names,
        state_units=units,
        control_names=tuple(f"u{i}" for i in range(m)),
        control_units=("",) * m,
        position=np.array(list(position), np.int64),
        dt=dt,
    )
