"""Loops in continuous time: proved at all times, refuted by enclosures, or unknown, and never in between."""

import dataclasses
import math

import pytest
import torch

from sagemp_cli.errors import UnsupportedOperationError, UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.observed import observed_ode
from sagemp_cli.scenes.requirements import Holds, Inside, Outside
from sagemp_cli.sets import Box, Tube
from sagemp_cli.verification.continuous.attack import PIECES
from sagemp_cli.verification.continuous.attack import _all_break as breaks
from sagemp_cli.verification.continuous.attack import _signals as attack_signals
from sagemp_cli.verification.continuous.judging import Asked, judged
from sagemp_cli.verification.continuous.proof import verify_ode
from sagemp_cli.verification.verdict import Answer

NAMES = ("angle", "rate")


def control(x):
    return (-2 * x[..., :1] - x[..., 1:]).clamp(-1.0, 1.0)


def rate(x, u):
    return torch.cat([x[..., 1:], torch.sin(x[..., :1]) - 0.2 * x[..., 1:] + 3 * u], -1)


def box(lower, upper):
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


START = box([0.2, -0.1], [0.3, 0.1])


def seen(f=rate, c=control, start=START, w=None, period=0.1, horizon=12):
    return observed_ode(f, c, start, w, period=period, horizon=horizon)


def verdict(*requirements, observed=None, counts=None, **options):
    return verify_ode(
        observed or seen(),
        Affine(),
        [r.formula(NAMES) for r in requirements],
        counts=counts,
        generator=torch.Generator().manual_seed(0),
        **options,
    )


def test_what_holds_is_proved_and_says_its_margin():
    proof = verdict(
        Inside({"angle": (-0.5, 0.5)}), Inside({"angle": (-0.2, 0.2)}, when=(0.8, 1.2)), Outside({"angle": (1, 2)})
    )
    assert proof.answer is Answer.VERIFIED
    assert all(v.margin > 0 and v.answer is Answer.VERIFIED for v in proof.verdicts)
    assert proof.cells == 1 and proof.violation is None


def test_what_is_false_is_refuted_by_an_enclosure_of_the_solution():
    proof = verdict(Inside({"angle": (-1.0, 0.25)}), Inside({"rate": (-5.0, 5.0)}))
    assert proof.answer is Answer.FALSIFIED
    broken = proof.violation
    assert broken.proved and broken.requirement == "inside" and broken.depth > 0
    assert [(v.name, v.answer) for v in proof.verdicts] == [
        ("inside", Answer.FALSIFIED),
        ("inside 2", Answer.UNKNOWN),  # which was not tried
    ]
    assert bool(((START.lower <= broken.start) & (broken.start <= START.upper)).all())


def test_a_violation_between_two_samples_alone_is_not_called_proved():
    """A body that swings out and back within one period: at the samples it is at 0."""
    swing = lambda x, u: torch.cat([x[..., 1:], -(math.pi**2) * x[..., :1] + 0 * u], -1)  # noqa: E731
    start = box([0.0, 1.0], [0.0, 1.0])
    observed = seen(swing, lambda x: 0 * x[..., :1], start, period=1.0, horizon=2)
    peak = 1 / math.pi
    inside = Inside({"angle": (-peak * 0.98, peak * 0.98)})
    assert verdict(inside, observed=observed, restarts=0, substeps=4, order=3).answer is Answer.UNKNOWN
    assert verdict(inside, observed=observed).answer is Answer.FALSIFIED
    wide = Inside({"angle": (-peak * 1.2, peak * 1.2)})
    assert verdict(wide, observed=observed, substeps=4, order=3).answer is Answer.VERIFIED


def test_a_swing_that_only_a_disturbance_in_its_own_rhythm_breaks_is_found():
    """A turn of the body takes one period: a disturbance that is constant on it swings it to 2, its rhythm to 12."""
    omega = 2 * math.pi
    swing = lambda x, u: torch.cat([x[..., 1:], -(omega**2) * x[..., :1] + 0 * u], -1)  # noqa: E731
    still, push = box([0.0, 0.0], [0.0, 0.0]), box([0.0, -(omega**2)], [0.0, omega**2])
    observed = seen(swing, lambda x: 0 * x[..., :1], still, push, period=1.0, horizon=3)
    proof = verdict(Inside({"angle": (-9.0, 9.0)}), observed=observed, substeps=8, order=3)
    assert proof.answer is Answer.FALSIFIED and proof.violation.proved
    signal = proof.violation.signal
    assert bool(push.contains(signal).all()) and len(signal) == 3 * PIECES
    assert bool((signal[:, 1].unflatten(0, (3, PIECES)).diff(dim=1) != 0).any())  # within a period
    enough = Inside({"angle": (-13.0, 13.0)})
    assert verdict(enough, observed=observed, substeps=8, order=3).answer is not Answer.FALSIFIED


def test_signals_of_the_search_are_of_w_and_reach_its_corners():
    loop, w = seen(horizon=3).loop, box([-1.0, 2.0], [1.0, 2.0])
    signals = attack_signals(w, loop.horizon * PIECES, torch.Generator().manual_seed(0))
    assert signals.shape[1:] == (3 * PIECES, 2)
    assert bool(w.contains(signals).all()) and bool((signals[1:, :, 0].abs() == 1).all())
    switches = (signals[..., 0].diff(dim=1) != 0).sum(1)
    assert int(switches.max()) == 3 * PIECES - 1 and int(switches[4:8].min()) == 0


def test_what_is_no_number_breaks_nothing():
    """A margin that is not defined on all of an enclosure has no bounds there."""
    observed = seen()
    asked = [
        Asked.of(Holds(lambda x: torch.log(x[..., :1]) - 9).formula(NAMES), observed.loop, START.center),
        Asked.of(Inside({"angle": (5.0, 6.0)}).formula(NAMES), observed.loop, START.center),
    ]
    assert not bool(breaks(asked[0], box([[-1.0, 0.0]], [[1.0, 0.0]])).any())
    for low, high in ((-math.inf, 1.0), (0.5, math.inf), (-math.inf, -math.inf)):
        assert not any(bool(breaks(one, box([[low, 0.0]], [[high, 0.0]])).any()) for one in asked)
    assert all(bool(breaks(one, box([[0.5, 0.0]], [[0.6, 0.0]])).all()) for one in asked)


def test_more_cells_are_taken_where_one_does_not_do():
    wide = seen(start=box([-0.6, -0.6], [0.6, 0.6]))
    parts = {"substeps": 1, "order": 2}  # finer ones would do as well
    anything = Inside({"angle": (-99.0, 99.0)})
    one, many = (
        float(verdict(anything, observed=wide, counts=c, restarts=0, **parts).tube.upper[-1, 0])
        for c in ([1, 1], [4, 4])
    )
    tight = Inside({"angle": (-0.5 * (one + many), 0.5 * (one + many))}, when="end")
    assert verdict(tight, observed=wide, counts=[1, 1], restarts=0, **parts).answer is Answer.UNKNOWN
    proof = verdict(tight, observed=wide, **parts)
    assert proof.answer is Answer.VERIFIED and proof.cells > 1
    lower = torch.cat([p.cells.lower for p in proof.pieces]).amin(0)
    upper = torch.cat([p.cells.upper for p in proof.pieces]).amax(0)
    volume = torch.cat([p.cells.width.prod(-1) for p in proof.pieces]).sum()
    assert torch.equal(lower, wide.start.lower) and torch.equal(upper, wide.start.upper)
    assert float(volume) == pytest.approx(float(wide.start.width.prod()))


def explosive_rate(x, u):
    return torch.stack([x[..., 1], x[..., 0] ** 2 + 2 * torch.sin(3 * x[..., 0]) + u[..., 0], 0.1 * x[..., 2]], -1)


def explosive_control(x):
    return torch.stack([-6 * torch.tanh(x[..., 0]) - 4 * torch.tanh(x[..., 1])], -1)


def test_cells_of_a_tube_that_explodes_are_halved_in_states_that_it_comes_from():
    start = box([-0.7, -0.7, 1.0], [0.7, 0.7, 2.0])
    wide = seen(explosive_rate, explosive_control, start, period=0.2, horizon=8)
    whole, few, enough = (verdict(observed=wide, restarts=0, budget=cells, substeps=1, order=2) for cells in (1, 2, 16))
    assert not whole.bounded and not few.bounded and few.cells <= 2
    assert enough.answer is Answer.VERIFIED and enough.bounded and 2 < enough.cells <= 16
    widths = torch.cat([p.cells.width for p in enough.pieces])
    assert bool((widths[:, 2] == 1.0).all())  # nothing hangs on the third state


def test_nothing_that_is_not_a_number_proves_anything():
    observed = seen()
    asked = [Asked.of(Inside({"angle": (-5.0, 5.0)}).formula(NAMES), observed.loop, START.center)]
    reach = verdict(Inside({"angle": (-5.0, 5.0)})).pieces[0].reach
    w = observed.disturbance
    assert bool(judged(reach, asked, observed.loop, w).holds.all())
    for name in ("lower", "upper", "state_lower", "state_upper"):
        side = getattr(reach.flow, name).clone()
        side[0, 3, 0, 0] = math.nan
        spoilt = dataclasses.replace(reach, flow=dataclasses.replace(reach.flow, **{name: side}))
        assert not bool(judged(spoilt, asked, observed.loop, w).holds.any()), name
    for name in ("lower", "upper"):
        sides = {n: getattr(reach.tube, n).clone() for n in ("lower", "upper")}
        sides[name][0, -1, 0] = math.nan
        spoilt = dataclasses.replace(reach, tube=Tube(**sides))
        assert not bool(judged(spoilt, asked, observed.loop, w).holds.any()), name


def test_what_escapes_is_unknown_with_a_note():
    observed = seen(lambda x, u: 4 * x * x + 0 * u, lambda x: 0 * x[..., :1], box([1.0, 1.0], [1.1, 1.1]))
    proof = verdict(Inside({"angle": (-9.0, 1e9)}), observed=observed, restarts=0, substeps=4, order=2, counts=[1, 1])
    assert proof.answer is Answer.UNKNOWN and not proof.bounded
    assert any("no box was found" in note for note in proof.notes)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"period": 0}, "period must be a positive number of seconds, found 0"),
        ({"period": math.nan}, "period must be a positive number of seconds"),
        ({"horizon": 0}, "horizon must be a positive integer, found 0"),
        ({"w": box([0.0], [1.0])}, "the disturbance must have 2 dimensions, found 1"),
        ({"c": lambda x: torch.full((1,), math.nan)}, "control must give finite numbers"),
        ({"f": lambda x, u: x[..., :1]}, "shape"),
        ({"c": lambda x: torch.rand(1).double() + 0 * x[..., :1]}, "another result|random"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(change, says):
    with pytest.raises(UsageError, match=says) as error:
        seen(**change)
    assert "\n" not in str(error.value)


def test_a_controller_with_a_memory_is_refused():
    calls = []

    def counting(x):
        calls.append(1)
        return control(x) + (len(calls) > 40) * 0.1

    with pytest.raises(UsageError, match="another result|not always do the same|differ"):
        verdict(Inside({"angle": (-5.0, 5.0)}), observed=seen(c=counting))


def test_a_kink_in_the_ode_and_times_beyond_the_horizon_are_refused():
    kinked = seen(lambda x, u: torch.relu(x) + 0 * u)
    with pytest.raises(UnsupportedOperationError, match="'relu' stands in the right-hand side of the ODE"):
        verdict(Inside({"angle": (-5.0, 5.0)}), observed=kinked)
    with pytest.raises(UsageError, match="speaks of 3 s, the horizon ends at 1.2 s"):
        verdict(Inside({"angle": (-5.0, 5.0)}, when=(0.0, 3.0)))
    with pytest.raises(UsageError, match="requirement 'relation'"):
        verdict(Holds(lambda x: 3))


def test_a_requirement_that_is_no_function_of_the_state_is_refused():
    calls = []

    def shrinking(x):
        calls.append(1)
        return 5.0 - len(calls) * 0.1 - x[..., :1]

    with pytest.raises(UsageError, match="requirement 'relation' does not always do the same"):
        verdict(Holds(shrinking))
