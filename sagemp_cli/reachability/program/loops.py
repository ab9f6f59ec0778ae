"""Closed loops as programs: what every propagator gets, whatever the loop was written as."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeGuard

import torch
from torch import Tensor

from sagemp_cli.errors import SagempError, UsageError
from sagemp_cli.reachability.program.numbers import numbers_are_added
from sagemp_cli.reachability.program.program import Outputs, Program
from sagemp_cli.reachability.program.recorder import Recorder
from sagemp_cli.reachability.program.tape import Place, Tape
from sagemp_cli.reachability.program.value import Traced, exact
from sagemp_cli.reachability.propagator import Loop
from sagemp_cli.sets import Box


@dataclass(frozen=True, eq=False)
class RecordedLoop:
    """A closed loop as data.

    Attributes:
        programs: one for all steps, or one per step.
        numbers: what each step has of its own, ``(K, ..., g)``; dimensions between are a batch of loops.
        horizon: number of steps K.
    """

    programs: tuple[Program, ...]
    numbers: Tensor
    horizon: int

    @property
    def state_dim(self) -> int:
        """Number of states n."""
        return self.programs[0].states

    @property
    def batch(self) -> torch.Size:
        """Shape of the batch of loops that this is."""
        return self.numbers.shape[1:-1]

    def numbers_in(self, batch: torch.Size) -> Tensor:
        """The numbers of all steps for a batch that the loop's own broadcasts to, ``(K, *batch, g)``."""
        own = self.batch
        between = (1,) * (len(batch) - len(own))
        numbers = self.numbers.reshape(self.horizon, *between, *own, self.numbers.shape[-1])
        return numbers.expand(self.horizon, *batch, -1)

    def program(self, k: int) -> Program:
        """Of step k."""
        return self.programs[k if len(self.programs) > 1 else 0]

    def outputs(self, k: int, x: Any, w: Any) -> Outputs:
        """What step k gives, from ``x_k (..., n)`` and ``w_k (..., d)``."""
        return self.program(k).run(x, w, self.numbers[k])

    def step(self, k: int, x: Any, w: Any) -> Any:
        """``x_{k+1}`` from ``x_k (..., n)`` and ``w_k (..., d)``."""
        return self.outputs(k, x, w).next


def recorded(loop: Loop, start: Box, disturbance: Box) -> RecordedLoop:
    """The loop as programs; one that is recorded already as it is.

    A loop that says what its steps have of their own (``numbers``, ``step_given``) is one program, with that as the
    step's numbers. Of any other every step is recorded by itself; steps that turn out to be the same are one program.

    Args:
        loop: steps in torch operations; see :class:`~sagemp_cli.reachability.propagator.Loop`.
        start, disturbance: boxes ``(..., n)`` and ``(d,)``; an example is computed at a centre of theirs.

    Raises:
        UnsupportedOperationError: an operation that cannot be bounded.
        UsageError: a step that returns something else than the next state.
    """
    if isinstance(loop, RecordedLoop):
        return loop
    if getattr(loop, "continuous", False):
        raise UsageError(
            "the loop is in continuous time, where a step is a simulated solution and no proof; its sets are found by "
            "reach_continuously"
        )
    steps = loop.horizon
    x, w = start.center.reshape(-1, start.dim)[0], disturbance.center.reshape(-1, disturbance.dim)[0]
    if _says_its_steps(loop):
        says = loop
        numbers = says.numbers().to(torch.float64)
        example = numbers.flatten(0, -2)[0]
        program = record(lambda x, w, numbers: says.step_given(numbers, x, w), x, w, example)
        return RecordedLoop((program,), numbers, steps)
    return recorded_steps(loop.step, x, w.expand(steps, -1))


class _SaysItsSteps(Protocol):
    def numbers(self) -> Tensor: ...

    def step_given(self, numbers: Tensor, x: Tensor, w: Tensor) -> Any: ...


def _says_its_steps(loop: Any) -> TypeGuard[_SaysItsSteps]:
    """Whether a loop's ``step_given`` says what its ``step`` does: whether none of its classes came later with another
    ``step`` or ``control``.
    """
    kinds = type(loop).__mro__
    last = next((i for i, kind in enumerate(kinds) if "step_given" in vars(kind)), None)
    if last is None or any(name in getattr(loop, "__dict__", {}) for name in ("step", "control")):
        return False
    return not any(name in vars(kind) for kind in kinds[:last] for name in ("step", "control"))


def recorded_steps(
    call: Callable[[int, Any, Any], Any],
    state: Tensor,
    disturbances: Tensor,
    *,
    batched: bool = False,
    numbers: bool = True,
) -> RecordedLoop:
    """Steps as one program where they are one, else as one each.

    Args:
        call: ``(k, x, w)``, otherwise as of :func:`record`.
        state: of the example, ``(n,)``.
        disturbances: of the example, for each step, ``(K, d)``.
        batched: see :func:`record`.
        numbers: whether steps that differ in what they add may be one program, with numbers of each step's own.
    """
    one = _as_one(call, state, disturbances, batched=batched, numbers=numbers)
    if one is not None:
        return one
    programs = [record(functools.partial(call, k), state, w, batched=batched) for k, w in enumerate(disturbances)]
    if all(programs[0].same_as(other) for other in programs[1:]):
        programs = programs[:1]
    steps = len(disturbances)
    return RecordedLoop(tuple(programs), torch.zeros(steps, 0, dtype=torch.float64), steps)


def _as_one(
    call: Callable[[int, Any, Any], Any], state: Tensor, disturbances: Tensor, *, batched: bool, numbers: bool
) -> RecordedLoop | None:
    """The first step recorded, and the others told again on its :class:`Tape`; None where they may differ."""
    if torch.is_grad_enabled():  # a tape has copies of constants, and a tube may be differentiated by these
        return None
    steps, disturbance = len(disturbances), disturbances[0]
    tape = Tape(Traced)
    program = record(functools.partial(call, 0), state, disturbance, batched=batched, tape=tape)
    others: list[dict[Place, Any]] = [{}]
    for k in range(1, steps):
        found = tape.again(functools.partial(call, k))
        if found is None or (found and not numbers):
            return None
        others.append(found)
    places = sorted({place for found in others for place in found})
    if not places:
        return RecordedLoop((program,), torch.zeros(steps, 0, dtype=torch.float64), steps)
    try:
        columns = [
            torch.stack([exact(found.get(place, tape.constant(place)), operation="add").clone() for found in others])
            for place in places
        ]
        sizes = [0, *itertools.accumulate(column[0].numel() for column in columns)]
        where = {
            place: (slice(first, last), column.shape[1:])
            for place, column, (first, last) in zip(places, columns, itertools.pairwise(sizes), strict=True)
        }
        own = torch.cat([column.reshape(steps, -1) for column in columns], dim=1)
        tape = Tape(Traced, where)
        program = record(functools.partial(call, 0), state, disturbance, own[0], batched=batched, tape=tape)
    except SagempError:  # the steps one by one say what is wrong
        return None
    return RecordedLoop((program,), own, steps) if numbers_are_added(program) else None


def record(
    call: Callable[..., Any],
    state: Tensor,
    disturbance: Tensor,
    numbers: Tensor | None = None,
    *,
    batched: bool = False,
    tape: Tape | None = None,
) -> Program:
    """The program of one call.

    Args:
        call: of values that stand for ``x (n,)``, ``w (d,)`` and, if there are any, the numbers ``(g,)``; it returns
            the next state, or next state, control and deviation, the last two or one of which may be missing or None.
        state, disturbance, numbers: an example, ``(n,)``, ``(d,)``, ``(g,)``.
        batched: whether the call takes batches, and gets batches of one.
        tape: what to keep the recording on. The call gets no numbers then: they are where the tape has places for them.
    """
    recorder = Recorder(state, disturbance, torch.zeros(0, dtype=torch.float64) if numbers is None else numbers)
    ids = [recorder.state, recorder.disturbance, *([] if numbers is None or tape else [recorder.numbers])]
    inputs = [Traced(recorder, i[None].clone() if batched else i.clone()) for i in ids]
    result = call(*inputs) if tape is None else tape.run(call, *inputs)
    if recorder.refusal is not None:
        raise recorder.refusal
    parts = dict(
        zip(("next", "control", "deviation"), result if isinstance(result, tuple) else (result,), strict=False)
    )
    check_state(parts["next"], inputs[0].shape)
    return recorder.finish(**{name: _ids(recorder, part) for name, part in parts.items()})


def _ids(recorder: Recorder, value: Any) -> Tensor | None:
    if value is None:
        return None
    if not isinstance(value, Traced):
        return recorder.constant(exact(value, operation="return")).reshape(-1)
    if value.recorder is not recorder:
        raise UsageError("step returned a value of an earlier call; it must be a function of x and w only")
    return value.ids.reshape(-1)


def check_state(result: Any, shape: Sequence[int]) -> None:
    """Refuse what is not the next state.

    Raises:
        UsageError: it is no tensor, or of another shape than the state.
    """
    if not isinstance(result, (Tensor, Traced)):
        raise UsageError(
            f"step returned a {type(result).__name__}, expected the next state as a tensor of shape {tuple(shape)}"
        )
    if result.shape != shape:
        raise UsageError(f"step returned shape {tuple(result.shape)}, expected {tuple(shape)} as that of x")
