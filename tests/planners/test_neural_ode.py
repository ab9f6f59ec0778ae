"""The neural-ODE planner as an integrator and as a sampler."""

import json
import math

import numpy as np
import pytest
import torch
from torch import nn

from sagemp_cli.errors import ConfigError, NonFiniteError, UsageError
from sagemp_cli.planners import NeuralODE, Planner
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

SCENE = Scene(Box(torch.zeros(2), torch.ones(2)), (), Box(torch.zeros(2), torch.ones(2)))


class LinearField(nn.Module):
    """``dz/ds = A z + s b``: the closed form is known."""

    A = torch.tensor([[-1.0, 3.0], [-3.0, -0.5]], dtype=torch.float64)
    b = torch.tensor([1.0, -2.0], dtype=torch.float64)

    def embed(self, t):
        return t[..., None] * self.b

    def at(self, z, embedded):
        return z @ self.A.T + embedded

    def solution(self, z, s):
        """By the exponential of the system extended by s and 1."""
        system = torch.zeros(4, 4, dtype=torch.float64)
        system[:2, :2], system[:2, 2], system[2, 3] = self.A, self.b, 1.0
        return (torch.linalg.matrix_exp(s * system) @ torch.cat([z, torch.tensor([0.0, 1.0]).double()]))[:2]


class ZeroField(nn.Module):
    def embed(self, t):
        return t[..., None]

    def at(self, z, embedded):
        return torch.zeros_like(z)


def planner(**changes):
    made = NeuralODE(**({"state_dim": 2, "horizon": 10, "dt": 0.1, "hidden": [16]} | changes))
    made.field.reset(torch.Generator().manual_seed(0))
    made.normalizer.fit(torch.tensor([[-3.0, 0.0], [5.0, 0.2]], dtype=torch.float64))
    return made


def sample(made, start, count, *, seed=0, **changes):
    drawn = torch.Generator().manual_seed(seed)
    return made.sample(start, SCENE.goal, scene=SCENE, count=count, generator=drawn, **changes)


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_the_integration_has_the_order_of_its_method(method, order):
    field, z = LinearField(), torch.tensor([0.7, -0.4], dtype=torch.float64)
    substeps, errors = [2, 4, 8, 16], []
    for count in substeps:
        made = planner(method=method, substeps=count)
        made.field = field
        states = made.advance(z, 0, 10)
        exact = torch.stack([field.solution(z, k / 10) for k in range(1, 11)])
        errors.append(float((states - exact).abs().max()))
    fitted = -np.polyfit(np.log(substeps), np.log(errors), 1)[0]
    assert fitted == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_windows_from_different_steps_continue_the_whole_solution(method):
    made = planner(method=method, substeps=2).double()
    made.field = LinearField()
    z = torch.tensor([0.7, -0.4], dtype=torch.float64)
    whole = made.advance(z, 0, 10)
    first = torch.tensor([2, 5, 6])
    windows = made.advance(whole[first - 1], first, 4)
    for row, k in enumerate(first.tolist()):
        assert torch.allclose(windows[row], whole[k : k + 4], atol=1e-12)


def test_euler_without_substeps_is_the_discrete_map():
    made, x = planner(), torch.tensor([1.3, 0.1], dtype=torch.float64)
    reference = made(x)
    for k in range(10):
        z = made.normalizer.normalize(reference[k])
        following = z + made.field(z.float(), torch.tensor(k / 10)).double() / 10
        assert torch.allclose(made.normalizer.denormalize(following), reference[k + 1], atol=1e-5)


def test_references_begin_at_the_start_to_the_last_bit():
    made = planner()
    starts = torch.tensor([[0.1, 1 / 3], [math.pi, 1e-7]], dtype=torch.float64)
    references = sample(made, starts, 2, noise=0.5)
    assert references.dtype == torch.float64 and references.shape == (2, 11, 2)
    assert torch.equal(references[:, 0], starts)


def test_one_start_is_shared_and_many_are_one_each():
    made, starts = planner(), torch.rand(5, 2, dtype=torch.float64)
    each = sample(made, starts, 5)
    shared = sample(made, starts[2], 3)
    assert shared.shape == (3, 11, 2)
    assert torch.allclose(shared, each[2].expand(3, 11, 2), atol=1e-5)


def test_samples_follow_from_the_generator_alone():
    made, start = planner(noise=[0.5, 0.1]), torch.tensor([0.0, 0.1], dtype=torch.float64)
    first = sample(made, start, 4, seed=1)
    assert torch.equal(first, sample(made, start, 4, seed=1))
    assert not torch.equal(first, sample(made, start, 4, seed=2))
    assert not torch.equal(first[0], first[1])
    quiet = sample(made, start, 4, noise=0.0)
    assert torch.equal(quiet[0], quiet[1])


def test_the_drift_has_the_stated_strength_and_correlation_time():
    """Without a field, increments are the drift times dt: their spread is noise dt, their correlation exp(-dt/time)."""
    made = planner(noise=[2.0, 0.5], noise_time=0.3, horizon=20)
    made.field = ZeroField()
    increments = sample(made, torch.zeros(2, dtype=torch.float64), 4000).diff(dim=1)
    assert torch.allclose(increments.std(0), 0.1 * torch.tensor([2.0, 0.5]).double().expand(20, 2), rtol=0.06)
    correlation = (increments[:, 1:] * increments[:, :-1]).mean((0, 1)) / increments.square().mean((0, 1))
    assert torch.allclose(correlation, torch.full((2,), math.exp(-1 / 3)).double(), atol=0.02)


def test_a_planner_is_rebuilt_from_its_arguments_and_weights():
    made = planner(hidden=[8, 4], frequencies=1, method="rk4", substeps=2, noise=0.1, noise_time=0.5)
    other = NeuralODE(**json.loads(json.dumps(made.arguments)))
    other.load_state_dict(made.state_dict())
    start = torch.tensor([0.2, 0.1], dtype=torch.float64)
    assert torch.equal(sample(made, start, 3), sample(other, start, 3))
    assert isinstance(made, Planner)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"method": "midpoint"}, r"method must be one of \('euler', 'rk4'\), found 'midpoint'"),
        ({"noise": [0.1]}, r"noise needs one number or 2, finite and not negative, found \[0.1\]"),
        ({"noise": -1.0}, r"noise needs one number or 2, finite and not negative, found -1.0"),
        ({"substeps": 0}, "state_dim, horizon and substeps must be positive, found 2, 10 and 0"),
        ({"dt": 0.0}, "dt and noise_time must be positive seconds, found 0.0 and 1.0"),
    ],
)
def test_wrong_options_are_named(changes, text):
    with pytest.raises(ConfigError, match=text):
        planner(**changes)


def test_wrong_starts_are_named():
    made = planner()
    with pytest.raises(UsageError, match=r"start must have shape \(2,\) or \(3, 2\) for 3 references, found \(2, 2\)"):
        sample(made, torch.zeros(2, 2), 3)
    with pytest.raises(UsageError, match="number of references must be positive, found 0"):
        sample(made, torch.zeros(2), 0)
    with pytest.raises(NonFiniteError, match="a start contains NaN or infinity"):
        sample(made, torch.tensor([0.0, float("nan")]), 1)


def test_an_overflow_is_reported():
    made = planner()
    with torch.no_grad():
        made.field.rest[-1].bias.fill_(float("inf"))
    with pytest.raises(NonFiniteError, match="sampled reference contains NaN or infinity"):
        sample(made, torch.zeros(2), 1)
