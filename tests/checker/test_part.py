"""What is proved of a part of a period is what the formulas ask for, no less: against closed forms of a linear ODE.

``x' = a x + b u + w`` in one dimension has ``Df = a``, ``c_2 = a (a x + b u + w) / 2`` and so on; every bound that the
checker asks for is a formula of a few numbers then.
"""

import dataclasses

import numpy as np
import pytest

from sagemp_cli.checker.balls import BITS, balls, ctx
from sagemp_cli.checker.ode import flow_of
from sagemp_cli.checker.part import FlowClaim, PartProver
from sagemp_cli.checker.unproved import Unproved

from .by_hand import line, program

A, B, PERIOD = -0.8, 0.5, 0.25
X0, U, W = np.array([0.9, 1.1]), np.array([-0.2, 0.3]), np.array([-0.1, 0.3])
CONTROL = program(line("neg", 0), line("linear", 2, constants=[1, 0]), n=1, d=1, next=2, control=3)
RATE = program(
    line("constant", constants=[A]), line("mul", 0, 3), line("constant", constants=[B]), line("mul", 2, 5),
    line("add", 4, 6), n=1, d=1, g=1, next=7,
)  # fmt: skip
NO_LAG = {"jump": np.zeros((1, 1, 1)), "measured_lower": np.zeros((1, 1)), "measured_upper": np.zeros((1, 1))}


def image(state):
    """Bounds of ``a x + b u + w``."""
    corners = np.add.outer(np.add.outer(A * state, B * U), W)
    return np.array([corners.min(), corners.max()])


def exact(order, substeps=2):
    """The smallest claim that follows, with X a little wider than need be."""
    h = PERIOD / substeps
    stay = np.array([0.5, 1.3])
    rate = image(stay)
    inside = np.array([X0[0] + h * min(rate[0], 0), X0[1] + h * max(rate[1], 0)])
    slope = image(inside)  # bounds of c_1 on Y
    second = np.sort(A * slope / 2)
    factor = A**order / np.prod(np.arange(2, order + 2))
    last = np.sort(factor * slope)
    radius, size = (W[1] - W[0]) / 2, abs(A)
    drift = size * 0.75 * h**2 * radius / (1 - size * h)
    end = h * size * drift  # Df is one number: its bounds have no width
    power = h ** (order + 1)
    return h, inside, np.array([power * last[0] - end, power * last[1] + end]), h * h * abs(second).max(), drift


def prove(order=2, substeps=2, **claims):
    flow = flow_of(CONTROL, RATE, period=PERIOD, substeps=substeps, order=order)
    _, _, rest, curve, drift = exact(order, substeps)
    more = 1 + 1e-9
    wide = np.array([rest[0] - 1e-10, rest[1] + 1e-10])
    given = {"lower": 0.5, "upper": 1.3, "remainder_lower": wide[0], "remainder_upper": wide[1],
             "curve": curve * more, "drift": drift * more} | claims  # fmt: skip
    sides = {name: np.full((1, 1, 1), value) for name, value in given.items()}
    claim = FlowClaim(np.zeros((1, 0, 1)), np.zeros((1, 0, 1)), **sides, **NO_LAG)
    with ctx.workprec(BITS):
        begin, control = (list(zip(balls(v[:1]), balls(v[1:]), strict=True)) for v in (X0, U))
        PartProver(flow, W[:1], W[1:]).prove(claim, (0, 0), begin, control)


@pytest.mark.parametrize("substeps", [1, 2, 4])
@pytest.mark.parametrize("order", [1, 2, 3, 6])
def test_what_the_formulas_ask_for_is_proved(order, substeps):
    prove(order, substeps)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("remainder_lower", "the remainder of state 0"),
        ("remainder_upper", "the remainder of state 0"),
        ("curve", "the path of state 0 may bend"),
        ("drift", "state 0 may drift"),
    ],
)
def test_a_little_less_is_not(field, message, order):
    _, _, rest, curve, drift = exact(order)
    width = rest[1] - rest[0]
    less = {
        "remainder_lower": rest[0] + 1e-6 * width, "remainder_upper": rest[1] - 1e-6 * width,
        "curve": curve * (1 - 1e-6), "drift": drift * (1 - 1e-6),
    }  # fmt: skip
    with pytest.raises(Unproved, match=message):
        prove(order, **{field: less[field]})


def test_a_box_that_the_flow_leaves_is_not():
    _, inside, _, _, _ = exact(2)
    prove(lower=inside[0] - 1e-9, upper=1.3)
    for sides in ({"lower": X0[0] - 1e-3}, {"upper": 1.0}, {"lower": 1.4}, {"lower": np.nan}, {"upper": np.inf}):
        with pytest.raises(Unproved):
            prove(**sides)


@pytest.mark.parametrize("field", ["remainder_lower", "remainder_upper", "curve", "drift"])
def test_what_is_no_number_is_not(field):
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(Unproved, match="finite"):
            prove(**{field: value})


def test_the_width_of_the_slopes_counts_at_the_end_of_a_part():
    """``x' = x^2``: Df = 2 x has width on Y, which adds ``D 3/4 h^2 r_W`` to what the remainder has to hold."""
    rate = program(line("mul", 0, 0), n=1, d=1, next=2)
    control = program(line("neg", 0), n=1, d=1, next=2)
    h, w, x = 0.25, np.array([-0.2, 0.2]), np.array([0.5, 0.6])
    flow = flow_of(control, rate, period=h, substeps=1, order=1)
    stay = np.array([0.4, 0.9])
    inside = np.array([x[0] + h * min(stay[0] ** 2 + w[0], 0), x[1] + h * (stay[1] ** 2 + w[1])])
    slopes, swung = 2 * inside, 0.75 * h**2 * 0.2
    drift = slopes[1] * swung / (1 - h * slopes[1])
    end = (slopes[1] - slopes[0]) * swung + h * slopes[1] * drift
    # c_2 = x (x^2 + w), as 2 (x c_1) / 2 in intervals
    ends = inside**2 + w
    second = np.array([min(inside * ends[0]), max(inside * ends[1])])
    need = np.array([h * h * second[0] - end, h * h * second[1] + end])
    claim = FlowClaim(
        np.zeros((1, 0, 1)), np.zeros((1, 0, 1)),
        *(np.full((1, 1, 1), v) for v in (
            0.4, 0.9, need[0] - 1e-10, need[1] + 1e-10, h * h * abs(second).max() * (1 + 1e-9), drift * (1 + 1e-9),
        )), **NO_LAG,
    )  # fmt: skip
    with ctx.workprec(BITS):
        prover, begin = PartProver(flow, w[:1], w[1:]), list(zip(balls(x[:1]), balls(x[1:]), strict=True))
        prover.prove(claim, (0, 0), begin, [])
        for change in ({"remainder_upper": need[1] - 1e-6}, {"remainder_lower": need[0] + 1e-6}):
            less = dataclasses.replace(claim, **{name: np.full((1, 1, 1), v) for name, v in change.items()})
            with pytest.raises(Unproved, match="the remainder"):
                prover.prove(less, (0, 0), begin, [])


def test_a_drift_below_zero_proves_nothing():
    """Where f is steep, ``e >= A (3/4 h^2 r_W + h e)`` holds of numbers below 0, which bound nothing."""
    steep = program(line("constant", constants=[20.0]), line("mul", 0, 3), line("sin", 4), n=1, d=1, g=1, next=5)
    flow = flow_of(CONTROL, steep, period=PERIOD, substeps=1, order=1)
    with ctx.workprec(BITS):
        begin, control = (list(zip(balls(v[:1]), balls(v[1:]), strict=True)) for v in (X0, U))
        prover = PartProver(flow, W[:1], W[1:])
        for drift in (-1.0, -1e-300, np.nan):
            given = {"lower": -9.0, "upper": 9.0, "remainder_lower": 0.0, "remainder_upper": 0.0, "curve": 99.0}
            sides = {name: np.full((1, 1, 1), value) for name, value in (given | {"drift": drift}).items()}
            with pytest.raises(Unproved, match="drift|must be finite"):
                claim = FlowClaim(np.zeros((1, 0, 1)), np.zeros((1, 0, 1)), **sides, **NO_LAG)
                prover.prove(claim, (0, 0), begin, control)
