"""Reachability-aware training: the loss is the tube's, its gradient is right, and following it narrows the tube."""

from __future__ import annotations

import dataclasses
import re

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes import Scene
from sagemp_cli.sets import Box
from sagemp_cli.trackers.training import TrackerTrainingOptions, train_tracker
from sagemp_cli.trackers.tube_loss import TubeLoss


def problem_of(robot, start, disturbance):
    scene = Scene(Box([-9.0] * 2, [9.0] * 2), (), Box([-9.0] * 4, [9.0] * 4))
    return Problem(robot, scene, start, disturbance, 12)


def loss_of(loss, tracker, unicycle, references, start, disturbance, *, share=1.0, seed=0):
    return loss(
        tracker,
        problem_of(unicycle, start, disturbance),
        references=references,
        share=share,
        generator=torch.Generator().manual_seed(seed),
    )


@torch.no_grad()
def tube_of_forms(loop, start, disturbance):
    """The tube that has a gradient, as the loss takes it: no end is one that an interval decides, nothing is boxed."""
    return Affine(symbols=10_000).run(loop, start, disturbance, intervals=False).tube


def test_at_full_size_with_one_cell_it_is_the_log_width_of_the_tube_of_forms(
    unicycle, references, start, disturbance, make_tracker
):
    tracker = make_tracker()
    loss = TubeLoss(weight=0.7, references=1, counts=[1, 1], steps=12, symbols=10_000, scale=0.1, end=2.0)
    value, figures = loss_of(loss, tracker, unicycle, references[:1], start, disturbance)
    width = tube_of_forms(ClosedLoop(unicycle, tracker, references[0]), start, disturbance).width[1:]
    cost = torch.log1p(width / 0.1)
    assert value.item() == pytest.approx(0.7 * (cost.mean() + 2.0 * cost[-1].mean()).item(), rel=1e-9)
    assert figures["size"] == 1.0 and figures["width"] == pytest.approx(width[-1].mean().item(), rel=1e-9)


def test_the_sets_grow_from_their_share_to_full_size(unicycle, references, start, disturbance, make_tracker):
    loss = TubeLoss(references=1, counts=[1, 1], steps=4, shrink=0.2)
    found = [
        loss_of(loss, make_tracker(), unicycle, references, start, disturbance, share=share)
        for share in (0.0, 0.35, 0.7, 1.0)
    ]
    assert [figures["size"] for _, figures in found] == pytest.approx([0.2, 0.6, 1.0, 1.0])
    assert found[0][0] < found[1][0] < found[2][0]


def test_a_finer_partition_has_smaller_cells(unicycle, references, start, disturbance, make_tracker):
    whole, quarter = (
        loss_of(
            TubeLoss(references=1, counts=[c, c], steps=4), make_tracker(), unicycle, references, start, disturbance
        )[0]
        for c in (1, 2)
    )
    assert quarter < whole


def test_the_partition_is_that_of_the_states_that_are_uncertain(unicycle, references, disturbance, make_tracker):
    start = Box.around(references[0, 0], [0.0, 0.2, 0.0, 0.0])
    whole, tenth = (
        loss_of(TubeLoss(references=1, counts=[c], steps=2), make_tracker(), unicycle, references, start, disturbance)[
            0
        ]
        for c in (1, 10)
    )
    assert tenth < 0.9 * whole


def test_the_gradient_agrees_with_finite_differences(unicycle, references, start, disturbance, make_tracker):
    tracker = make_tracker(2)
    loss = TubeLoss(references=2, counts=[1, 1], steps=6)
    weight = tracker.layers[-1].weight
    loss_of(loss, tracker, unicycle, references, start, disturbance)[0].backward()
    direction, h = torch.sign(weight.grad), 1e-6
    slope = []
    for sign in (1, -1):
        with torch.no_grad():
            weight += sign * h * direction
            slope.append(loss_of(loss, tracker, unicycle, references, start, disturbance)[0].item())
            weight -= sign * h * direction
    # The ratio by which a product's factors are scaled is a constant to autograd; the error of that is of second order.
    assert (weight.grad * direction).sum().item() == pytest.approx((slope[0] - slope[1]) / (2 * h), rel=0.02)


def test_training_with_it_narrows_the_tube(unicycle, references, start, disturbance, make_tracker):
    plain = TrackerTrainingOptions(learning_rate=0.03, steps=20, batch=8, rollout_steps=12, tube_steps=20)
    problem = problem_of(unicycle, start, disturbance)
    widths = []
    for tube in (None, TubeLoss(weight=1.0, references=2, counts=[1, 1], steps=12, shrink=1.0)):
        tracker = make_tracker()
        options, generator = dataclasses.replace(plain, tube=tube), torch.Generator().manual_seed(0)
        train_tracker(tracker, problem, options, references=references, generator=generator)
        tube_ = Affine().propagate(ClosedLoop(unicycle, tracker, references[0]), start, disturbance)
        widths.append(tube_.width[-1].mean().item())
    assert widths[1] < 0.9 * widths[0]


def test_an_exploding_tube_has_a_finite_loss_and_gradient(unicycle, references, start, disturbance, make_tracker):
    tracker = make_tracker(control_scale=[1e4, 1e4])
    value, figures = loss_of(TubeLoss(references=1, counts=[1, 1]), tracker, unicycle, references, start, disturbance)
    value.backward()
    assert torch.isfinite(value) and figures["width"] == 1e6
    assert all(bool(torch.isfinite(p.grad).all()) for p in tracker.parameters())
    assert any(bool((p.grad != 0).any()) for p in tracker.parameters()), "the steps before it exploded still teach"


@pytest.mark.parametrize("gain", [1e3, 1e4])
def test_a_tube_counts_as_it_is_until_it_explodes_and_as_the_widest_from_there(
    gain, unicycle, references, start, disturbance, make_tracker
):
    tracker = make_tracker(control_scale=[gain, gain])
    loss = TubeLoss(weight=1.0, references=1, counts=[1, 1], steps=12, symbols=10_000, scale=0.1, end=0.5)
    value, _ = loss_of(loss, tracker, unicycle, references[:1], start, disturbance)
    width = tube_of_forms(ClosedLoop(unicycle, tracker, references[0]), start, disturbance).width[1:]
    exploded = (~(width <= 1e6)).any(-1).cumsum(0) > 0
    assert 0 < int(exploded.sum()) < 12
    width[exploded] = 1e6
    cost = torch.log1p(width / 0.1)
    assert value.item() == pytest.approx((cost.mean() + 0.5 * cost[-1].mean()).item(), rel=1e-5)
    # The same where only the last step has exploded.
    first = int(exploded.nonzero()[0]) + 1
    cut = loss_of(dataclasses.replace(loss, steps=first), tracker, unicycle, references[:1], start, disturbance)[0]
    assert cut.item() == pytest.approx((cost[:first].mean() + 0.5 * cost[first - 1].mean()).item(), rel=1e-5)


def test_a_wrong_share_is_refused():
    with pytest.raises(ConfigError, match=re.escape("tracker_training.tube.shrink must lie in (0, 1], found 0")):
        TubeLoss(shrink=0)
