"""What is no program is refused in one line, before anything of it is computed."""

import time
from pathlib import Path

import numpy as np
import pytest

from sagemp_cli.checker.program import KINDS, Program

from .by_hand import line, program


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([line("sin", 2)], "slot 2 of the program (sin): it reads slots 2, only earlier ones are there"),
        ([line("sin", 7)], "it reads slots 7"),
        ([line("sin", -1)], "it reads slots -1"),
        ([line("eval", 0)], "slot 2 of the program (eval): there is no such instruction"),
        ([line("sin", 0, 1)], "it reads 2 slots, 1 are needed"),
        ([line("add", 0)], "it reads 1 slots, 2 are needed"),
        ([line("join")], "it reads 0 slots, 1 are needed"),
        ([line("linear", 0, constants=[1.0] * 7)], "7 constants are no matrix and bias of an operand of 2 entries"),
        ([line("linear", 0)], "its result has no entries"),
        ([line("constant")], "its result has no entries"),
        ([line("pick", 0)], "its result has no entries"),
        ([line("pick", 0, entries=[2])], "it picks entries that an operand of 2 does not have"),
        ([line("pick", 0, entries=[-1])], "it picks entries that an operand of 2 does not have"),
        ([line("neg", 0, entries=[0])], "only 'pick' has entries"),
        ([line("neg", 0, constants=[1.0])], "it has 1 constants, 0 are needed"),
        ([line("leaky_relu", 0)], "it has 0 constants, 1 are needed"),
        ([line("softplus", 0, constants=[1.0])], "it has 1 constants, 2 are needed"),
        ([line("constant", constants=[np.nan, 1.0])], "its constants must be finite"),
        ([line("linear", 0, constants=[np.inf] * 6)], "its constants must be finite"),
        ([line("clamp", 0, constants=[np.nan, 0.0, 0.0, 1.0])], "it needs 2 lower and 2 upper limits that are numbers"),
        ([line("clamp", 0, constants=[np.inf, 0.0, np.inf, 1.0])], "it needs 2 lower and 2 upper limits"),
        ([line("clamp", 0, constants=[0.0, 1.0])], "it needs 2 lower and 2 upper limits"),
        ([line("pow", 0, constants=[1.0])], "it needs an exponent but 0 and 1 below 2^31 in size, found 1.0"),
        ([line("pow", 0, constants=[1e300])], "it needs an exponent but 0 and 1 below 2^31"),
        ([line("pow", 0, constants=[2.0**31])], "it needs an exponent but 0 and 1 below 2^31"),
        ([line("leaky_relu", 0, constants=[1.5])], "it needs a slope of at most 1, found 1.5"),
        ([line("softplus", 0, constants=[0.0, 20.0])], "it needs a positive beta, found 0.0"),
        ([line("elu", 0, constants=[-2.0])], "it needs a positive alpha, found -2.0"),
        ([line("where", 0, 1)], "it reads 2 slots, 3 are needed"),
        ([line("join", 0, 1), line("where", 0, 2, 1)], "its operands have 2 and 3 and 1 entries"),
        ([line("fmod", 0, constants=[0.0])], "it needs a positive period, found 0.0"),
        ([line("state")], "the inputs come first: state, disturbance, numbers"),
        ([line("neg", 0), line("numbers")], "the inputs come first: state, disturbance, numbers"),
        ([line("join", 0, 1), line("add", 0, 2)], "its operands have 2 and 3 entries"),
        ([line("pick", 0, entries=[0])], "'next' of the program has 1 entries, 2 are needed"),
    ],
)  # fmt: skip
def test_what_is_no_program_is_refused(lines, message):
    with pytest.raises(ValueError) as error:
        program(*lines, next=1 + len(lines))
    assert message in str(error.value)


@pytest.mark.parametrize("outputs", [{}, {"next": 5}, {"next": -1}, {"next": 0, "control": 9}, {"next": 0, "more": 1}])
def test_outputs_must_be_there(outputs):
    with pytest.raises(ValueError, match="outputs"):
        program(**outputs)


START = [line("state"), line("disturbance")]


def doubling(levels):
    return [*START, *(line("join", slot, slot) for slot in range(1, levels))]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (doubling(200), "the program has more than 200000 entries"),
        ([*START, line("pick", 0, entries=np.zeros(10**6))], "more than 200000 entries"),
        ([*START, *[line("neg", 0)] * 30_000], "30002 instructions, more than 10000"),
        ([*START, *(line("sin", i) for i in range(1, 9_000))], "numbers, more than 20000000"),
        ([*START, line("join", *[0] * 40_000), line("mul", 2, 2)], "more than 20000000"),
    ],
)
def test_a_program_that_nobody_could_check_is_refused_at_once(lines, message):
    began = time.process_time()
    with pytest.raises(ValueError, match=message):
        Program.of(lines, {"next": 0}, states=2, disturbances=1, numbers=0)
    assert time.process_time() - began < 2


def test_relaxations_are_those_of_the_specification_in_its_order():
    made = program(
        line("constant", constants=[2.0]), line("mul", 0, 0), line("mul", 2, 3), line("div", 0, 2), line("div", 2, 0),
        line("div", 3, 0), line("maximum", 0, 2), line("maximum", 0, 3), line("atan2", 0, 2),
        line("pow", 0, constants=[2]), line("neg", 0), line("sin", 2), line("clamp", 0, constants=[0] * 4),
        line("linear", 0, constants=[0.0] * 6), line("identity", 1), next=0,
    )  # fmt: skip
    assert [r for slot in made.relaxed for r in slot] == [
        ("product", 2), ("reciprocal", 2), ("reciprocal", 2), ("product", 2), ("clamp", 2), ("relu", 2),
        ("atan2", 2), ("direction", 2),
        ("pow", 2), ("clamp", 2), ("identity", 1),
    ]  # fmt: skip


def test_every_kind_of_the_specification_is_known():
    text = (Path(__file__).parents[2] / "docs" / "program.md").read_text().split("## Instructions")[1].split("## ")[0]
    named = {w.strip("` ") for row in text.splitlines() if row.startswith("| `") for w in row.split("|")[1].split(",")}
    assert named == set(KINDS)


def test_a_step_with_its_deviation_added_to_w_is_told_from_others_by_its_control_too():
    lines = [line("neg", 0), line("identity", 2), line("add", 1, 3), line("add", 0, 4)]
    deviating = program(*lines, d=2, next=5, control=0, deviation=2)
    same = [line("neg", 0), line("add", 0, 1)]
    assert deviating.is_deviating(program(*same, d=2, next=3, control=0))
    assert not deviating.is_deviating(program(*same, d=2, next=3, control=2))
    assert not deviating.is_deviating(program(*same, d=2, next=3))
    assert not deviating.is_deviating(program(*same, d=2, next=2, control=0))
