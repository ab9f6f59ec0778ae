"""One cell in balls: states and controls lie in what the file says, or the answer says where not."""

import dataclasses

import numpy as np
import pytest

from sagemp_cli.checker.cell import CellClaim, prove_cell
from sagemp_cli.checker.loop import Folded

from .by_hand import line, program

HALVED = program(line("constant", constants=[0.5]), line("mul", 0, 2), next=3, control=0, n=1)
"""``x' = x / 2``, whose control is the state itself: slot 0."""


def claim(**changes):
    """From [-1, 1], two steps; each control is the state before its step."""
    sides = np.array([[1.0], [0.5], [0.25]]) + 1e-12
    nothing = np.zeros((2, 0))
    made = CellClaim(
        np.zeros(2, np.int64), nothing, np.array([-1.0]), np.array([1.0]), -sides, sides, -sides[:2], sides[:2],
        np.zeros((2, 1)), np.zeros((2, 1)), nothing, nothing, nothing, None, None,
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def test_a_control_that_is_the_state_itself_is_proved_within_its_bounds():
    assert prove_cell(claim(), [Folded.of(HALVED)]) == ""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"control_upper": np.array([[1.0], [0.49]]) + 1e-12},
            "step 1: control 0 is only proved to lie in [-0.5, 0.5]",
        ),
        (
            {"tube_upper": np.array([[1.0], [0.5], [0.24]]) + 1e-12},
            "step 1: state 0 is only proved to lie in [-0.25, 0.25]",
        ),
        ({"tube_upper": np.array([[0.9], [0.5], [0.25]])}, "step 0: the tube does not contain the cell"),
        ({"deviation": np.zeros((2, 1))}, "step 0: the program has no deviation"),
    ],
)
def test_what_is_not_proved_is_said_with_its_step(changes, message):
    assert prove_cell(claim(**changes), [Folded.of(HALVED)]).startswith(message)
