"""What a control never leaves, whatever the state: exact ends where they are known, nothing claimed elsewhere."""

import numpy as np
import pytest

from sagemp_cli.checker.loop import Folded
from sagemp_cli.checker.ranges import range_of

from .by_hand import line, program, run

LIMITED = line("clamp", 0, constants=[-1.0, -2.0, 3.0, 4.0])  # slot 2: [-1, 3], [-2, 4]
RANGES = {
    "limits": ([LIMITED], [(-1, 3), (-2, 4)]),
    "one limit only": ([line("clamp", 0, constants=[-1.0, -np.inf, np.inf, 4.0])], [None, None]),
    "minus limits": ([LIMITED, line("neg", 2)], [(-3, 1), (-4, 2)]),
    "the other one twice": ([LIMITED, line("pick", 2, entries=[1, 1])], [(-2, 4)] * 2),
    "joined": ([LIMITED, line("pick", 2, entries=[1]), line("tanh", 3), line("join", 3, 4)], [(-2, 4), (-1, 1)]),
    "a sum": ([LIMITED, line("sin", 0), line("add", 2, 3)], [(-2, 4), (-3, 5)]),
    "a difference": ([LIMITED, line("sigmoid", 0), line("sub", 2, 3)], [(-2, 3), (-3, 4)]),
    "less one entry": ([LIMITED, line("pick", 2, entries=[0]), line("sub", 2, 3)], [(-4, 4), (-5, 5)]),
    "one entry less all": ([LIMITED, line("pick", 2, entries=[0]), line("sub", 3, 2)], [(-4, 4), (-5, 5)]),
    "scaled": ([LIMITED, line("constant", constants=[2.0, -0.5]), line("mul", 2, 3)], [(-2, 6), (-2, 1)]),
    "numbers times limits": ([LIMITED, line("constant", constants=[-1.0]), line("mul", 3, 2)], [(-3, 1), (-4, 2)]),
    "no part of it": ([LIMITED, line("constant", constants=[0.0]), line("mul", 3, 0)], [(0, 0)] * 2),
    "a product": ([LIMITED, line("cos", 0), line("mul", 2, 3)], [None, None]),
    "a matrix": ([LIMITED, line("linear", 2, constants=[1, -2, 0, 3, 0.5, -1])], [(-8.5, 7.5), (-7, 11)]),
    "the state": ([line("neg", 0)], [None, None]),
    "the state and limits": ([LIMITED, line("add", 2, 0)], [None, None]),
    "a quotient": ([LIMITED, line("constant", constants=[2.0]), line("div", 2, 3)], [None, None]),
}


@pytest.mark.parametrize("name", RANGES)
def test_a_range_is_what_every_state_keeps_to(name):
    lines, expected = RANGES[name]
    made = program(*lines, next=1 + len(lines))
    found = range_of(Folded.of(made), made.next)
    assert [r if r is None else (float(r[0]), float(r[1])) for r in found] == expected
    x = np.random.default_rng(0).normal(size=(2000, 2)) * np.exp(np.random.default_rng(1).normal(size=(2000, 1)) * 3)
    for values, ends in zip(run(made, x, np.zeros((2000, 1))).T, expected, strict=True):
        assert ends is None or (ends[0] <= values.min() and values.max() <= ends[1])
