"""Intervals of values: what no state leaves, exact ends where they are known, and nothing claimed elsewhere."""

import numpy as np
import pytest

from sagemp_cli.checker.balls import BITS, arb, ctx
from sagemp_cli.checker.beside import Beside, Combinations
from sagemp_cli.checker.loop import Folded

from .by_hand import OF_ONE, OF_TWO, line, program, run

LIMITED = line("clamp", 0, constants=[-1.0, -2.0, 3.0, 4.0])  # slot 2: [-1, 3], [-2, 4]
RANGES = {
    "limits": ([LIMITED], [(-1, 3), (-2, 4)]),
    "one limit only": ([line("clamp", 0, constants=[-1.0, -np.inf, np.inf, 4.0])], [None, None]),
    "minus limits": ([LIMITED, line("neg", 2)], [(-3, 1), (-4, 2)]),
    "the other one twice": ([LIMITED, line("pick", 2, entries=[1, 1])], [(-2, 4)] * 2),
    "joined": ([LIMITED, line("pick", 2, entries=[1]), line("tanh", 3), line("join", 3, 4)], None),
    "a sum": ([LIMITED, line("sin", 0), line("add", 2, 3)], [(-2, 4), (-3, 5)]),
    "a difference": ([LIMITED, line("sigmoid", 0), line("sub", 2, 3)], [(-2, 3), (-3, 4)]),
    "less one entry": ([LIMITED, line("pick", 2, entries=[0]), line("sub", 2, 3)], [(0, 0), (-5, 5)]),
    "one entry less all": ([LIMITED, line("pick", 2, entries=[0]), line("sub", 3, 2)], [(0, 0), (-5, 5)]),
    "scaled": ([LIMITED, line("constant", constants=[2.0, -0.5]), line("mul", 2, 3)], [(-2, 6), (-2, 1)]),
    "numbers times limits": ([LIMITED, line("constant", constants=[-1.0]), line("mul", 3, 2)], [(-3, 1), (-4, 2)]),
    "no part of it": ([LIMITED, line("constant", constants=[0.0]), line("mul", 3, 0)], [(0, 0)] * 2),
    "a product": ([LIMITED, line("cos", 0), line("mul", 2, 3)], [(-3, 3), (-4, 4)]),
    "a square": ([LIMITED, line("mul", 2, 2)], [(0, 9), (0, 16)]),
    "a matrix": ([LIMITED, line("linear", 2, constants=[1, -2, 0, 3, 0.5, -1])], [(-8.5, 7.5), (-7, 11)]),
    "the state": ([line("neg", 0)], [None, None]),
    "the state and limits": ([LIMITED, line("add", 2, 0)], [None, None]),
    "the state twice": ([line("neg", 0), line("add", 2, 0)], [(0, 0)] * 2),
    "a quotient": ([LIMITED, line("constant", constants=[2.0]), line("div", 2, 3)], [(-0.5, 1.5), (-1, 2)]),
    "across a pole": ([LIMITED, line("div", 2, 2)], [None, None]),
    "beside a pole": ([LIMITED, line("exp", 2), line("sigmoid", 0), line("div", 4, 3)], None),
}


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(BITS):
        yield


def ranges(made, states):
    """Of the next state."""
    combinations = Combinations(made, Folded.of(made).constants)
    beside = Beside(combinations, [*states, *[None] * (made.disturbances + made.numbers)])
    for slot in combinations.first:
        beside.know(slot, made.instructions[slot], beside.operands(slot))
    return beside.output(made.next)


@pytest.mark.parametrize("name", RANGES)
def test_a_range_is_what_every_state_keeps_to(name):
    lines, expected = RANGES[name]
    made = program(*lines, next=1 + len(lines))
    found = [r if r is None else (float(r[0]), float(r[1])) for r in ranges(made, [None, None])]
    if expected is not None:
        assert found == expected
    x = np.random.default_rng(0).normal(size=(2000, 2)) * np.exp(np.random.default_rng(1).normal(size=(2000, 1)) * 3)
    for of_entry, ends in zip(run(made, x, np.zeros((2000, 1))).T, found, strict=True):
        assert ends is None or (ends[0] <= of_entry.min() and of_entry.max() <= ends[1])


KINDS = [*((kind, ()) for kind in (*OF_ONE, "mul", "div", "maximum", "minimum", "logaddexp", "atan2") if kind != "neg")]
KINDS += [
    *(("pow", (e,)) for e in (2, 3, 4, -1, -2, -3, 1.5, 0.3, -0.7)),
    ("remainder", (0.7,)),
    ("fmod", (0.7,)),
    ("elu", (0.4,)),
    ("leaky_relu", (0.25,)),
    ("leaky_relu", (-0.5,)),
]
KINDS += [("elu", (1.0,)), ("elu", (2.0,)), ("softplus", (2.0, 20.0)), ("clamp", (-0.5, 1.5))]


@pytest.mark.parametrize(("kind", "constants"), KINDS, ids=str)
def test_the_range_of_a_function_is_what_its_values_reach(kind, constants):
    count = 2 if kind in OF_TWO else 1
    picks = [line("pick", 0, entries=[i]) for i in range(count)]
    first = 2 + count
    made = program(
        *picks, line(kind, *range(2, first), constants=constants), line("pick", first, entries=[0] * count),
        n=count, next=first + 1,
    )  # fmt: skip
    draw, bounded = np.random.default_rng(0), 0
    for _ in range(40):
        middle, radius = draw.normal(size=count) * 2, np.exp(draw.normal(size=count))
        sides = np.stack([middle - radius, middle + radius])
        ends = ranges(made, [(arb(a), arb(b)) for a, b in sides.T])[0]
        if ends is None:
            continue
        bounded += 1
        low, high = float(ends[0]), float(ends[1])
        grid = np.meshgrid(*np.linspace(*sides, 61 if count == 2 else 4001).T)
        reached = run(made, np.stack([g.ravel() for g in grid], 1), np.zeros((grid[0].size, 1)))[:, 0]
        doubt = 1e-12 * max(abs(low), abs(high), 1.0)  # of the sampled values
        assert low - doubt <= reached.min() and reached.max() <= high + doubt
        if kind != "atan2" or high < np.pi:  # a box that meets the jump has the whole circle
            room = {"silu": 0.05, "remainder": 0.01, "fmod": 0.01}.get(kind, 1e-3) * (high - low) + doubt
            assert reached.min() <= low + room and reached.max() >= high - room
    assert bounded
