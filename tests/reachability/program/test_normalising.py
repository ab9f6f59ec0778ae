"""Softmax and its kin, and layers that normalise: programs that do what torch does, in their range whatever the set."""

import math

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from sagemp_cli.errors import UnsupportedOperationError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.sets import Box

ZERO = torch.zeros(1, dtype=torch.float64)


def drawn(module):
    """With statistics and weights that are not those of the beginning."""
    generator = torch.Generator().manual_seed(1)
    for tensor in [*module.parameters(), *module.buffers()]:
        if tensor.is_floating_point():
            tensor.data = 0.5 + torch.rand(tensor.shape, dtype=torch.float64, generator=generator)
    return module.requires_grad_(False).eval()


NORMS = {
    "layer": (drawn(nn.LayerNorm(4)), (4,)),
    "layer of two dimensions": (drawn(nn.LayerNorm((2, 3))), (2, 3)),
    "layer of rows": (drawn(nn.LayerNorm(3, elementwise_affine=False)), (2, 3)),
    "root mean square": (drawn(nn.RMSNorm(4, eps=1e-3)), (4,)),
    "groups": (drawn(nn.GroupNorm(2, 4)), (1, 4, 3)),
    "batch": (drawn(nn.BatchNorm1d(4)), (1, 4)),
    "batch of channels": (drawn(nn.BatchNorm1d(2)), (1, 2, 3)),
}
SHARES = {
    **{f"softmax of {n}": (lambda x: torch.softmax(x, -1), (n,)) for n in (1, 2, 3, 4, 5, 7, 8, 13)},
    "softmax of columns": (lambda x: torch.softmax(x, 0), (3, 2)),
    "softmax without a dimension": (lambda x: F.softmax(x, dim=1), (2, 3)),
    "log_softmax": (lambda x: F.log_softmax(x, -1), (5,)),
    "softmin": (lambda x: F.softmin(x, dim=-1), (5,)),
    "logsumexp": (lambda x: torch.logsumexp(x, -1), (5,)),
    "logsumexp of all": (lambda x: torch.logsumexp(x, (0, 1), keepdim=True), (2, 3)),
    "logaddexp": (lambda x: torch.logaddexp(x, x.flip(-1)), (4,)),
}
CALLS = NORMS | SHARES


@pytest.mark.parametrize("name", CALLS)
def test_a_program_does_what_torch_does(name):
    call, shape = CALLS[name]
    x = 3 * torch.randn(60, math.prod(shape), dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def step(x, w):
        return torch.zeros_like(x), call(x.reshape(shape)).reshape(-1)

    rows = torch.stack([step(row, None)[1] for row in x])
    torch.testing.assert_close(record(step, x[0], ZERO).run(x, ZERO).control, rows, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("propagator", ["interval", "affine", "crown"])
def test_a_softmax_is_exact_over_a_box_and_its_entries_stay_shares(propagator):
    low, high = torch.tensor([-1.0, 0.0, -300.0]).double(), torch.tensor([2.0, 0.5, 900.0]).double()
    tube = reach(lambda x, w: torch.softmax(x, -1), Box(low, high), horizon=1, propagator=propagator)
    for i in range(3):
        ends = [torch.where(torch.arange(3) == i, a, b) for a, b in ((low, high), (high, low))]
        least, most = (torch.softmax(end, -1)[i] for end in ends)
        assert tube.lower[1, i].item() == pytest.approx(least.item(), abs=1e-12)
        assert tube.upper[1, i].item() == pytest.approx(most.item(), abs=1e-12)
    assert bool((tube.lower[1] >= 0).all()) and bool((tube.upper[1] <= 1 + 1e-12).all())


@pytest.mark.parametrize("call", [lambda x: torch.logsumexp(x, -1, keepdim=True), lambda x: F.log_softmax(x, -1)])
def test_logarithms_of_sums_are_bounded_however_wide_the_set_is(call):
    tube = reach(lambda x, w: 0 * x + call(x), Box.around([0.0] * 4, [2000.0] * 4), horizon=1)
    assert bool((tube.lower[1].abs() <= 4002).all()) and bool((tube.upper[1].abs() <= 4002).all())


@pytest.mark.parametrize("propagator", ["interval", "affine", "crown"])
def test_a_layer_that_is_normalised_stays_within_the_root_of_its_size(propagator):
    tube = reach(
        lambda x, w: F.layer_norm(x, (4,)),
        Box.around([0.0, 1.0, 2.0, 3.0], [9.0] * 4),
        horizon=1,
        propagator=propagator,
    )
    assert bool((tube.upper[1] <= math.sqrt(3) + 1e-12).all()) and bool((tube.lower[1] >= -math.sqrt(3) - 1e-12).all())


def test_batch_norm_in_evaluation_mode_is_linear_and_in_training_mode_refused():
    module = NORMS["batch"][0]
    program = record(lambda x, w: module(x[None])[0], torch.zeros(4).double(), ZERO)
    assert not set(program.kinds) & {"sqrt", "product", "clamp"}
    with pytest.raises(UnsupportedOperationError, match=r"batch_norm .* call \.eval\(\)"):
        record(
            lambda x, w: F.batch_norm(x[None].repeat(2, 1), None, None, training=True)[0], torch.zeros(4).double(), ZERO
        )


def test_a_controller_with_attention_to_goals_keeps_a_loop_bounded():
    """Weights between goals that depend on the state, and a normalised hidden layer: rollouts stay inside."""
    generator = torch.Generator().manual_seed(3)
    goals = torch.randn(5, 2, dtype=torch.float64, generator=generator)
    norm = NORMS["layer"][0]
    first = torch.randn(4, 2, dtype=torch.float64, generator=generator)

    class Loop:
        horizon, state_dim = 10, 2

        def step(self, k, x, w):
            share = torch.softmax(-(x[..., None, :] - goals).square().sum(-1), -1)
            hidden = F.gelu(norm(x @ first.T + 1.0))
            return 0.8 * x + 0.2 * share @ goals + 0.01 * hidden @ first + w

    start, w = Box.around([0.3, -0.4], [0.2, 0.2]), Box.around([0.0, 0.0], [0.01, 0.01])
    tube = Affine().propagate(Loop(), start, w)
    assert bool((tube.width[-1] < 3.0).all())
    states = [start.sample(300, generator)]
    for k in range(10):
        states.append(Loop().step(k, states[-1], w.sample(300, generator)))
    inside = torch.stack(states, 1)
    assert bool(((tube.lower - 1e-12 <= inside) & (inside <= tube.upper + 1e-12)).all())


@pytest.mark.parametrize(
    "layer",
    [
        lambda x: F.layer_norm(x, (2,), eps=-1e-3),
        lambda x: F.group_norm(x[None], 1, eps=-1e-3)[0],
        lambda x: F.rms_norm(x, (2,), eps=-1e-3),
    ],
    ids=["layer_norm", "group_norm", "rms_norm"],
)
def test_a_layer_whose_values_have_no_limit_is_refused(layer):
    with pytest.raises(UnsupportedOperationError, match="needs an eps of at least 0, found -0.001"):
        reach(lambda x, w: layer(x), Box([0.5, 1.0], [0.6, 1.1]), horizon=1)
