"""Tubes of a control that lags enclose every solution, whatever delays and jitters it meets."""

import pytest
import torch

from sagemp_cli.errors import UsageError
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous.lagging import Shares
from sagemp_cli.reachability.continuous.reach import reach_continuously
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.sets import Box

FINE = 32


def box(lower, upper):
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


class Arm:
    """A pendulum under a saturated motor whose torque depends on its angle, sampled every 0.1 s."""

    horizon, state_dim, period = 12, 2, 0.1

    def __init__(self, delay=(0.0, 0.0), jitter=(0.0, 0.0)):
        self.lag = box([delay[0], jitter[0]], [delay[1], jitter[1]])

    def numbers(self):
        return torch.zeros(self.horizon, 0, dtype=torch.float64)

    def control_given(self, numbers, x):
        return (-2 * x[..., :1] - x[..., 1:]).clamp(-1.0, 1.0)

    def rate(self, x, u):
        angle, rate = x[..., :1], x[..., 1:]
        return torch.cat([rate, torch.sin(angle) - 0.2 * rate + 3 * u * torch.cos(angle)], -1)


START = box([[0.2, -0.1], [0.25, -0.1]], [[0.25, 0.1], [0.3, 0.1]])
W = box([-0.02, -0.3], [0.04, 0.3])


def solved(loop, x, u, w, h):
    a = loop.rate(x, u) + w
    b = loop.rate(x + h / 2 * a, u) + w
    c = loop.rate(x + h / 2 * b, u) + w
    return x + h / 6 * (a + 2 * b + 2 * c + loop.rate(x + h * c, u) + w)


def rollouts(loop, x, w, generator):
    """States ``(R, K FINE + 1, n)``; every other instant has an extreme lag, the others a random one."""
    h, count, states, held, past, felt = loop.period / FINE, len(x), [x], None, [], []
    for k in range(loop.horizon):
        share = torch.rand(count, 2, dtype=torch.float64, generator=generator)
        late = loop.lag.lower + (share.round() if k % 2 else share) * (loop.lag.upper - loop.lag.lower)
        measured = x
        if k:  # j seconds before: followed from the last place that is known before that
            before = loop.period - late[:, 1]
            place = (before / h).floor().clamp(max=FINE - 1).long()
            row = torch.arange(count)
            from_there, under = torch.stack(past)[place, row], torch.stack(felt)[place, row]
            measured = solved(loop, from_there, held, under, (before - place * h)[:, None])
        u = loop.control_given(None, measured)
        held, past, felt = u if held is None else held, [], []
        for i in range(FINE):
            now = w[:, k * FINE + i]
            past.append(x)
            felt.append(now)
            old = (late[:, :1] - i * h).clamp(0.0, h)
            x = solved(loop, solved(loop, x, held, now, old), u, now, h - old)
            states.append(x)
        held = u
    return torch.stack(states, 1)


def signals(count, steps, generator):
    found = []
    for r in range(count):
        every = [steps, FINE, FINE // 2, 4, 1][r % 5]
        sides = torch.rand(-(-steps // every), 2, generator=generator) < 0.5
        found.append(torch.where(sides.repeat_interleave(every, 0)[:steps], W.lower, W.upper))
    return torch.stack(found)


@pytest.mark.parametrize(
    ("delay", "jitter", "substeps", "order"),
    [
        ((0.0, 0.02), (0.0, 0.0), 1, 2),
        ((0.0, 0.1), (0.0, 0.0), 4, 2),
        ((0.0, 0.05), (0.0, 0.0), 2, 3),
        ((0.03, 0.03), (0.0, 0.0), 1, 2),
        ((0.0, 0.0), (0.0, 0.02), 1, 2),
        ((0.0, 0.02), (0.0, 0.005), 1, 1),
        ((0.03, 0.05), (0.01, 0.05), 4, 2),
    ],
)
def test_no_solution_leaves_the_sets_whatever_the_lag(delay, jitter, substeps, order):
    loop, generator = Arm(delay, jitter), torch.Generator().manual_seed(0)
    reach = reach_continuously(Affine(), loop, START, W, substeps=substeps, order=order)
    assert reach.flow is not None and bool(torch.isfinite(reach.tube.upper).all())
    assert reach.tube.lower.shape[-1] == 2 and reach.control_lower.shape[-1] == 1
    flow, per, slack = reach.flow, FINE // substeps, 1e-9  # of the simulation
    lines, bulge = flow.lines(reach.tube, W, loop.period)
    for c in range(2):
        x = torch.where(torch.rand(60, 2, generator=generator) < 0.5, START.lower[c], START.upper[c])
        states = rollouts(loop, x, signals(60, loop.horizon * FINE, generator), generator)
        at = states[:, ::FINE]
        assert bool(((reach.tube.lower[c] - slack <= at) & (at <= reach.tube.upper[c] + slack)).all())
        inner = states[:, :-1].reshape(60, loop.horizon * substeps, per, 2)
        low, high = flow.lower[c].flatten(0, 1)[:, None], flow.upper[c].flatten(0, 1)[:, None]
        assert bool(((low - slack <= inner) & (inner <= high + slack)).all())
        s = torch.arange(per, dtype=torch.float64)[:, None] / per
        swing = bulge.swing if bulge.swing.dim() == 2 else bulge.swing[c]
        off = s * (1 - s) * (bulge.curve[c] + swing)[:, None] + bulge.rest[c][:, None]
        low, high = ((1 - s) * e[c][:-1, None] + s * e[c][1:, None] for e in (lines.lower, lines.upper))
        assert bool(((low - off - slack <= inner) & (inner <= high + off + slack)).all())


def test_a_delay_that_is_known_is_worth_knowing_and_one_of_nothing_costs_nothing():
    def widths(**lag):
        tube = reach_continuously(Affine(), Arm(**lag), START, W, substeps=1).tube
        return (tube.upper - tube.lower)[:, -1].amax()

    plain = Arm()
    plain.lag = None
    without = reach_continuously(Affine(), plain, START, W, substeps=1).tube
    none = reach_continuously(Affine(), Arm(), START, W, substeps=1).tube
    assert torch.equal(none.lower, without.lower) and torch.equal(none.upper, without.upper)
    assert widths(delay=(0.04, 0.04)) < 0.9 * widths(delay=(0.0, 0.04))


def test_shares_of_a_part_hold_those_of_every_delay():
    lag, division, generator = box([0.013, 0.0], [0.071, 0.0]), Division(4, 2), torch.Generator().manual_seed(0)
    shares = Shares.of(lag, 0, 3, 0.1, division)
    assert shares.parts == 3 and not bool(shares.most[0].any()) and not bool(shares.means.upper[0].any())
    t = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)
    for delay in 0.013 + 0.058 * torch.rand(50, generator=generator, dtype=torch.float64):
        for j in range(3):
            s = ((delay - j * 0.025) / 0.025).clamp(0.0, 1.0)
            force = (t < s).double()
            first = 2 * torch.trapezoid((1 - t) * force, t)
            last = 2 * torch.trapezoid(t * force, t)
            swing = torch.cumulative_trapezoid(force - first, t)
            for value, mean in ((first, 0), (last, 1)):
                assert shares.means.lower[1, j, mean] - 2e-3 <= value <= shares.means.upper[1, j, mean] + 2e-3
            assert float(swing.abs().mean()) <= shares.swing[1, j] + 2e-3


def test_a_loop_without_a_control_has_none_that_lags():
    x = START.center[0]
    control, rate = (record(f, x, x * 0) for f in (lambda x, w: x * 1, lambda x, w: torch.sin(x)))
    free = SampledLoop(control, rate, torch.zeros(3, 0, dtype=torch.float64), 3, 0.1, box([0.0, 0.0], [0.02, 0.0]))
    with pytest.raises(UsageError, match="no control"):
        reach_continuously(Affine(), free, START, W)
