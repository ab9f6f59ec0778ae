"""What is recorded of random programs is proved: bounds of operands here are at least as tight as where it was made."""

import dataclasses

import numpy as np
import pytest
import torch
from random_programs import random_problem

from sagemp_cli.checker.balls import BITS, ctx
from sagemp_cli.checker.cell import CellClaim, prove_cell
from sagemp_cli.checker.loop import Folded
from sagemp_cli.checker.program import Instruction, Program
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled import beside
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.sets import Box


def checked_program(program):
    """A recorded program as the checker has it."""
    made = [
        Instruction(
            i.kind,
            i.operands,
            np.concatenate([np.zeros(0), *(c.numpy().reshape(-1) for c in i.constants)]),
            np.array(i.entries, np.int64),
        )
        for i in program.instructions
    ]
    sizes = {"states": program.states, "disturbances": program.disturbances, "numbers": program.numbers}
    return Program.of(made, {"next": program.outputs.next}, **sizes)


def claim(loop, start: Box, disturbance: Box):
    """What a certificate of one cell claims, and the program; None if the tube is not bounded."""
    known = recorded(loop, start, disturbance)
    run = Affine().run(known, start, disturbance)
    if not bool(run.tube.bounded):
        return None
    record, tube = run.recording(), run.tube
    steps = known.horizon
    made = CellClaim(
        program=np.zeros(steps, int),
        windows=np.zeros((steps, 0)),
        lower=start.lower.numpy(),
        upper=start.upper.numpy(),
        tube_lower=tube.lower.numpy(),
        tube_upper=tube.upper.numpy(),
        control_lower=np.zeros((steps, 0)),
        control_upper=np.zeros((steps, 0)),
        disturbance_lower=disturbance.lower.expand(steps, -1).numpy(),
        disturbance_upper=disturbance.upper.expand(steps, -1).numpy(),
        slope=record.slope.numpy(),
        offset=record.offset.numpy(),
        radius=record.radius.numpy(),
        kept=None if record.kept is None else record.kept.numpy(),
        deviation=None,
    )
    return made, checked_program(known.programs[0])


def proved(made, program):
    with ctx.workprec(BITS):
        return prove_cell(made, [Folded.of(program)])


@pytest.mark.parametrize("seed", [*range(20), *(pytest.param(s, marks=pytest.mark.slow) for s in range(20, 60))])
def test_the_tube_of_a_random_program_is_proved(seed):
    with torch.no_grad():
        made = claim(*random_problem(seed))
    if made is not None:
        assert proved(*made) == ""


SQUASHED = {
    "clamp": lambda x, w: torch.clamp(3.0 * x, -1.0, 0.5) + w,
    "tanh of a sum of squares": lambda x, w: torch.tanh(4.0 * (x * x).sum(-1, keepdim=True)) - 0.5 + 0.0 * x + w,
    "a saturated control that turns": lambda x, w: 0.5 * x + torch.clamp(9.0 * x, -1.0, 1.0) * torch.cos(x) + w,
    "root of what is not negative": lambda x, w: torch.sqrt(torch.relu(x)) + w,
    "larger and smaller of two": lambda x, w: torch.minimum(torch.maximum(x, torch.flip(x, [-1])), 0.3 * x + 0.5) + w,
    "a limit by hand": lambda x, w: torch.where(x > 0.4, 0.4 + 0.0 * x, 0.9 * x) + w,
    "a switch": lambda x, w: 0.5 * x - 0.2 * torch.where(x + 0.5 * x.flip(-1) > 0, 1.0 + 0.1 * x, -0.5 * x) + w,
    "gelu and what is rounded": lambda x, w: 0.5 * torch.nn.functional.gelu(3 * x) - 0.1 * torch.round(8 * x) + w,
    "an angle that is wrapped": lambda x, w: 0.3 * torch.atan2(torch.sin(4 * x), torch.cos(4 * x)) + w,
    "a share": lambda x, w: 0.25 * torch.exp(x) / torch.exp(x).sum(-1, keepdim=True) + w,
}


class Loop:
    horizon, state_dim = 4, 2

    def __init__(self, function):
        self.function = function

    def step(self, k, x, w):
        return self.function(x, w)


@pytest.fixture(params=SQUASHED)
def squashed(request, monkeypatch):
    """A claim whose proof rests on intervals wherever they are tighter at all, and the program."""
    for share in ("NOTICEABLE", "NOTICEABLE_AT_A_KINK"):
        monkeypatch.setattr(beside, share, 1.0)
    with torch.no_grad():
        return claim(
            Loop(SQUASHED[request.param]), Box.around([0.1, -0.2], [0.8, 0.9]), Box.around([0.0] * 2, [0.02] * 2)
        )


def test_what_intervals_make_tighter_is_proved(squashed):
    assert proved(*squashed) == ""


@pytest.mark.parametrize("name", SQUASHED)
def test_what_intervals_make_noticeably_tighter_is_proved(name):
    with torch.no_grad():
        made = claim(Loop(SQUASHED[name]), Box.around([0.1, -0.2], [0.8, 0.9]), Box.around([0.0] * 2, [0.02] * 2))
    assert proved(*made) == ""


@pytest.mark.parametrize("end", ["tube_lower", "tube_upper"])
@pytest.mark.parametrize("step", [1, 4])
@pytest.mark.parametrize("share", [1e-6, 1e-2])
def test_a_tube_within_what_rows_and_intervals_allow_is_refused(squashed, end, step, share):
    made, program = squashed
    side = getattr(made, end).copy()
    width = made.tube_upper[step] - made.tube_lower[step]
    side[step] += share * width * (1 if end == "tube_lower" else -1)
    assert proved(dataclasses.replace(made, **{end: side}), program) != ""


@pytest.mark.parametrize("what", ["slope", "offset", "radius"])
@pytest.mark.parametrize("seed", range(4))
def test_relaxations_that_intervals_do_not_allow_are_refused(squashed, what, seed):
    made, program = squashed
    part = getattr(made, what).copy()
    wide = np.argwhere(made.radius > 1e-4)
    k, entry = wide[np.random.default_rng(seed).integers(len(wide))]
    part[k, entry] = 0.98 * part[k, entry] if what == "radius" else part[k, entry] + 0.3 * made.radius[k, entry]
    answer = proved(dataclasses.replace(made, **{what: part}), program)
    if what != "slope":  # another line may be as good within the radius that was recorded
        assert answer != ""
    elif answer:
        assert "relaxation" in answer or "scale" in answer or "state" in answer


@pytest.mark.parametrize("name", ["a limit by hand", "a switch"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_branch_is_not_taken_where_its_condition_is_not_decided(name, side):
    with torch.no_grad():
        made, program = claim(
            Loop(SQUASHED[name]), Box.around([0.1, -0.2], [0.8, 0.9]), Box.around([0.0] * 2, [0.02] * 2)
        )
    names = [name for slot in program.relaxed for name, count in slot for _ in range(count)]
    entry = names.index("ratio")
    assert made.offset[0, entry] == 0.0 and proved(made, program) == ""
    offset = made.offset.copy()
    offset[0, entry] = side
    assert "not decided as it is recorded" in proved(dataclasses.replace(made, offset=offset), program)


def test_a_branch_that_is_decided_is_itself_and_not_the_other_one():
    loop = Loop(lambda x, w: torch.where(x > -3.0, 0.5 * x, 0.7 * x) + w)
    with torch.no_grad():
        made, program = claim(loop, Box.around([0.1, -0.2], [0.8, 0.9]), Box.around([0.0] * 2, [0.02] * 2))
    assert proved(made, program) == ""
    assert (made.offset == 1.0).any()
    other = np.where(made.offset == 1.0, -1.0, made.offset)
    assert proved(dataclasses.replace(made, offset=other), program) != ""
