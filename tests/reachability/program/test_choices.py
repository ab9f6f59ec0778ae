"""Comparisons, masks and choices: programs that do what torch does, exact where decided, else the hull of branches."""

import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.sets import Box

from ..affine.test_operations import Formed, drawn

ZERO = torch.zeros(1, dtype=torch.float64)
F = torch.nn.functional


def assigned(x):
    y = x.clone()
    y[y > 0.5] = 0.5
    return y


def masked_in_place(x):
    mask = x > 0
    mask &= x < 0.5
    y = torch.zeros_like(x)
    y[mask] = 1.0
    return y


STEPS = {
    "where": lambda x: torch.where(x > 0, x, 0.1 * x),
    "at least": lambda x: torch.where(x >= 0.25, x + 1, x - 1),
    "at most a value": lambda x: torch.where(x <= x.flip(-1), x, 2 * x),
    "equal": lambda x: torch.where(x == 0.5, torch.ones_like(x), x),
    "not equal": lambda x: torch.where(x != 0.5, x, 3.0),
    "number first": lambda x: torch.where(torch.lt(torch.tensor(0.5).double(), x), 1.0, x),
    "method": lambda x: torch.sin(x).where(x.gt(0), x),
    "constant mask": lambda x: torch.where(torch.tensor([True, False, True]), x, 0.5 * x),
    "one condition for all": lambda x: torch.where(x[..., :1] > 0, x, -x),
    "and": lambda x: torch.where((x > -0.5) & (x <= 0.5), x, 0 * x),
    "or": lambda x: torch.where((x < -0.5) | (x >= 0.5), x, 0 * x),
    "not": lambda x: torch.where(~(x > 0.1), x, 0 * x),
    "exclusive or": lambda x: torch.where((x > 0.1) ^ (x < 0.5), x, 0 * x),
    "mask as numbers": lambda x: (x > 0).double() * x,
    "mask as float32": lambda x: (x > 0).float() * x,
    "product with a mask": lambda x: (x > 0) * x,
    "moved masks": lambda x: torch.where(torch.stack([x > 0, x < 0.5]).flip(0)[0], x, -x),
    "masked fill": lambda x: x.masked_fill(x > 0.5, 0.5),
    "assignment by a mask": assigned,
    "a mask written in place": masked_in_place,
    "heaviside": lambda x: torch.heaviside(x, torch.tensor(0.5, dtype=torch.float64)),
    "threshold": lambda x: F.threshold(x, 0.1, 2.0),
    "hardshrink": lambda x: F.hardshrink(x, 0.3),
    "nested": lambda x: torch.where(x > 0, torch.where(x > 0.5, x * x, x), torch.zeros_like(x)),
    "a branch that is not defined everywhere": lambda x: torch.where(x > 0.25, torch.sqrt(x - 0.25), x),
    "a quotient beside its pole": lambda x: torch.where(x.abs() > 0.25, 1 / x, 0 * x),
    "a quotient of all": lambda x: torch.where(x > 0.25, 1 / (x.sum(-1, keepdim=True) + 9), 0 * x),
    "a quotient of a neighbour": lambda x: torch.where(x > 0.25, 1 / (x.flip(-1) + 9), 0 * x),
    "a root of a running sum": lambda x: torch.where(x < 0.25, torch.sqrt(x.cumsum(-1) + 90), 0 * x),
    "a quotient for several conditions": lambda x: torch.where((x > 0.25)[:, None], 1 / (x + 9), 0 * x).sum(0),
    "a mask as float32 numbers": lambda x: (x > 0).float() * 0.1 + x,
    "a mask as float32 by its type": lambda x: (x > 0).to(torch.float32) * 0.1 + x,
    "a logarithm of the other side": lambda x: torch.where(0.1 - x > 0, torch.log(1.1 - x), x),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_program_chooses_as_torch_does(name):
    x = torch.randn(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x[:20], x[20:40] = x[:20].round(), 0.5 * x[20:40].round()
    call = STEPS[name]
    for example in (x[0], x[1], x[25]):  # whatever side it is on
        program = record(lambda x, w: (torch.zeros_like(x), call(x)), example, ZERO)
        rows = torch.stack([call(row) for row in x])
        torch.testing.assert_close(program.run(x, ZERO).control, rows, rtol=1e-13, atol=1e-13)


def written_into_a_mask(x, value):
    mask = x > 0
    mask[0] = value
    return mask.double() * x


NO_LOGIC = {
    "sum of masks": lambda x: (x > 0) + (x > 0.1) + x,
    "sum in place": lambda x: (x > 0).add_(x > 0.1) + x,
    "a number written into a mask": lambda x: written_into_a_mask(x, 0.3),
    "a value written into a mask": lambda x: written_into_a_mask(x, x[0]),
    "a value copied into a mask": lambda x: (x > 0).copy_(x).double() + x,
    "a mask filled with a number": lambda x: (x > 0).masked_fill(x > 5, 0.3).double() * x,
    "logic of values": lambda x: torch.logical_and(x, x > 0).double() + x,
    "not of values": lambda x: torch.logical_not(x).double() + x,
}


@pytest.mark.parametrize("name", NO_LOGIC)
def test_what_torch_converts_to_truth_values_is_refused_whatever_the_example(name):
    """At these states the numbers 1 and 0 give what truth values give, at others they do not."""
    for example in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.05, -1.0, -1.0], [0.0, -1.0, -1.0]):
        with pytest.raises(UnsupportedOperationError):
            record(lambda x, w: (torch.zeros_like(x), NO_LOGIC[name](x)), torch.tensor(example).double(), ZERO)


BOUNDED = {
    "undecided": (STEPS["at least"], (-1.0, 1.0), (-2.0, 2.0)),
    "decided": (STEPS["at least"], (0.375, 1.0), (1.375, 2.0)),
    "decided below": (STEPS["at least"], (-1.0, 0.0), (-2.0, -1.0)),
    "root on its side": (STEPS["a branch that is not defined everywhere"], (-1.0, 1.25), (-1.0, 1.25)),
    "root where it is undefined": (STEPS["a branch that is not defined everywhere"], (-1.0, 0.0), (-1.0, 0.0)),
    "a sign": (lambda x: torch.where(x > 0, torch.ones_like(x), -torch.ones_like(x)), (-0.5, 1.0), (-1.0, 1.0)),
    "a mask": (STEPS["mask as numbers"], (0.5, 1.0), (0.5, 1.0)),
}


@pytest.mark.parametrize("propagator", ["interval", "affine", "crown", "best"])
@pytest.mark.parametrize("name", BOUNDED)
def test_a_choice_is_exact_where_it_is_decided_and_else_the_hull(name, propagator):
    call, (low, high), expected = BOUNDED[name]
    start = Box(torch.tensor([low] * 3).double(), torch.tensor([high] * 3).double())
    tube = reach(lambda x, w: call(x), start, horizon=1, propagator=propagator)
    for side, value in zip((tube.lower[1], tube.upper[1]), expected, strict=True):
        torch.testing.assert_close(side, torch.full((3,), value, dtype=torch.float64), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("by_hand", "function"),
    [
        (lambda x: torch.where(x > 0, x, 0.1 * x), lambda x: F.leaky_relu(x, 0.1)),
        (lambda x: torch.where(x < 0.5, x, 0.5 + 0 * x), lambda x: x.clamp(max=0.5)),
        (lambda x: torch.where(x > x.flip(-1), x, x.flip(-1)), lambda x: torch.maximum(x, x.flip(-1))),
    ],
    ids=["leaky relu", "clamp", "maximum"],
)
@pytest.mark.parametrize("tensors", [False, True])
def test_branches_that_meet_cost_what_the_function_costs_that_they_are(by_hand, function, tensors):
    found, known = (Formed(lambda x, w, f=f: f(x), *drawn(), tensors=tensors) for f in (by_hand, function))
    for part in ("low", "high"):
        torch.testing.assert_close(getattr(found, part), getattr(known, part), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: x if x[0] > 0 else -x, "a step may not branch on a value"),
        (lambda x: x if (x > 0).any() else -x, "'any' chooses by a value"),
        (lambda x: x[x > 0], "an index|look entries up|mask|not supported"),
        (lambda x: (x > 0).long() * x, "conversion to torch.int64|gives torch.int64"),
        (lambda x: x * (x > 0).sum(), "gives torch.int64"),
    ],
)
def test_what_needs_the_truth_itself_is_refused(call, message):
    with pytest.raises(UnsupportedOperationError, match=message):
        record(lambda x, w: call(x), torch.tensor([0.3, -0.2]).double(), ZERO)
