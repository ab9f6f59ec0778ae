"""Diffusion: the schedule, the samplers against each other and against closed forms."""

import pytest
import torch

from sagemp_cli.planners import Diffusion
from sagemp_cli.planners.diffusion import DiffusionLoss, cosine_schedule
from sagemp_cli.sets import Box


def options(**changes):
    return {"state_dim": 2, "horizon": 20, "knots": 6, "width": 8, "levels": 50, "denoising_steps": 50} | changes


def noise(count=40, seed=0):
    return torch.randn(count, 6, 2, generator=torch.Generator().manual_seed(seed))


class Gaussian(Diffusion):
    """Answers what is best when knots are normal with mean m and spread s, independently."""

    m, s = 1.5, 0.4

    def answer(self, z, t, conditions):
        level = (t * self.levels).round().long()
        a, b = self.signal[level][:, None, None], self.noise[level][:, None, None]
        knots = self.m + self.s**2 * a / (a**2 * self.s**2 + b**2) * (z - a * self.m)
        epsilon = (z - a * knots) / b
        return {"knots": knots, "v": a * epsilon - b * knots, "epsilon": epsilon}[self.prediction]


def test_the_schedule_falls_from_one_to_almost_nothing():
    abar = cosine_schedule(100)
    assert abar.shape == (101,) and abar[0] == 1 and bool((abar.diff() < 0).all())
    assert 0 < abar[-1] < 1e-4
    assert abar[50] == pytest.approx(0.5, abs=0.02)  # half of the variance at half of the levels
    assert bool((abar[1:] / abar[:-1] >= 1e-3 - 1e-12).all())


@pytest.mark.parametrize("prediction", ["knots", "v", "epsilon"])
def test_ddim_with_all_levels_and_all_noise_is_ddpm(prediction):
    """Song et al. 2021: eta = 1 is the ancestral sampler. The two are written from different formulas."""
    ancestral = Gaussian(**options(prediction=prediction, sampler="ddpm"))
    implicit = Gaussian(**options(prediction=prediction, sampler="ddim", eta=1.0))
    a, b = (m.generate(noise(), None, generator=torch.Generator().manual_seed(1)) for m in (ancestral, implicit))
    assert torch.allclose(a, b, atol=2e-3)
    other = ancestral.generate(noise(), None, generator=torch.Generator().manual_seed(2))
    assert not torch.allclose(a, other, atol=0.05)


@pytest.mark.parametrize("sampling", [{"eta": 0.0}, {"eta": 1.0}, {"sampler": "ddpm"}])
def test_the_best_answer_gives_the_distribution(sampling):
    made = Gaussian(**options(levels=200, denoising_steps=200) | sampling)
    knots = made.generate(noise(2000), None, generator=torch.Generator().manual_seed(1))
    assert float(knots.mean()) == pytest.approx(made.m, abs=0.02)
    assert float(knots.std()) == pytest.approx(made.s, rel=0.06)


def test_ddim_without_fresh_noise_carries_each_noise_to_its_own_knots():
    """The flow of a Gaussian is known: noise e goes to ``m + s e``. Fewer levels come near it too."""
    for steps, tolerance in ((200, 0.06), (20, 0.3)):
        made = Gaussian(**options(levels=200, denoising_steps=steps))
        knots = made.generate(noise(), None, generator=torch.Generator())
        assert torch.allclose(knots, made.m + made.s * noise(), atol=tolerance)


@pytest.mark.parametrize("prediction", ["knots", "v", "epsilon"])
def test_knots_and_noise_are_read_from_every_kind_of_answer(prediction):
    knots, e = noise(seed=3), noise(seed=4)

    class Oracle(Diffusion):
        def answer(self, z, t, conditions):
            level = (t * self.levels).round().long()
            a, b = self.signal[level][:, None, None], self.noise[level][:, None, None]
            return {"knots": knots, "v": a * e - b * knots, "epsilon": e}[prediction]

    made = Oracle(**options(prediction=prediction))
    for level in (1, 10, 40):
        z = made.signal[level] * knots + made.noise[level] * e
        found = made.denoise(z, level, None)
        assert torch.allclose(found[0], knots, atol=1e-3) and torch.allclose(found[1], e, atol=1e-3)


def test_the_losses_of_knots_and_v_are_the_same_where_the_weight_is_not_bounded():
    rows = torch.randn(10, 21, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    knots, e, u = noise(100, seed=5), noise(100, seed=6), torch.rand(100, generator=torch.Generator().manual_seed(7))
    u = 0.2 + 0.8 * u
    losses = {}
    for prediction in ("knots", "v", "epsilon"):
        made = Gaussian(**options(prediction=prediction))
        made.prepare(rows, goal=Box.around([0.0, 0.0], [1.0, 1.0]), generator=torch.Generator())
        losses[prediction] = float(DiffusionLoss(made, rows, steps=1).error(made, knots, e, u, None))
    assert losses["knots"] == pytest.approx(losses["v"], rel=1e-3)
    assert losses["epsilon"] < losses["v"]
