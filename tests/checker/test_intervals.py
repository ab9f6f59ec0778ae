"""Interval arithmetic of the checker encloses every value and loses nothing in a single operation."""

import numpy as np
import pytest

from sagemp_cli.checker.balls import BITS, balls, ctx
from sagemp_cli.checker.intervals import NOTHING, Bounds, points
from sagemp_cli.checker.unproved import Unproved

from .by_hand import line, program, run

ONE = {
    "neg": (-3, 3), "sin": (-9, 9), "cos": (-9, 9), "tan": (-1.5, 1.5), "atan": (-4, 4), "tanh": (-4, 4),
    "sigmoid": (-6, 6), "silu": (-5, 3), "exp": (-3, 3), "log": (0.1, 4), "sqrt": (0, 4), "reciprocal": (0.2, 3),
    "identity": (-1, 1), "wrap": (-3, 3), "gelu_tanh": (-3, 3),
}  # fmt: skip
TWO = {"add": (-2, 2), "sub": (-2, 2), "mul": (-2, 2), "div": (0.3, 2), "atan2": (0.1, 2), "logaddexp": (-3, 3)}
POWERS = [2, 3, 4, 5, -1, -2, -3, 1.5, 0.3, -0.7]


def bounds(made, lower, upper):
    with ctx.workprec(BITS):
        box = list(zip(balls(lower), balls(upper), strict=True))
        (found,) = Bounds(made, made.next).of({"state": [box]})
        return np.array([[float(a), float(b)] for a, b in found]).T


def of_one(kind, **parts):
    return program(line(kind, 0, **parts), n=1, d=1, next=2)


def of_two(kind):
    return program(line("pick", 0, entries=[0]), line("pick", 0, entries=[1]), line(kind, 2, 3),
                   line("join", 4, 2), n=2, d=1, next=5)  # fmt: skip


def boxes(low, high, n, count=60):
    rng = np.random.default_rng(7)
    for i in range(count):
        ends = np.sort(rng.uniform(low, high, (2, n)), axis=0)
        yield ends if i % 10 else np.stack([ends[0], ends[0]])
    yield np.array([[low] * n, [high] * n], float)


def require_close(made, ends, n, *, exact):
    """Every sample lies within, and some samples are near both ends."""
    line_of = np.linspace(ends[0], ends[1], 41 if n > 1 else 2001)
    x = np.array(np.meshgrid(*line_of.T)).reshape(n, -1).T
    values = run(made, x, np.zeros((len(x), 1)))[:, 0]
    low, high = bounds(made, *ends)[:, 0]
    slack = 1e-13 * (1 + np.abs(values).max())
    assert (low - slack <= values).all() and (values <= high + slack).all()
    if exact:  # as far as a grid can tell beside an extreme value inside
        assert values.min() - low <= slack + 1e-4 * (high - low) and high - values.max() <= slack + 1e-4 * (high - low)


@pytest.mark.parametrize("kind", ONE)
def test_a_function_of_one_value_is_bounded_as_near_as_can_be(kind):
    for ends in boxes(*ONE[kind], 1):
        require_close(of_one(kind), ends, 1, exact=True)
        if kind == "reciprocal":
            require_close(of_one(kind), -ends[::-1], 1, exact=True)


@pytest.mark.parametrize("exponent", POWERS)
def test_a_power_is_bounded_as_near_as_can_be(exponent):
    whole = exponent % 1 == 0
    for low, high in ((0.2, 2), *([(-2, -0.2)] if whole else []), *([(-2 * whole, 2)] if exponent > 0 else [])):
        for ends in boxes(low, high, 1, 30):
            require_close(of_one("pow", constants=[exponent]), ends, 1, exact=True)


@pytest.mark.parametrize("kind", TWO)
def test_a_pair_is_bounded_by_its_corners(kind):
    for ends in boxes(*TWO[kind], 2, 30):
        require_close(of_two(kind), ends, 2, exact=True)
        if kind == "atan2":  # on the other side of the origin, away from the jump
            flipped = np.stack([[-ends[1, 0], ends[0, 1]], [-ends[0, 0], ends[1, 1]]])
            require_close(of_two(kind), flipped, 2, exact=True)


def test_a_matrix_is_bounded_row_by_row():
    rng = np.random.default_rng(3)
    matrix, bias = rng.normal(size=(3, 3)), rng.normal(size=3)
    made = program(line("linear", 0, constants=[*matrix.ravel(), *bias]), n=3, d=1, next=2)
    low, high = np.array([-1.0, 0.5, -2.0]), np.array([1.0, 0.75, -2.0])
    found = bounds(made, low, high)
    reach = np.abs(matrix) @ ((high - low) / 2)
    middle = matrix @ ((high + low) / 2) + bias
    np.testing.assert_allclose(found, [middle - reach, middle + reach], rtol=1e-14)


def test_a_value_times_itself_is_its_square_and_nothing_stays_nothing():
    made = program(line("mul", 0, 0), n=1, d=1, next=2)
    np.testing.assert_array_equal(bounds(made, [-1.0], [2.0]), [[0.0], [4.0]])
    with ctx.workprec(BITS):
        product = program(line("pick", 0, entries=[0]), line("pick", 0, entries=[1]), line("mul", 2, 3),
                          line("join", 4, 4), n=2, d=1, next=5)  # fmt: skip
        (found,) = Bounds(product, 5).of({"state": [[NOTHING, *points(balls([3.0]))]]})
        assert found[0] is NOTHING


def test_columns_are_bounded_each_for_itself():
    made = program(line("mul", 0, 2), n=1, d=1, g=1, next=3)
    with ctx.workprec(BITS):
        given = [points(balls([v])) for v in (1.0, -2.0)]
        found = Bounds(made, 3).of({"state": [list(zip(balls([1.0]), balls([3.0]), strict=True))], "numbers": given})
        assert [[tuple(map(float, entry)) for entry in column] for column in found] == [[(1.0, 3.0)], [(-6.0, -2.0)]]


@pytest.mark.parametrize(
    ("made", "lower", "upper", "message"),
    [
        (of_one("reciprocal"), [-1.0], [1.0], "divisor"),
        (of_one("reciprocal"), [0.0], [1.0], "divisor"),
        (of_one("pow", constants=[-2]), [-1.0], [1.0], "divisor"),
        (of_one("log"), [0.0], [1.0], "logarithm"),
        (of_one("sqrt"), [-1e-300], [1.0], "root"),
        (of_one("tan"), [1.5], [1.6], "tangent"),
        (of_one("tan"), [-2.0], [2.0], "tangent"),
        (of_two("div"), [1.0, -1.0], [2.0, 1.0], "divisor"),
        (of_two("atan2"), [-1.0, -2.0], [1.0, -1.0], "jump"),
        (of_two("atan2"), [0.0, -2.0], [1.0, -1.0], "jump"),
        (of_two("atan2"), [-1.0, -1.0], [1.0, 1.0], "jump"),
    ],
)
def test_what_has_a_pole_or_jumps_within_the_box_is_refused(made, lower, upper, message):
    with pytest.raises(Unproved, match=message):
        bounds(made, lower, upper)
