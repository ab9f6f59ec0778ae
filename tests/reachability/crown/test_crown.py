"""The backward pass: what it equals without choices, what its choices gain, and that wrong ones are caught."""

from fractions import Fraction

import numpy as np
import pytest
import torch
from inner import attack_tube

from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled import arrays, operations
from sagemp_cli.reachability.affine.compiled.steps import GENERATORS
from sagemp_cli.reachability.crown import backward_steps
from sagemp_cli.reachability.crown import crown as crown_module
from sagemp_cli.reachability.crown import steps as steps_module
from sagemp_cli.reachability.crown.backward import _Asked, _swept, _tilt, backward
from sagemp_cli.reachability.crown.backward_steps import Product, Step
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.reachability.crown.steps import Steps
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.reachability.lirpa import adapter as lirpa_adapter
from sagemp_cli.reachability.lirpa.auto_lirpa import AutoLirpa
from sagemp_cli.reachability.program.loops import RecordedLoop, record
from sagemp_cli.reachability.relaxations.band import Band
from sagemp_cli.reachability.relaxations.lines import parallel
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import partition

from ..propagator_cases import DISTURBANCE, START, AffineLoop, EveryOperation, line, unicycle_loop


def test_level_planes_and_lines_parallel_to_the_bands_are_affine_arithmetic(monkeypatch):
    def edges(group):
        parts = zip(*(parallel(Band(*map(torch.from_numpy, r.band))) for r in group), strict=True)
        return iter(map(torch.stack, parts))

    monkeypatch.setattr(backward_steps, "_lines", edges)
    for loop, start, w in (
        (unicycle_loop(line(0.3)), START, DISTURBANCE),
        (EveryOperation(), Box.around([0.1, -0.05, 0.2], [0.1] * 3), Box.around([0.0] * 3, [0.01] * 3)),
    ):
        run = Affine().run(loop, start, w, keep_steps=True, intervals=False)
        asked = _Asked(torch.diag_embed(start.radius)[None].numpy(), range(loop.horizon), 0, True, False)
        low, high = (side[0] for side in _swept(Steps(run.steps), asked, False).state)
        torch.testing.assert_close(high - low, run.tube.width[1:], rtol=1e-7, atol=1e-12)


def test_tilted_planes_contain_products_and_those_of_mccormick_are_among_them():
    generator = torch.Generator().manual_seed(0)
    draws = 2 * torch.rand(2, 4000, dtype=torch.float64, generator=generator) - 1
    x, y = torch.cat([draws, torch.tensor([[1, 1, -1, -1], [1, -1, 1, -1]], dtype=torch.float64)], dim=1)
    for correlation in (-1.0, -0.5, 0.0, 0.7, 1.0):
        factor = x * (1 - abs(correlation)) + y * correlation
        total, difference = factor + y, factor - y
        plus, minus = total.abs().max(), difference.abs().max()

        def both(upper, lower):
            return np.array([upper, lower], dtype=float)[None, :, None]

        def product(guess):
            return Product(
                tilts=np.eye(2)[None],  # the variables are M and P themselves
                likely=both(guess, guess) * np.array([1.0, 0.0]),
                top=0.25 * both(plus**2, minus**2),
                free=both(min(minus, 2 - plus), min(plus, 2 - minus)),
                size=both(1, 1),
                offset=both(0, 0),
                middle=both(0, 0),
                magnitude=both(2, 2),
                rounding=both(0, 0),
            )

        for guess in np.linspace(-2, 2, 9):
            for upper, lower in ((1.0, 0.0), (0.0, 1.0)):  # of a row of +1 and of one of -1
                head = np.zeros((1, 4, 1))
                head[0, 2] = 1e-12  # of a row its direction decides, so it need not add anything to speak of
                _tilt(head, both(upper, lower), product(guess), np.eye(2)[None], np.zeros((0, 1)))
                gain, _, m, p = head[0, :, 0].tolist()
                excess = gain + m * difference + p * total - (upper - lower) * factor * y
                assert float(excess.min()) > -1e-11
                # Of all that is known of P and M it is as low as it can be: somewhere it touches.
                grid = [np.linspace(-float(side), float(side), 101) for side in (plus, minus)]
                whole, apart = (part.ravel() for part in np.meshgrid(*grid))
                known = np.abs(whole) + np.abs(apart) <= 2 + 1e-9
                over = gain + m * apart + p * whole - (upper - lower) * 0.25 * (whole**2 - apart**2)
                assert -1e-8 < float(over[known].min()) < 2e-3
                if correlation == 0 and abs(guess) == 2:
                    # McCormick's planes touch the product at three of the four corners.
                    assert int((excess[-4:].abs() < 1e-11).sum()) == 3


def broken(step: Step, kind: str) -> Step:
    """A step with one mistake."""
    if kind == "disturbance forgotten":
        first = step.replacements[0]
        return step._replace(replacements=(first._replace(radius=0 * first.radius), *step.replacements[1:]))
    changed = []
    for r in step.replacements:
        entries = r.last - r.first
        if kind == "upper and lower lines exchanged" and r.lead is not None:
            lead = np.concatenate([r.lead[..., entries:], r.lead[..., :entries]], axis=-1)
            r = r._replace(lead=lead, tilts=r.tilts[::-1])
        if kind == "slopes of lines reversed" and r.lead is not None:
            r = r._replace(tilts=-r.tilts)
        if kind == "offsets of lines halved" and r.lead is not None:
            r = r._replace(lead=0.5 * r.lead)
        if kind == "planes too low" and r.product is not None:
            r = r._replace(product=r.product._replace(top=0.2 * r.product.top), radius=0.2 * r.radius)
        changed.append(r)
    return step._replace(replacements=tuple(changed))


KINDS = [
    "disturbance forgotten",
    "upper and lower lines exchanged",
    "slopes of lines reversed",
    "offsets of lines halved",
    "planes too low",
]


@pytest.mark.parametrize("kind", KINDS)
def test_a_mistake_in_the_backward_pass_is_caught_by_an_attack(kind, monkeypatch):
    loop = unicycle_loop(line(0.3), gain=0.8)
    start, w = Box.around([0.0, 0.0, 0.1, 1.0], [0.3, 0.3, 0.5, 0.4]), DISTURBANCE

    def attack():
        tube = Crown().propagate(loop, start, w)
        return attack_tube(loop, start, w, tube, count=1500, generator=torch.Generator().manual_seed(4)).escapes

    assert attack() == 0
    right = steps_module.ready
    monkeypatch.setattr(steps_module, "ready", lambda steps: [broken(s, kind) for s in right(steps)])
    assert attack() > 0


@pytest.mark.skipif(
    lirpa_adapter._installed() is None and lirpa_adapter._carried() is None, reason="no auto_LiRPA is installed"
)
def test_widths_agree_with_auto_lirpa_on_the_unrolled_loop_within_what_its_intermediate_bounds_gain():
    loop = unicycle_loop(line(0.3))
    loop = ClosedLoop(loop.dynamics, loop.tracker, loop.references[:7])
    crown, best, theirs = (p.propagate(loop, START, DISTURBANCE).width.mean() for p in (Crown(), Best(), AutoLirpa()))
    assert float(best) <= float(theirs)
    assert 0.97 * float(theirs) < float(crown) < 1.002 * float(theirs)


@pytest.mark.parametrize("propagator", [Crown(), Interval()], ids=lambda p: p.name)
def test_bounds_hold_in_exact_arithmetic_where_rounding_matters(propagator):
    # Powers of two make every product exact, the offset of 2^40 makes every sum lose bits: the exact rollout moves by
    # amounts that plain float64 rounds away.
    class Shifted(AffineLoop):
        def step(self, k, x, w):
            return (x * 0.75 + 2.0**40) - (x * 0.5 + 2.0**40) + x * 0.7 + w

    x, zero = torch.tensor([1 / 3, -0.7], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    tube = propagator.propagate(Shifted(), Box(x, x), Box(zero, zero))
    for i, exact in enumerate(map(Fraction, x.tolist())):
        for k in range(9):
            assert Fraction(float(tube.lower[k, i])) <= exact <= Fraction(float(tube.upper[k, i]))
            exact = exact * Fraction(0.75) - exact * Fraction(0.5) + exact * Fraction(0.7)


def test_chunks_of_rows_change_nothing():
    loop = unicycle_loop(line(0.3))
    whole, chunks = (Crown(rows=rows).propagate(loop, START, DISTURBANCE) for rows in (8192, 17))
    torch.testing.assert_close(whole.lower, chunks.lower, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("second", "shared"),
    [
        (torch.cos, [2]),
        (lambda a: torch.cos(2 * a), [1, 1]),
        (lambda a: torch.cos(a + torch.sin(a)), [2, 1]),  # both sines, but not the cosine of more
    ],
)
def test_two_operations_that_follow_one_another_share_the_rows_of_one_input(second, shared):
    x, none = torch.zeros(2, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    program = record(lambda x, w: torch.cat([torch.sin(x[:1]), second(x[:1])]) + w, x, x)
    start, w = Box.around([0.3, 0.0], [0.5, 0.1]), Box.around([0.0, 0.0], [0.01, 0.01])
    steps = Steps(Affine().run(RecordedLoop((program,), none, 1), start, w, keep_steps=True).steps)
    counts = [len(r.inputs.operations) for r in steps[0].replacements if r.inputs is not None]
    assert counts == shared


def test_bounds_of_deviations_become_bounds_of_values_rounded_outwards():
    generator = torch.Generator().manual_seed(0)
    sizes = 10.0 ** torch.randint(-6, 7, (3, 500), generator=generator).double()
    center, low, high = sizes * (2 * torch.rand(3, 500, dtype=torch.float64, generator=generator) - 1)
    lower, upper = crown_module._placed(center, low, high)
    for c, a, b, least, most in zip(*(part.tolist() for part in (center, low, high, lower, upper)), strict=True):
        assert Fraction(least) <= Fraction(c) + Fraction(a) and Fraction(c) + Fraction(b) <= Fraction(most)
    torch.testing.assert_close(lower, center + low, rtol=1e-14, atol=1e-9)
    torch.testing.assert_close(upper, center + high, rtol=1e-14, atol=1e-9)


@pytest.mark.parametrize(("rows", "sweeps"), [(1, 10), (8, 10), (24, 4), (80, 1), (8192, 1)])
def test_as_many_steps_go_back_in_one_sweep_as_the_rows_allow(rows, sweeps, monkeypatch):
    """Ten steps of four states, whose bounds are two rows each."""
    known = []

    def counted(*arguments, **options):
        known.append(options["targets"])
        return backward(*arguments, **options)

    monkeypatch.setattr(crown_module, "backward", counted)
    loop = unicycle_loop(line(0.3))
    loop = ClosedLoop(loop.dynamics, loop.tracker, loop.references[:11])
    Crown(rows=rows).propagate(loop, START, DISTURBANCE)
    assert len(known) == sweeps and [k for targets in known for k in targets] == list(range(10))


def test_inputs_go_back_a_few_steps_to_sets_that_hold_the_states(monkeypatch):
    """Not to the start box: their bounds hold on simulated rollouts, and are nearly those of going back all the way."""
    loop = unicycle_loop(line(0.3), gain=0.8)
    monkeypatch.setattr(crown_module, "TOGETHER", 2)
    found = {}
    for back in (1, 3, 100):
        monkeypatch.setattr(crown_module, "BACK", back)
        found[back] = Best().propagate(loop, START, DISTURBANCE)
        tube = found[back]
        attack = attack_tube(loop, START, DISTURBANCE, tube, count=400, generator=torch.Generator().manual_seed(4))
        assert attack.escapes == 0
    width = {back: float(tube.width.mean()) for back, tube in found.items()}
    affine = float(Affine().propagate(loop, START, DISTURBANCE).width.mean())
    assert width[100] <= width[3] * (1 + 1e-9) <= width[1] * (1 + 1e-8) < affine
    assert width[3] - width[100] < 0.2 * (affine - width[100])


def test_the_sets_that_rows_go_back_to_hold_all_simulated_states():
    loop, generator = unicycle_loop(line(0.3), gain=0.8), torch.Generator().manual_seed(0)
    run = Affine().run(loop, START, DISTURBANCE, keep_steps=True)
    w = DISTURBANCE.sample(500 * loop.horizon, generator).unflatten(0, (500, loop.horizon))
    w = torch.where(w > 0, DISTURBANCE.upper, DISTURBANCE.lower)
    x = torch.where(START.sample(500, generator) > START.center, START.upper, START.lower)
    states, _ = loop.rollout(x, w)
    directions = torch.randn(64, 4, dtype=torch.float64, generator=generator).numpy()
    for k in range(1, loop.horizon):
        away = states[:, k].numpy() - run.steps[k - 1].after.both[0][0]
        within = run.steps[k].within[0]
        assert within.shape[1] <= GENERATORS * 4
        assert (np.abs(away @ directions.T).max(0) <= np.abs(directions @ within).sum(1)).all()


@pytest.mark.parametrize("cells", [1, 3])
def test_where_a_rougher_bound_shows_a_neurons_sign_the_tube_is_the_same(cells, monkeypatch):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        network = torch.nn.Sequential(
            torch.nn.Linear(2, 64),
            torch.nn.ReLU(),
            torch.nn.Linear(64, 64),
            torch.nn.LeakyReLU(),
            torch.nn.Linear(64, 1),
        ).double()
    loop = record(
        lambda x, w: torch.stack([x[0] + 0.1 * x[1], 0.9 * x[1] - 0.2 * torch.sin(x[0]) - 0.1 * network(x)[0] + w[0]]),
        torch.zeros(2, dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    known = RecordedLoop((loop,), torch.zeros(30, 0, dtype=torch.float64), 30)
    start = partition(Box.around([0.3, 0.0], [0.3, 0.2]), [cells, 1])
    tubes = []
    for wide in (48, 10**6):
        monkeypatch.setattr(operations, "WIDE", wide)
        monkeypatch.setattr(arrays, "WIDE", wide)
        tubes.append(Affine().propagate(known, start, Box.around([0.0], [0.01])))
    torch.testing.assert_close(tubes[0].lower, tubes[1].lower, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(tubes[0].upper, tubes[1].upper, rtol=1e-12, atol=1e-13)


def test_wrong_options_are_refused_in_one_line():
    with pytest.raises(ConfigError, match="propagator.rows must be a positive integer, found 0"):
        Crown(rows=0)
    with pytest.raises(ConfigError, match="propagator.symbols must be a positive integer or null, found 0"):
        Crown(symbols=0)
