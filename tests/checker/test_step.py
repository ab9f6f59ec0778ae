"""One step of a program in balls: every kind of instruction encloses what it does to points, whatever is recorded."""

import numpy as np
import pytest
from flint import ctx

from sagemp_cli.checker.balls import balls
from sagemp_cli.checker.loop import Folded, Loop
from sagemp_cli.checker.points import outputs_at
from sagemp_cli.checker.step import Entry, Step
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.checker.zonotope import Zonotope

from .by_hand import OF_ONE, line, program, run

LOWER, UPPER = np.array([1.0, -0.5]), np.array([1.5, 0.5])


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(128):
        yield


def bounds(made, record=(), numbers=(), *, by_rows=False):
    """Bounds of the next state over the box, w in +-1/4; by rows and intervals, or by rows alone."""
    loop = Loop(Folded.of(made), np.array([numbers], float).reshape(1, -1), np.array([[-0.25]]), np.array([[0.25]]))
    box = list(zip(balls(LOWER), balls(UPPER), strict=True))
    step = Step(loop, 0, Zonotope.box(LOWER, UPPER), box, list(record))
    after, *_ = step.run()
    image = step.image(after).bounds()
    np.testing.assert_allclose(
        [float(a) for a, _ in image], [float(a) for a, _ in step.bounds(after)], rtol=1e-9, atol=1e-12
    )
    return np.array([[float(a), float(b)] for a, b in (image if by_rows else step.output(made.next, image))])


def record_of(made, entry, direction=(0.8, 0.6)):
    """The same entry for every relaxation."""
    names = [name for slot in made.relaxed for name, count in slot for _ in range(count)]
    beside = {"direction": Entry(*direction, 0.0), "ratio": Entry(0.3, 0.0, 0.0)}
    return [beside.get(name, entry) for name in names]


def points(count=41):
    a, b, w = np.meshgrid(
        *(np.linspace(low, high, count) for low, high in zip(LOWER, UPPER, strict=True)), [-0.25, 0.25]
    )
    return np.stack([a.ravel(), b.ravel()], 1), w.reshape(-1, 1)


X, W, P = 0, 1, 2
LINEAR = {
    "sums": [line("add", X, W)],
    "one entry for all": [line("pick", X, entries=[1]), line("sub", 2, X)],
    "the state itself": [line("neg", X)],
    "picks and joins": [line("pick", X, entries=[1, 0, 1]), line("pick", 2, entries=[0]), line("join", 3, W)],
    "products with numbers": [line("constant", constants=[3, -1]), line("mul", 2, X)],
    "quotients by numbers": [line("constant", constants=[4]), line("div", X, 2)],
    "a matrix": [line("linear", X, constants=[1, 2, 0.5, -3, 1, 1])],
    "a matrix of what is linear": [line("add", X, W), line("linear", 2, constants=[1, 2, 0.5, -3, 1, 1])],
    "functions of numbers": [line("constant", constants=[3]), line("sin", 2), line("mul", 3, X)],
    "numbers alone": [line("constant", constants=[3, 4])],
}  # fmt: skip


@pytest.mark.parametrize("name", LINEAR)
def test_what_is_linear_is_exact_and_takes_no_relaxation(name):
    made = program(*LINEAR[name], next=1 + len(LINEAR[name]))
    assert made.relaxations == 0
    values, found = run(made, *points(2)), bounds(made)
    np.testing.assert_allclose(found[:, 0], values.min(0), atol=1e-12)
    np.testing.assert_allclose(found[:, 1], values.max(0), atol=1e-12)


def test_numbers_of_the_step_are_exact():
    made = program(
        line("pick", P, entries=[2, 3]), line("sub", 3, X), line("linear", 4, constants=[1, 2, 3, 4, 5, 6]), g=4, next=5
    )
    found = bounds(made, numbers=[9.0, 9.0, 0.5, 0.25])
    values = run(made, *points(2), np.tile([9.0, 9.0, 0.5, 0.25], (8, 1)))
    np.testing.assert_allclose(found, np.stack([values.min(0), values.max(0)], 1), atol=1e-12)


def first(kind, **constants):
    """A function of x + 1.5 in (1, 2] and more, and of x itself."""
    return [line("constant", constants=[1.6, 1.6]), line("add", 2, X), line(kind, 3, **constants)]


PAIRS = [line("pick", X, entries=[0]), line("pick", X, entries=[1])]
NONLINEAR = {
    **{kind: first(kind) for kind in OF_ONE if kind not in ("tan", "neg")},
    "tan": [line("tan", X)],
    "abs of both signs": [line("abs", X)],
    "relu of both signs": [line("relu", X)],
    "leaky_relu": [line("leaky_relu", X, constants=[0.2])],
    "elu": [line("elu", X, constants=[1.0])],
    "softplus": [line("softplus", X, constants=[2.0, 20.0])],
    "pow": [line("pow", X, constants=[3])],
    "pow below 0": first("pow", constants=[-2]),
    "clamp": [line("clamp", X, constants=[0.0, -np.inf, 1.25, 0.1])],
    "clamp the wrong way round": [line("clamp", X, constants=[0.5, 9.0, 0.25, 0.1])],
    "mul": [*PAIRS, line("mul", 2, 3), line("join", 4, W)],
    "mul of itself": [line("mul", X, X)],
    "mul by one entry": [*PAIRS, line("mul", 2, X)],
    "div": [*PAIRS, line("div", X, 2)],
    "div of a number": [*PAIRS, line("constant", constants=[2]), line("div", 4, 2), line("join", 5, W)],
    "maximum": [line("neg", X), line("maximum", 2, X)],
    "minimum": [*PAIRS, line("minimum", X, 3)],
    "maximum with numbers": [line("constant", constants=[0.1]), line("maximum", X, 2)],
    "maximum with numbers below 0": [line("constant", constants=[-0.3]), line("maximum", X, 2)],
    "minimum with numbers below 0": [line("constant", constants=[-0.3]), line("minimum", X, 2)],
    "numbers' minimum": [line("constant", constants=[1.2, 0.1]), line("minimum", 2, X)],
    "atan2": [*PAIRS, line("atan2", 3, 2), line("join", 4, 4)],
    "atan2 of w": [line("add", X, W), line("atan2", X, 2), line("pick", 3, entries=[0, 0])],
    "atan2 behind": [*PAIRS, line("neg", 2), line("atan2", 2, 4), line("join", 5, W)],
    "logaddexp": [*PAIRS, line("logaddexp", 2, 3), line("join", 4, W)],
    "logaddexp of one entry": [*PAIRS, line("logaddexp", X, 3)],
    "logaddexp of a number": [line("constant", constants=[0.1]), line("logaddexp", 2, X)],
    "where": [*PAIRS, line("where", 3, 2, 3), line("join", 4, W)],
    "where of branches that meet": [
        *PAIRS, line("constant", constants=[0.0]), line("where", 3, 3, 4), line("join", 5, W),
    ],
    "where of a number for all": [line("pick", X, entries=[1]), line("neg", X), line("where", 2, X, 3)],
    "where undecided of numbers": [
        line("constant", constants=[1.0, 2.0]), line("constant", constants=[-1.0]), line("add", X, W),
        line("pick", 4, entries=[1]), line("where", 5, 2, 3),
    ],
    "atan2 beside a number": [*PAIRS, line("constant", constants=[2.0]), line("atan2", 3, 4), line("join", 5, 5)],
}  # fmt: skip


@pytest.mark.parametrize("name", NONLINEAR)
@pytest.mark.parametrize(("slope", "offset"), [(0.3, 0.1), (1.7, 9.0), (1.7, -9.0), (-0.8, 9.0), (-0.8, -9.0)])
def test_whatever_is_recorded_every_value_is_enclosed(name, slope, offset):
    made = program(*NONLINEAR[name], next=1 + len(NONLINEAR[name]))
    assert made.relaxations > 0
    found = bounds(made, record_of(made, Entry(abs(slope) if "product" in str(made.relaxed) else slope, offset, 1e3)))
    values = run(made, *points())
    assert (found[:, 0] - 1e-12 <= values.min(0)).all() and (values.max(0) <= found[:, 1] + 1e-12).all()
    assert np.isfinite(found).all()


@pytest.mark.parametrize("name", NONLINEAR)
def test_a_recorded_radius_that_is_too_small_is_found_out(name):
    made = program(*NONLINEAR[name], next=1 + len(NONLINEAR[name]))
    with pytest.raises(Unproved, match="a recorded relaxation of '.*' is wrong"):
        bounds(made, record_of(made, Entry(0.3, 0.1, 1e-6)))


@pytest.mark.parametrize("kind", ["maximum", "minimum"])
@pytest.mark.parametrize("number", [-0.3, 0.0, 0.3])
def test_a_limit_takes_the_room_that_its_kink_needs_and_no_more(kind, number):
    made = program(line("pick", X, entries=[1]), line("constant", constants=[number]), line(kind, 2, 3),
                   line("join", 4, 4), next=5)  # fmt: skip
    x = np.linspace(-0.5, 0.5, 101)
    excess = getattr(np, kind)(x, number) - 0.3 * x
    middle, radius = 0.5 * (excess.max() + excess.min()), 0.5 * np.ptp(excess)
    found = bounds(made, [Entry(0.3, middle, 1e3)], by_rows=True)
    np.testing.assert_allclose(found, [[middle - 0.15 - radius, middle + 0.15 + radius]] * 2, atol=1e-9)


def test_a_wrong_scale_of_a_product_is_refused():
    made = program(*NONLINEAR["mul"], next=5)
    for scale in (0.0, -1.0):
        with pytest.raises(Unproved, match="the scale of a product must be positive"):
            bounds(made, [Entry(scale, 0.0, 1e3)])


@pytest.mark.parametrize("name", [*LINEAR, *NONLINEAR])
def test_at_a_point_a_program_does_what_torch_does(name):
    lines = (LINEAR | NONLINEAR)[name]
    made = program(*lines, next=1 + len(lines))
    x, w = points(3)
    for i in range(len(x)):
        found = outputs_at(made, {"state": balls(x[i]), "disturbance": balls(w[i]), "numbers": []})["next"]
        np.testing.assert_allclose([float(v) for v in found], run(made, x[i : i + 1], w[i : i + 1])[0], atol=1e-12)


@pytest.mark.parametrize("direction", [(0.8, 0.6), (-1.0, 0.0), (-1.0, 1e-3), (-1.0, -1e-3)])
def test_an_angle_whose_point_meets_the_jump_is_only_known_to_be_an_angle(direction):
    made = program(line("pick", X, entries=[1]), line("constant", constants=[-1.0]), line("atan2", 2, 3),
                   line("join", 4, 4), next=5)  # fmt: skip
    with pytest.raises(Unproved, match="a recorded relaxation of 'atan2' is wrong"):
        bounds(made, record_of(made, Entry(0.0, 0.0, 3.14), direction))
    for side in (-3.0, 3.0):  # not even if the direction is on one side of the jump
        with pytest.raises(Unproved, match="a recorded relaxation of 'atan2' is wrong"):
            bounds(made, record_of(made, Entry(0.0, side, 6.0), direction))
    found = bounds(made, record_of(made, Entry(0.0, 0.0, 3.15), direction))
    np.testing.assert_allclose(found, [[-np.pi, np.pi]] * 2)


def test_an_angle_is_close_to_a_line_across_its_direction():
    """y in +-0.5, x in [1, 1.5]: far better than any bound that gives up the correlation or the slope."""
    made = program(*NONLINEAR["atan2"], next=5)
    found = bounds(made, record_of(made, Entry(0.8, 0.0, 0.09), (1.0, 0.0)))
    assert found[0, 1] < 0.5 < float(np.arctan2(0.5, 1.0)) + 0.1
    with pytest.raises(Unproved):
        bounds(made, record_of(made, Entry(0.8, 0.0, 0.05), (1.0, 0.0)))
    np.testing.assert_allclose(
        bounds(made, record_of(made, Entry(0.16, 0.0, 0.09), (5.0, 0.0))), found
    )  # of any length


def test_the_numbers_of_other_directions_do_not_decide():
    made = program(*NONLINEAR["atan2"], next=5)
    for cosine, sine in [(0.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (-0.6, -0.8)]:
        found = bounds(made, record_of(made, Entry(0.2, 0.0, 9.0), (cosine, sine)))
        values = run(made, *points())
        assert (found[:, 0] <= values.min(0)).all() and (values.max(0) <= found[:, 1]).all()
    with pytest.raises(Unproved, match="must be finite"):
        bounds(made, record_of(made, Entry(0.2, 0.0, 9.0), (np.nan, 0.0)))
