"""A choice: d where c is positive, else 0, within its band and lines, whatever d has to do with c."""

import pytest
import torch

from sagemp_cli.reachability.relaxations import choice

GRID = torch.linspace(0.0, 1.0, 33, dtype=torch.float64)


def drawn(count, seed):
    """Conditions in [least, most], some decided or at an end; ``d = ratio c + rest``, rest in [low, high]."""
    generator = torch.Generator().manual_seed(seed)

    def numbers():
        return torch.randn(count, dtype=torch.float64, generator=generator)

    size = 10 ** (2 * numbers())
    least, most = torch.stack([numbers(), numbers()]).mul(size).sort(0).values
    least[::9], most[4::9] = 0.0, most[4::9].clamp(max=0.0)
    least = torch.minimum(least, most)
    low, high = torch.stack([numbers(), numbers()]).sort(0).values
    low[::4] = high[::4] = 0.0  # branches that meet
    ratio = 3 * numbers() * (torch.rand(count, generator=generator) < 0.8)
    ends = torch.stack([ratio * least, ratio * most])
    lower, upper = ends.amin(0) + low, ends.amax(0) + high
    return least, most, ratio, low, high, lower, upper


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("off", [0.0, 0.3])  # of the ratio that is used: any will do
def test_every_choice_lies_within_its_band_and_lines(seed, off):
    least, most, ratio, low, high, lower, upper = drawn(300, seed)
    used = ratio * (1 - off)
    rest = torch.stack([(ratio - used) * least, (ratio - used) * most])
    found = choice.sides(lower, upper, least, most, used, rest.amin(0) + low, rest.amax(0) + high)
    chosen, *_ = found
    assert bool(((chosen == 1) == (least > 0)).all()) and bool(((chosen == -1) == ((most <= 0) & (least <= 0))).all())
    band, lines = choice.band(lower, upper, *found), choice.lines(lower, upper, *found)
    c = least[:, None, None] + (most - least)[:, None, None] * GRID[:, None]
    c = torch.cat([c, torch.zeros_like(c[:, :1]).clamp(least[:, None, None], most[:, None, None]) + 1e-300], dim=1)
    c = torch.minimum(torch.maximum(c, least[:, None, None]), most[:, None, None])
    d = ratio[:, None, None] * c + low[:, None, None] + (high - low)[:, None, None] * GRID
    value = torch.where(c > 0, d, 0.0)
    doubt = 1e-12 * (1 + d.abs())
    slope, offset, radius = (part[:, None, None] for part in band)
    assert bool(((value - slope * d - offset).abs() <= radius + doubt).all())
    a, b, p, q = (part[:, None, None] for part in lines)
    assert bool((a * d + b <= value + doubt).all()) and bool((value <= p * d + q + doubt).all())


def test_a_decided_choice_is_exact_and_one_between_branches_that_meet_costs_what_a_relu_costs():
    one = torch.ones(1, dtype=torch.float64)
    for least, most, slope in ((0.5, 1.0, 1.0), (-1.0, 0.0, 0.0)):
        found = choice.sides(-3 * one, 5 * one, least * one, most * one, 0 * one, -3 * one, 5 * one)
        assert [float(part) for part in choice.band(-3 * one, 5 * one, *found)] == [slope, 0.0, 0.0]
    found = choice.sides(-one, 2 * one, -one, 2 * one, one, 0 * one, 0 * one)
    slope, offset, radius = choice.band(-one, 2 * one, *found)
    assert float(slope) == pytest.approx(2 / 3) and float(radius) == pytest.approx(1 / 3)


def test_a_broken_band_is_found_out():
    least, most, ratio, low, high, lower, upper = drawn(300, 7)
    found = choice.sides(lower, upper, least, most, ratio, low, high)
    slope, offset, radius = choice.band(lower, upper, *found)
    ends = torch.stack([torch.where(c > 0, ratio * c + r, 0.0) - slope * (ratio * c + r) - offset
                        for c in (least, most, most.clamp(max=0.0)) for r in (low, high)])  # fmt: skip
    open_ = (found[0] == 0) & (radius > 1e-3)
    assert bool((ends.abs().amax(0) > 0.5 * radius)[open_].any())


def test_where_nothing_is_known_nothing_is_claimed():
    nan, inf = torch.tensor([float("nan")]).double(), torch.tensor([float("inf")]).double()
    for lower, upper in ((nan, nan), (-inf, inf)):
        found = choice.sides(lower, upper, -inf, inf, 0 * torch.ones(1).double(), lower, upper)
        assert float(choice.band(lower, upper, *found).radius) == float("inf")
        assert not bool(torch.stack(list(choice.lines(lower, upper, *found))).isnan().any())
