"""Other people's loops: every one gets a tube that holds its rollouts, or an error that names the culprit."""

from __future__ import annotations

import copy
import itertools
import math
import pathlib
import random
import subprocess
import sys
import types

import numpy as np
import pytest
import torch
from torch import nn

from sagemp_cli.errors import NonFiniteError, SagempError, UnsupportedOperationError, UsageError
from sagemp_cli.plugins.registry import names
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.lirpa.adapter import find
from sagemp_cli.reachability.propagator import Propagator, Reach
from sagemp_cli.sets import Box, Tube

K = 6
START = Box.around([0.3, -0.2, 0.4], [0.15, 0.1, 0.1])
DISTURBANCE = Box.around([0.0, 0.01], [0.05, 0.02])
GAIN = np.array([[-0.8, -0.4, 0.1]])
GAIN32 = torch.tensor([[-0.8, -0.4, 0.1]])
MATRIX32 = torch.tensor([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.0], [0.0, 0.2, 0.8]])


def network(*layers: nn.Module, dtype=torch.float32) -> nn.Module:
    """Some layers with reproducible random weights."""
    generator = torch.Generator().manual_seed(3)
    net = nn.Sequential(*layers).to(dtype)
    with torch.no_grad():
        for p in net.parameters():
            p.copy_(0.5 * torch.randn(p.shape, generator=generator))
    return net


def moved(x, u, w):
    """A small nonlinear robot in the style ``x[..., i]``."""
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    return torch.stack(
        [a + 0.1 * b * torch.cos(c), b + 0.1 * (u + w[..., 0]), c + 0.1 * torch.sin(a) - 0.1 * w[..., 1]], dim=-1
    )


# -- loops that must get a right tube ----------------------------------------------------------------------------------


def saturated_network(net):
    return lambda x, w: moved(x, torch.clamp(net(x)[..., 0], -0.5, 0.5), w)


def single_entries(x, w):
    u = torch.clamp(-x[0] - 0.5 * x[1], -0.2, 0.2)
    return torch.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * u + w[0], x[2] * x[0] + w[1]])


def batch_columns(x, w):
    u = torch.tanh(-x[:, 0] - x[:, 1])
    return torch.stack([x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u + w[:, 0], x[:, 2] * x[:, 0] + w[:, 1]], dim=1)


def batch_slices(x, w):
    return torch.cat([x[:, :1] + 0.1 * x[:, 1:2], x[:, 1:] * 0.9 + w], dim=1)


def unpacked(x, w):
    a, b, c = x
    w0, w1 = w
    return torch.stack((a + 0.1 * b * c, b - 0.1 * torch.sin(a) + w0, 0.9 * c + w1))


def unbound(x, w):
    a, b, c = x.unbind(-1)
    return torch.stack([a + 0.1 * b * c, b - 0.1 * a**2, 0.9 * c + w[..., 1]], -1)


def numpy_constants(x, w):
    u = (torch.as_tensor(GAIN) @ x)[0]
    return x + np.float64(0.1) * torch.stack([x[1], u, np.float32(0.3) * w[0]]) + 0.1 * np.array([0.0, 0.1, 0.0])


def numpy_gain_on_the_left(x, w):
    return x * np.array([0.9, 0.8, 0.7]) + np.float64(0.05) * x + w[1]


def matrix_on_the_left(x, w):
    return MATRIX32 @ x + torch.cat([w, w[:1]])


def matrix_on_the_right(x, w):
    m = torch.tensor([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.0], [0.0, 0.2, 0.8]], dtype=torch.float64)
    return x @ m.T + w[..., :1]


def einstein(x, w):
    m = torch.tensor([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.0], [0.0, 0.2, 0.8]], dtype=torch.float64)
    return torch.einsum("ij,...j->...i", m, x) + w[..., 1:]


def rotation(x, w):
    c, s, z = torch.cos(x[2]), torch.sin(x[2]), torch.zeros_like(x[2])
    r = torch.stack([torch.stack([c, -s, z]), torch.stack([s, c, z]), torch.stack([z, z, torch.ones_like(z)])])
    return 0.9 * (r @ x) + torch.nn.functional.pad(w, (0, 1))


def in_place_on_a_copy(x, w):
    y = x.clone()
    y[..., 0] = x[..., 0] + 0.1 * x[..., 1]
    y[..., 2] += w[..., 1]
    y[..., 1] *= 0.9
    return y


def in_place_from_zeros(x, w):
    dx = torch.zeros_like(x)
    dx[0] = x[1]
    dx[1] = -torch.sin(x[0]) - x[1]
    dx[2:] = w[:1]
    return x + 0.1 * dx


def in_place_through_a_view(x, w):
    y = 1.0 * x
    first = y[..., 0]
    first.mul_(0.5)
    again = y
    again += 0.1 * w[..., :1]
    return y + 0.1 * first[..., None]


def in_place_relu_seen_through_a_view(x, w):
    h = x - 0.3
    view = h[..., :2]
    torch.nn.functional.relu(h, inplace=True)
    return 0.5 * h + 0.2 * view.sum(-1, keepdim=True) + w[..., :1]


def writes_into_its_argument(x, w):
    x[..., 1] = 0.5 * x[..., 0]
    return x + w[..., :1]


def quotient(x, w):
    return torch.stack([x[0] / (1.5 + x[1] ** 2), 1.0 / (2.0 + x[2]), (x[0] + w[0]) / (x[2] + 2)])


def two_operand_limits(x, w):
    low, high = torch.minimum(x, torch.full_like(x, 0.2)), torch.maximum(x, 0.5 * x.flip(-1))
    return 0.5 * low + 0.4 * high + 0.1 * torch.min(x, -x) + w[..., 1:]


def clamp_with_limits_of_the_state(x, w):
    return 0.9 * torch.clamp(x, -x.abs() - 0.1, torch.tensor([0.35, 0.4, 0.2])) + w[..., :1]


def one_sided_clamps(x, w):
    return 0.9 * x.clamp(min=0.0) - 0.5 * torch.clip(x, max=0.1) + torch.relu(x - 0.35) + w[..., :1]


def functions_of_all_kinds(x, w):
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    first = torch.sqrt(1 + a * a) - 1 + torch.sigmoid(b) * 0.1
    second = torch.atan2(b, 2 + a) + nn.functional.softplus(c) * 0.1
    third = torch.exp(-c) * 0.2 + torch.tan(0.5 * a) + torch.log(2 + b) * 0.1 + nn.functional.silu(w[..., 0])
    return torch.stack([first, second, third], -1)


def sums_and_means(x, w):
    return 0.3 * x.sum(-1, keepdim=True) + 0.5 * x.mean(dim=-1, keepdim=True) + 0.3 * x + w.sum(-1)[..., None]


def total_of_one_state(x, w):
    return 0.5 * x / (1.0 + (x + 2).norm()) + 0.1 * x.sum() * torch.ones_like(x) + 0.1 * x.max() + w[0]


def scalar_product(x, w):
    return x * (1 - 0.2 * (x @ x)) + 0.1 * torch.dot(x[:2], w)


def shapes(x, w):
    block = x.reshape(-1, 1, 3).repeat(1, 2, 1).transpose(-1, -2).flatten(-2)[..., ::2]
    left, right = torch.split(block.squeeze(0), [1, 2], dim=-1)
    return 0.9 * torch.cat([right, left], -1).view(x.shape).roll(1, -1).index_select(-1, torch.tensor([2, 0, 1])) + w[0]


def by_its_own_shape(x, w):
    if x.dim() == 1:
        return by_its_own_shape(x[None], w[None])[0]
    assert x.size(-1) == 3 == x.shape[-1] and x.ndim == 2 and x.numel() == 3 * len(x)
    return 0.9 * x + 0.1 * w[:, :1]


def harmless_conversions(x, w):
    with torch.no_grad():
        y = x.double().to(torch.float64).to(x.device).contiguous().detach().clone().requires_grad_(False)
    return 0.9 * y.type_as(x).cpu().data + w.to(x)[..., :1]


def doubles_and_integers(x, w):
    steps = torch.tensor([1, 2, 3])
    return x * steps * 0.3 + torch.arange(3) * 0.01 + True * w[..., :1] + np.int32(1) * 0.1


def captured_with_gradient(x, w, gain=torch.tensor([0.9, 0.8, 0.7], requires_grad=True)):
    return gain * x + w[..., :1]


def rounding_matters(x, w):
    # With the weights rounded to float32 once more, or 0.1 taken as a float32, the tube of a point would miss.
    return torch.tensor(0.1) * x + 0.1


def ignores_the_state(x, w):
    return torch.tensor([0.1, 0.2, 0.3])


def ignores_the_state_but_not_the_disturbance(x, w):
    return torch.cat([w, w[..., :1]], -1)


def constant_folded(x, w):
    y = torch.zeros_like(x) * 3 + 1
    return y.cumsum(-1) * 0.1 + 0.5 * x + w[..., :1]


def comprehension(x, w):
    return torch.stack([0.9 * v + 0.1 * x[(i + 1) % len(x)] * w[0] for i, v in enumerate(x)])


def keeps_a_log(x, w, log=[]):  # noqa: B006 (it is the point)
    log.append(1)
    return 0.9 * x + w[..., :1]


def unused_branch_of_the_seed(x, w):
    generator = torch.Generator().manual_seed(0)
    return 0.9 * x + 0.01 * torch.rand(3, generator=generator, dtype=torch.float64) + w[..., :1]


def copied(x, w):
    y = copy.deepcopy(x)
    y[..., 0] = 0.0
    return 0.5 * x + 0.3 * copy.copy(y) + w[..., :1]


def cross_product(x, w):
    return 0.5 * x + torch.linalg.cross(x, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).expand_as(x)) + w[..., :1]


def asks_for_the_type(x, w):
    x = x if isinstance(x, torch.Tensor) and torch.is_tensor(x) else torch.tensor(x)
    return 0.9 * x + w[..., :1]


def powers(x, w):
    even = 0.1 * (x + 1) ** torch.tensor(2) - 0.2 * torch.square(x)
    return even + 0.1 * x ** np.int64(3) + 0.1 * (x + 2) ** -1 - 0.15 + w[..., :1]


def half_open(x, w):
    return torch.clamp(x * 0.9, max=math.inf) + w[..., :1]


RIGHT = {
    "tanh network, float32": saturated_network(network(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))),
    "relu network in place, float32": saturated_network(
        network(nn.Linear(3, 8), nn.ReLU(inplace=True), nn.Linear(8, 1))
    ),
    "hard network, float16": saturated_network(
        network(nn.Linear(3, 6), nn.Hardtanh(), nn.Linear(6, 6), nn.ReLU6(), nn.Linear(6, 1), dtype=torch.float16)
    ),
    "many activations": saturated_network(
        network(
            nn.Linear(3, 4), nn.SiLU(), nn.Linear(4, 4), nn.ELU(), nn.Linear(4, 4), nn.LeakyReLU(), nn.Linear(4, 1)
        ).requires_grad_(True)
    ),
    "dropout in evaluation mode": saturated_network(
        network(nn.Linear(3, 4), nn.Dropout(0.5), nn.Sigmoid(), nn.Linear(4, 1), nn.Flatten(-1)).eval()
    ),
    **{
        f.__name__: f
        for f in (
            single_entries, batch_columns, batch_slices, unpacked, unbound, numpy_constants, numpy_gain_on_the_left,
            matrix_on_the_left, matrix_on_the_right, einstein, rotation, in_place_on_a_copy, in_place_from_zeros,
            in_place_through_a_view, in_place_relu_seen_through_a_view, writes_into_its_argument, quotient,
            two_operand_limits, clamp_with_limits_of_the_state, one_sided_clamps, functions_of_all_kinds,
            sums_and_means, total_of_one_state, scalar_product, shapes, by_its_own_shape, harmless_conversions,
            doubles_and_integers, captured_with_gradient, rounding_matters, ignores_the_state,
            ignores_the_state_but_not_the_disturbance, constant_folded, comprehension, keeps_a_log,
            unused_branch_of_the_seed, copied, cross_product, half_open,
            asks_for_the_type, powers,
        )
    },
}  # fmt: skip

BATCH_ONLY = ("batch_columns", "batch_slices")


def widened(step):
    """The step with the parameters of its modules, and its captured tensors, exactly converted to float64."""

    def convert(value):
        if isinstance(value, nn.Module):
            return copy.deepcopy(value).double()
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            return value.detach().double()
        return value

    cells = tuple(types.CellType(convert(c.cell_contents)) for c in step.__closure__ or ())
    names = {k: convert(v) if isinstance(v, torch.Tensor) else v for k, v in step.__globals__.items()}
    defaults = tuple(convert(v) for v in step.__defaults__ or ())
    return types.FunctionType(step.__code__, names, step.__name__, defaults, cells)


def rollouts(plain, *, count, start=START, disturbance=DISTURBANCE, horizon=K):
    """States ``(count, K+1, n)``: half of the starts and half of the disturbances at corners."""
    generator = torch.Generator().manual_seed(11)
    x = start.sample(count, generator)
    corners = torch.tensor(list(itertools.product(*torch.stack([start.lower, start.upper], 1).tolist()))).double()
    corners = torch.minimum(torch.maximum(corners, start.lower), start.upper)
    x[: count // 2] = corners[torch.arange(count // 2) % len(corners)]
    w = disturbance.sample(count * horizon, generator).unflatten(0, (count, horizon))
    bang = torch.where(torch.rand(w.shape, generator=generator) < 0.5, disturbance.lower, disturbance.upper)
    w[::2] = bang[::2]
    states = [x]
    for k in range(horizon):
        states.append(plain(states[-1].clone(), w[:, k].clone()))
    return torch.stack([s.double().expand(x.shape) for s in states], dim=-2).detach()


def takes_batches(name):
    """Known of the functions above: those in the style ``x[..., i]`` do."""
    return name in BATCH_ONLY or "network" in name or name in (
        "many activations", "dropout in evaluation mode", "matrix_on_the_right", "einstein", "in_place_on_a_copy",
        "in_place_through_a_view", "in_place_relu_seen_through_a_view", "writes_into_its_argument", "unbound",
        "two_operand_limits", "clamp_with_limits_of_the_state", "one_sided_clamps", "functions_of_all_kinds",
        "sums_and_means", "harmless_conversions", "doubles_and_integers", "captured_with_gradient", "rounding_matters",
        "ignores_the_state", "ignores_the_state_but_not_the_disturbance", "constant_folded", "keeps_a_log",
        "unused_branch_of_the_seed", "copied", "cross_product", "half_open", "asks_for_the_type", "powers",
    )  # fmt: skip


def plain(name):
    """The step of that name in float64 on batches, made without the code under test."""
    step = widened(RIGHT[name])
    if takes_batches(name):
        return step
    if "numpy" not in name:
        return torch.vmap(step)
    return lambda x, w: torch.stack([step(a, b) for a, b in zip(x, w, strict=True)])


@pytest.mark.filterwarnings("ignore:__array_wrap__:DeprecationWarning")  # numpy's, of arrays that meet plain tensors
@pytest.mark.parametrize("name", RIGHT)
def test_a_tube_holds_2000_rollouts_of_the_plain_function(name):
    step = RIGHT[name]
    tube = reach(step, START, DISTURBANCE, K)
    states = rollouts(plain(name), count=2000)
    assert tube.horizon == K and bool(tube.bounded)
    assert torch.equal(tube.lower[0], START.lower) and torch.equal(tube.upper[0], START.upper)
    # The oracle itself rounds, the tube encloses exact rollouts: a point's tube may be as thin as that.
    slack = 4e-16 * K * states.abs().amax()
    assert bool(((tube.lower - slack <= states) & (states <= tube.upper + slack)).all())
    # And it is no trivial one: at most three times as wide as what the rollouts fill.
    filled = states.amax(0) - states.amin(0)
    assert bool((tube.width <= 3.0 * filled + 1e-9).all())
    assert not tube.lower.requires_grad


@pytest.mark.parametrize("name", ["single_entries", "batch_columns", "unbound", "rotation", "in_place_from_zeros"])
def test_cells_are_never_taken_for_states(name):
    # As many cells as states, disturbances, or one more: whatever indexes the wrong dimension would fit.
    step, whole = RIGHT[name], reach(RIGHT[name], START, DISTURBANCE, K)
    states = rollouts(plain(name), count=400)
    for partitions in (2, 3, 4, [1, 3, 1], "2x2x2"):
        tube = reach(step, START, DISTURBANCE, K, partitions=partitions, cells_at_once=3)
        assert bool(tube.contains(states).all())
        assert bool((tube.width <= whole.width + 1e-12).all())


@pytest.mark.parametrize("propagator", [p for p in names("propagator") if p != "auto_lirpa"])
@pytest.mark.parametrize(
    "name", ["tanh network, float32", "unpacked", "in_place_from_zeros", "ignores_the_state", "quotient"]
)
def test_every_propagator_takes_a_strangers_loop(name, propagator):
    step = RIGHT[name]
    tube = reach(step, START, DISTURBANCE, K, propagator=propagator, partitions=2)
    states = rollouts(plain(name), count=300)
    assert bool(tube.contains(states).all())


def test_auto_lirpa_takes_a_strangers_loop():
    try:
        find()
    except UsageError as error:
        pytest.skip(str(error))
    name = "tanh network, float32"
    tube = reach(RIGHT[name], START, DISTURBANCE, 3, propagator="auto_lirpa")
    states = rollouts(plain(name), count=300, horizon=3)
    assert bool(tube.contains(states).all())


def test_a_float32_weight_is_taken_as_the_exact_number_it_is():
    point, none = Box.around([1.0], [0.0]), Box.around([0.0], [0.0])
    tube = reach(lambda x, w: torch.tensor([0.1]) * x, point, none, 1)
    exact = float(np.float32(0.1))
    assert tube.lower[1].item() <= exact <= tube.upper[1].item()
    assert tube.width[1].item() < 1e-14
    tube = reach(lambda x, w: 0.1 * x, point, none, 1)
    assert tube.lower[1].item() <= 0.1 <= tube.upper[1].item() and tube.width[1].item() < 1e-14


def test_an_affine_loop_gets_its_exact_tube():
    a = torch.tensor([[0.9, 0.2], [-0.1, 0.8]], dtype=torch.float64)
    start, disturbance = Box.around([1.0, -1.0], [0.1, 0.2]), Box.around([0.0], [0.05])
    tube = reach(lambda x, w: x @ a.T + w, start, disturbance, 10)
    center, generators = start.center, torch.diag(start.radius)
    for k in range(1, 11):
        center = a @ center
        generators = torch.cat([a @ generators, torch.full((2, 1), 0.05, dtype=torch.float64)], 1)
        radius = generators.abs().sum(1)
        assert torch.allclose(tube.lower[k], center - radius, rtol=0, atol=1e-13)
        assert torch.allclose(tube.upper[k], center + radius, rtol=0, atol=1e-13)


def test_a_loop_may_depend_on_the_step_number():
    class Wave:
        horizon, state_dim = 8, 2
        gains = [0.5, 0.9, -0.4, 0.3, 0.2, 0.8, -1.0, 0.1]

        def step(self, k, x, w):
            return torch.stack([x[0] + 0.1 * x[1], self.gains[k] * torch.sin(x[0]) + w[0]])

    start, disturbance = Box.around([0.0, 0.0], [0.3, 0.1]), Box.around([0.0], [0.1])
    loop = Wave()
    tube = reach(loop, start, disturbance)
    assert tube.horizon == 8
    x = start.sample(500, torch.Generator().manual_seed(0))
    for k in range(8):
        w = 0.1 * torch.sign(torch.randn(500, generator=torch.Generator().manual_seed(k))).double()
        x = torch.stack([x[:, 0] + 0.1 * x[:, 1], loop.gains[k] * torch.sin(x[:, 0]) + w], -1)
        assert bool(((tube.lower[k + 1] <= x) & (x <= tube.upper[k + 1])).all())
    assert reach(loop, start, disturbance, 3).horizon == 3
    with pytest.raises(UsageError, match="horizon 9 is longer than the loop's, 8"):
        reach(loop, start, disturbance, 9)
    with pytest.raises(UsageError, match="the loop has 2 states, the start box has 3"):
        reach(loop, START, disturbance)


def test_a_loop_that_overflows_has_infinite_rows():
    tube = reach(lambda x, w: torch.exp(5 * x), Box.around([2.0], [0.1]), Box.around([0.0], [0.0]), 4)
    assert not bool(tube.bounded) and bool(torch.isfinite(tube.upper[1]).all())


def test_a_pole_inside_the_sets_is_no_finite_tube():
    tube = reach(lambda x, w: torch.clamp(1.0 / x, -1, 1), Box.around([0.0], [0.5]), Box.around([0.0], [0.0]), 1)
    # 1 / 0 has no value; whatever is claimed must hold all values that there are.
    assert tube.lower[1].item() <= -1.0 and tube.upper[1].item() >= 1.0


# -- loops that must be refused ----------------------------------------------------------------------------------------


class Counter:
    def __init__(self):
        self.calls = 0

    def __call__(self, x, w):
        self.calls += 1
        return 0.9 * x + 0.001 * self.calls


class LateCounter(Counter):
    def __call__(self, x, w):
        self.calls += 1
        return 0.9 * x + (0.1 if self.calls > 25 else 0.0)


class Lag:
    last = 0.0

    def __call__(self, x, w):
        u = -0.5 * x[..., 0] + 0.5 * self.last
        self.last = u
        return torch.stack([u, x[..., 1], x[..., 2]], -1)


def nan_network():
    net = network(nn.Linear(3, 2), nn.Tanh(), nn.Linear(2, 3))
    with torch.no_grad():
        net[0].weight[1, 2] = math.nan
    return lambda x, w: net(x)


def infinite_network():
    net = network(nn.Linear(3, 2), nn.Tanh(), nn.Linear(2, 3))
    with torch.no_grad():
        net[0].weight[1, 2] = math.inf  # hidden by the tanh: the outputs are finite
    return lambda x, w: net(x)


def branch(x, w):
    return 0.9 * x if x[0] > 0 else 0.5 * x


def branch_on_a_value(x, w):
    return 0.9 * x if x[..., 0].sum() else 0.5 * x


def assigned_into_a_plain_tensor(x, w):
    dx = torch.zeros(3, dtype=torch.float64)
    dx[0] = x[1]
    return x + dx


def grad_mode(x, w):
    return 0.9 * x if torch.is_grad_enabled() else 0.8 * x


def hidden_branch(x, w):
    # Nothing on the value recorded: the type tells that it is being watched.
    return 0.9 * x if "Traced" in type(x).__name__ else 0.5 * x


def plain_type(x, w):
    return 0.5 * x if type(x) is torch.Tensor else 0.9 * x


def caught(x, w):
    # Swallows the refusal, and nowhere near the start box does the branch matter.
    try:
        return 0.9 * x if x[..., 0] < 5 else -x
    except Exception:
        return 0.9 * x


def caught_unsupported(x, w):
    try:
        return 0.9 * x + 0.0 * torch.lgamma(0.01 * (x + 20))
    except Exception:
        return 0.9 * x


def batch_mix(x, w):
    return x[:, :] - x.mean(0, keepdim=True) + x[:1, :]


def two_meanings(x, w):
    return x - x[..., :1] if x.dim() == 2 else 0.9 * x


WRONG = {
    "branch": (branch, UnsupportedOperationError, "test_reach.py, line .*may not branch on a value"),
    "truth": (branch_on_a_value, UnsupportedOperationError, "may not branch on a value"),
    "float": (lambda x, w: x * float(x[0]), UnsupportedOperationError, r"float\(\)"),
    "int": (lambda x, w: x * int(x[0]), UnsupportedOperationError, r"int\(\)"),
    "item": (lambda x, w: x * x[0].item(), UnsupportedOperationError, r"item\(\)"),
    "tolist": (lambda x, w: torch.tensor(x.tolist()), UnsupportedOperationError, "ask for the number"),
    "math.sin": (lambda x, w: x * math.sin(x[0]), UnsupportedOperationError, r"math\.\*"),
    "np.sin": (lambda x, w: torch.as_tensor(np.sin(x)), UnsupportedOperationError, "numpy operation 'sin'"),
    "np.clip": (lambda x, w: torch.as_tensor(np.clip(x, -1, 1)), UnsupportedOperationError, "(numpy|test_reach)"),
    "numpy()": (lambda x, w: torch.from_numpy(x.numpy() * 2), UnsupportedOperationError, "ask for the number"),
    "np.asarray": (lambda x, w: torch.as_tensor(np.asarray(x) * 2), UnsupportedOperationError, "ask for the number"),
    "torch.tensor": (lambda x, w: torch.tensor([x[0], x[1], x[2]]), UnsupportedOperationError, r"torch.tensor\("),
    "round": (lambda x, w: round(float(x[0])) * x, UnsupportedOperationError, "ask for the number"),
    "builtin max": (lambda x, w: x * max(x[0], 0.1), UnsupportedOperationError, "may not branch"),
    "argmax as an index": (lambda x, w: x * x[torch.argmax(x)], UnsupportedOperationError, "'argmax'"),
    "constant indexed": (lambda x, w: torch.arange(3)[x.long()] * x, UnsupportedOperationError, "int64"),
    "max along a dimension": (lambda x, w: x * x.max(-1, keepdim=True)[0], UnsupportedOperationError, "torch.amax"),
    "rounded to half": (lambda x, w: 0.9 * x.half(), UnsupportedOperationError, "torch.float16: rounding"),
    "bits": (lambda x, w: x.view(torch.int64).view(torch.float64), UnsupportedOperationError, r"'view\(dtype\)'"),
    "plain tensor written": (assigned_into_a_plain_tensor, UnsupportedOperationError, "assignment into a plain tensor"),
    "unwritten": (lambda x, w: torch.empty_like(x) * 0 + x, UsageError, "(never written|NaN|another result)"),
    "dropout": (lambda x, w, net=nn.Dropout(0.5): net(x), UsageError, "another result.*dropout"),
    "random": (lambda x, w: x + 0.01 * torch.randn(3), UsageError, "another result"),
    "python random": (lambda x, w: x * random.random(), UsageError, "another result"),
    "counter": (Counter(), UsageError, "another result.* no counters"),
    "late counter": (LateCounter(), UsageError, "another result|does not always do the same"),
    "state between calls": (Lag(), UsageError, "no state kept between calls"),
    "gradient mode": (grad_mode, UsageError, "another result"),
    "type of its argument": (hidden_branch, UsageError, "differs from what it did when it was recorded"),
    "exact type of its argument": (plain_type, UsageError, "another result on plain float64 tensors"),
    "caught refusal": (caught, UnsupportedOperationError, "may not branch on a value"),
    "caught unsupported operation": (caught_unsupported, UnsupportedOperationError, "'lgamma' has no relaxation"),
    "rows mixed": (batch_mix, UsageError, "mixes the rows of a batch"),
    "two meanings": (two_meanings, UsageError, "batched=False or batched=True"),
    "NaN weight": (nan_network(), NonFiniteError, "NaN"),
    "infinite weight": (infinite_network(), NonFiniteError, r"'linear weight', shape \(2, 3\), is inf at \[1, 2\]"),
    "infinite constant": (lambda x, w: torch.tanh(x * math.inf), NonFiniteError, "'mul'.* is inf"),
    "NaN constant": (lambda x, w: x + torch.tensor([0.0, math.nan, 0.0]), NonFiniteError, "NaN or infinity in state 1"),
    "NaN inside": (lambda x, w: torch.sqrt(x - 9), NonFiniteError, "NaN or infinity in state 0 at x ="),
    "complex": (lambda x, w: (x * torch.tensor(1j)).abs(), UnsupportedOperationError, "complex"),
    "unholdable integer": (
        lambda x, w: x + (2**53 + 1) * 0 + torch.tensor(2**53 + 1),
        UnsupportedOperationError,
        "integers",
    ),
    "wrong shape": (lambda x, w: x[..., :2], UsageError, r"returned shape \(2,\), expected \(3,\)"),
    "tuple": (lambda x, w: (x, w), UsageError, "returned a tuple, expected the next state as a tensor"),
    "None": (lambda x, w: None, UsageError, "returned a NoneType"),
    "numbers": (lambda x, w: x.numpy() * 2, UsageError, "returned a ndarray"),
    "truths": (lambda x, w: torch.ones(3) > 0, UsageError, "torch.bool"),
    "mismatch": (lambda x, w: x + w, UsageError, r"RuntimeError: The size of tensor a \(3\)"),
    "its own error": (lambda x, w: {}["gain"] * x, UsageError, "line .*KeyError: 'gain'"),
    "out=": (lambda x, w: torch.add(x, 1.0, out=torch.zeros(3).double()), UsageError, "out="),
}


@pytest.mark.filterwarnings("ignore:__array_wrap__:DeprecationWarning")
@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_bounded_is_refused_in_one_line_that_names_it(name):
    step, kind, words = WRONG[name]
    if kind is None:
        net, kind, words = step, UnsupportedOperationError, "'layer_norm' has no relaxation"
        step = lambda x, w: net(x)  # noqa: E731
    with pytest.raises(kind, match=words) as caught:
        reach(step, START, DISTURBANCE, K)
    assert isinstance(caught.value, SagempError) and "\n" not in str(caught.value)


def test_without_a_disturbance_the_step_may_take_none():
    class Loop:
        horizon, state_dim = 3, 1

        def step(self, k, x):
            return 0.5 * x

    class Module(nn.Module):
        def forward(self, x):
            return 0.5 * x

    start = Box.around([1.0], [0.5])
    for step in (lambda x: 0.5 * x, lambda x, w: 0.5 * x + w, Loop(), Module(), lambda x, gain=0.5: gain * x):
        tube = reach(step, start, horizon=3)
        assert torch.allclose(tube.upper[:, 0], torch.tensor([1.5, 0.75, 0.375, 0.1875], dtype=torch.float64))


def test_a_tube_for_every_cell_is_given_on_request():
    step = RIGHT["unpacked"]
    tubes = reach(step, START, DISTURBANCE, K, partitions=[2, 1, 2], per_cell=True)
    assert tubes.lower.shape == (4, K + 1, 3)
    whole = reach(step, START, DISTURBANCE, K, partitions=[2, 1, 2])
    assert torch.equal(tubes.hull().lower, whole.lower) and torch.equal(tubes.hull().upper, whole.upper)
    assert torch.allclose((tubes.upper - tubes.lower)[:, 0].prod(-1).sum(), START.width.prod())


def test_cells_are_found_where_they_narrow_the_tube():
    def step(x, w):  # only the first state's spread costs width
        return torch.stack([x[..., 0] * x[..., 0] - 0.9 * x[..., 0] - 0.3, 0.5 * x[..., 1]], -1)

    start = Box.around([0.2, 0.0], [0.4, 0.4])
    found = reach(step, start, horizon=3, partitions="auto", per_cell=True)
    cells = found.upper[:, 0] - found.lower[:, 0]
    assert 2 <= len(cells) <= 64 and bool((cells[:, 1] > 0.79).all()) and bool((cells[:, 0] < 0.5).all())
    one = reach(step, start, horizon=3)
    assert bool((found.hull().width <= one.width + 1e-12).all())
    assert reach(lambda x: 0.5 * x, Box.around([1.0], [0.0]), horizon=2, partitions="auto").horizon == 2


@pytest.mark.parametrize("exponent", [1.5, 2.5, -0.5, -1.5, 1 / 3, 0.1, -0.7])
def test_powers_that_are_not_whole_are_bounded_where_the_base_is_positive(exponent):
    start = Box.around([1.0, 2.0], [0.3, 0.2])
    tube = reach(lambda x: 0.5 * x**exponent + 0.5, start, horizon=2, partitions=4)
    states = [start.sample(500, torch.Generator().manual_seed(1))]
    for _ in range(2):
        states.append(0.5 * states[-1] ** exponent + 0.5)
    states = torch.stack(states, 1)
    assert bool(tube.contains(states).all()) and bool(tube.bounded)
    assert bool((tube.width[1] <= 1.5 * (states[:, 1].amax(0) - states[:, 1].amin(0)) + 0.02).all())


@pytest.mark.parametrize("function", [torch.argmax, torch.argsort, torch.median, lambda x: x.sort()[0], torch.isnan])
def test_what_depends_on_the_order_of_entries_is_told_what_to_use_instead(function):
    with pytest.raises(UnsupportedOperationError, match=r"test_reach\.py, line .*use torch\.(amax|where)") as caught:
        reach(lambda x, w: x + 0.0 * function(x), START, DISTURBANCE, 1)
    assert "relaxation" not in str(caught.value)


READERS = {
    "torch.tensor": lambda x, w: torch.tensor(x) * 0.5,
    "torch.tensor of entries": lambda x, w: torch.tensor([x[0], x[1], x[2]]) * 0.5,
    "torch.Tensor": lambda x, w: torch.Tensor(x) * 0.5,
    "torch.DoubleTensor": lambda x, w: torch.DoubleTensor(x) * 0.5,
    "as_tensor of entries": lambda x, w: torch.as_tensor([x[0], x[1], x[2]]) * 0.5,
    "jacrev": lambda x, w: torch.func.jacrev(torch.sin)(x) @ x,
    "jacfwd": lambda x, w: torch.func.jacfwd(torch.sin)(x) @ x,
    "vmap": lambda x, w: torch.vmap(torch.sin)(x),
    "nested_tensor": lambda x, w: torch.nested.nested_tensor([x, x])[0] * 0.5,
    "set_": lambda x, w: torch.zeros(3, dtype=torch.float64).set_(x) * 0.5,
    "as_subclass": lambda x, w: x.as_subclass(torch.Tensor) * 0.5,
    "_make_subclass": lambda x, w: torch.Tensor._make_subclass(torch.Tensor, x) * 0.5,
    "dlpack": lambda x, w: torch.from_dlpack(torch.utils.dlpack.to_dlpack(x)) * 0.5,
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
def test_what_would_read_the_memory_of_a_value_is_refused(name):
    with pytest.raises(UnsupportedOperationError if name != "dlpack" else NonFiniteError) as caught:
        reach(READERS[name], START, DISTURBANCE, 2, batched=False)
    assert "\n" not in str(caught.value) and "test_reach.py, line" in str(caught.value) or name == "dlpack"


def test_no_function_of_torch_that_is_given_a_value_kills_the_interpreter():
    names = (
        "tensor as_tensor asarray Tensor DoubleTensor FloatTensor from_dlpack frombuffer from_numpy sparse_coo_tensor "
        "scalar_tensor vmap nested set_ is_tensor numel stack where index_put bincount svd"
    )
    script = str(pathlib.Path(__file__).parent / "program" / "fuzzed_functions.py")
    done = subprocess.run(
        [sys.executable, script, "torch", *names.split()], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.stdout.split()[-1:]}: {done.stderr[:500]}"
    assert {"tensor", "asarray", "DoubleTensor"} <= set(done.stdout.split())


def test_a_tensor_that_is_asked_for_as_a_tensor_is_the_value_itself():
    for same in (torch.as_tensor, torch.asarray, torch.nn.Parameter):
        tube = reach(lambda x, w, same=same: 0.5 * same(x) + 0.0 * w[0], START, DISTURBANCE, 1)
        assert torch.allclose(tube.width[1], 0.5 * START.width)


def test_a_step_with_two_meanings_may_say_which_is_meant():
    single = reach(two_meanings, START, DISTURBANCE, 1, batched=False)
    batch = reach(two_meanings, START, DISTURBANCE, 1, batched=True)
    assert torch.allclose(single.width[1], 0.9 * START.width)
    assert batch.width[1, 0].item() < 1e-12 and batch.width[1, 1].item() == pytest.approx(0.5)


POINT = Box.around([0.0], [0.0])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"horizon": 0}, "horizon must be a positive integer, found 0"),
        ({"horizon": 2.5}, "horizon must be a positive integer, found 2.5"),
        ({"horizon": True}, "horizon must be a positive integer, found True"),
        ({"horizon": None}, "horizon must be a positive integer, found None"),
        ({"start": [0.0, 0.1]}, r"start must be a Box, for instance Box.around\(.*found list"),
        ({"start": Box.around([[0.0], [1.0]], [0.1])}, r"start must be one box of shape \(n,\), found shape \(2, 1\)"),
        ({"disturbance": Box(torch.tensor([0.0]), torch.tensor([math.inf]))}, "disturbance box must be finite"),
        ({"propagator": "affin"}, r"propagator must be one of affine, .*found 'affin' \(did you mean 'affine'\?\)"),
        ({"propagator": 3}, "propagator must be a name or a Propagator, found int"),
        ({"partitions": 0}, "partitions must be a positive number of cells"),
        ({"partitions": 4, "start": POINT}, "partitions must be 1 for a start box that is a point"),
        ({"cells_at_once": 0}, "cells_at_once must be a positive integer, found 0"),
        ({"step": 3}, "step must be a function"),
    ],
)
def test_wrong_arguments_are_named(arguments, words):
    good = {"step": lambda x, w: 0.5 * x, "start": Box.around([0.0], [1.0]), "disturbance": POINT, "horizon": 2}
    with pytest.raises(SagempError, match=words) as caught:
        reach(**(good | arguments))
    assert "\n" not in str(caught.value)


def test_a_box_of_negative_width_is_refused():
    with pytest.raises(UsageError, match="negative width in dimension 1"):
        Box(torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0]))


def test_a_propagator_that_lies_is_caught_by_the_rollouts():
    class Liar(Propagator):
        name, rigorous = "liar", True

        def reach(self, loop, start, disturbance, *, watch=False):
            tube = Affine().propagate(loop, start, disturbance)
            return Reach(Tube(tube.lower + 0.4 * tube.width, tube.upper))

    with pytest.raises(SagempError, match="a simulated rollout leaves the tube at step"):
        reach(RIGHT["unbound"], START, DISTURBANCE, K, propagator=Liar())


def test_a_first_call_imports_no_symbolic_mathematics():
    # torch.broadcast_shapes does, and with it some thousand modules: as long as torch itself takes.
    code = (
        "import sys, torch; from sagemp_cli.reachability import reach; from sagemp_cli.sets import Box; "
        "step = lambda x, w: torch.stack([x[0] * torch.sin(x[1]), (x @ torch.ones(2).double()).clamp(-1, w[0] + 1)]); "
        "reach(step, Box.around([0.1, 0.2], [0.1, 0.1]), Box.around([0.0], [0.1]), 2); "
        "sys.exit('sympy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_importing_the_package_stays_light():
    code = "import sys, sagemp_cli.reachability; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
