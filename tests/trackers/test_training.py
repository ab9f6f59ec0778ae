"""Training the tracker: what it is trained on, that it learns, and that an interrupted run ends in the same bits."""

from __future__ import annotations

import re

import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Silent
from sagemp_cli.scenes import Scene
from sagemp_cli.sets import Box
from sagemp_cli.trackers.training import RolloutSampler, TrackerTrainingOptions, train_tracker
from sagemp_cli.trackers.tube_loss import TubeLoss


def problem_of(robot, start, disturbance):
    scene = Scene(Box([-9.0] * 2, [9.0] * 2), (), Box([-9.0] * 4, [9.0] * 4))
    return Problem(robot, scene, start, disturbance, 12)


def draw(references, start, disturbance, *, count=64, length=8, seed=0):
    spread = torch.tensor([0.3, 0.2, 0.1, 0.1], dtype=torch.float64)
    sampler = RolloutSampler(references, start, disturbance, spread)
    return sampler.draw(count, length, torch.Generator().manual_seed(seed))


def test_half_of_the_rollouts_start_in_the_start_set_at_step_0(references, start, disturbance):
    drawn, x, _ = draw(references, start, disturbance)
    early = [any(torch.equal(d, r) for r in references) for d in drawn]
    assert sum(early) >= 32 and all(early[:32])
    offset = x[:32] - drawn[:32, 0]
    assert bool(start.contains(start.center + offset).all())
    assert offset[:, :2].abs().amax() > 0.15, "the starts fill the set"


def test_the_other_rollouts_start_near_a_later_step_of_their_reference(references, start, disturbance):
    drawn, x, _ = draw(references, start, disturbance)
    within = 0.5 * start.radius + torch.tensor([0.3, 0.2, 0.1, 0.1])
    for reference, state in zip(drawn[32:], x[32:], strict=True):
        assert bool((references == reference[0]).all(-1).any()), "the first step is one of a reference"
        assert bool(((state - reference[0]).abs() <= within).all())
    shifted = [not any(torch.equal(d[0], r[0]) for r in references) for d in drawn[32:]]
    assert sum(shifted) > 16


def test_a_shifted_reference_is_padded_with_its_last_step(references, start, disturbance):
    drawn, _, _ = draw(references, start, disturbance)
    assert drawn.shape[1:] == references.shape[1:]
    for reference in drawn:
        assert bool((reference[-1] == references[:, -1]).all(-1).any())


def test_disturbances_come_from_the_set_and_every_second_one_is_held_at_a_vertex(references, start, disturbance):
    _, _, w = draw(references, start, disturbance)
    assert w.shape == (64, 8, 4)
    assert bool(disturbance.contains(w).all())
    assert bool((w[1::2] == w[1::2, :1]).all()) and bool((w[1::2].abs() > 0.99 * disturbance.radius)[..., 0].all())
    assert bool((w[::2].std(1)[:, :2] > 0).all()), "the others change from step to step"


def test_the_draw_depends_on_the_generator_alone(references, start, disturbance):
    for a, b in zip(draw(references, start, disturbance), draw(references, start, disturbance), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(draw(references, start, disturbance)[1], draw(references, start, disturbance, seed=1)[1])


def test_the_target_of_a_step_is_the_reference_after_it(unicycle, disturbance, make_tracker):
    """References that the untrained loop follows exactly, from exact starts without disturbance, cost nothing."""
    still = unicycle.state_lower.new_tensor([0.0, 0.0, 0.0, 1.0])
    robot = type(unicycle)(
        dt=unicycle.dt,
        control_lower=[-2.0, -2.0],
        control_upper=[2.0, 2.0],
        state_lower=(still - 1e-9).tolist(),  # the later starts deviate by a share of the limits' range
        state_upper=(still + 1e-9).tolist(),
    )
    states = [still]
    for _ in range(12):
        states.append(robot.step(states[-1], torch.zeros(2), torch.zeros(4)))
    tracker = make_tracker()
    with torch.no_grad():
        for parameter in tracker.layers[-1].parameters():
            parameter.zero_()  # no control, whatever the errors
    history = train_tracker(
        tracker,
        problem_of(robot, Box.around(still, [0.0] * 4), Box.around([0.0] * 4, [0.0] * 4)),
        # Longer rollouts, begun late, would run on where the reference stands.
        TrackerTrainingOptions(steps=1, batch=8, rollout_steps=1),
        references=torch.stack(states).expand(2, 13, 4),
        generator=torch.Generator().manual_seed(0),
    )
    assert history.figures["track"][0] < 1e-15


def tracking_error(tracker, unicycle, references, start):
    with torch.no_grad():
        x = references[:, 0] + start.radius
        states, _ = ClosedLoop(unicycle, tracker, references).rollout(x, torch.zeros(2, 12, 4, dtype=torch.float64))
    return float((states - references)[:, -1].square().sum(-1).mean())


def test_plain_training_lowers_the_loss_and_the_tracking_error(unicycle, references, start, disturbance, make_tracker):
    tracker = make_tracker()
    before = tracking_error(tracker, unicycle, references, start)
    history = train_tracker(
        tracker,
        problem_of(unicycle, start, disturbance),
        TrackerTrainingOptions(steps=50, batch=16, rollout_steps=12, learning_rate=0.03),
        references=references,
        generator=torch.Generator().manual_seed(0),
    )
    assert set(history.figures) == {"track", "state", "control"}
    assert history.figures["track"][-10:].mean() < 0.6 * history.figures["track"][:5].mean()
    assert tracking_error(tracker, unicycle, references, start) < 0.5 * before


class _Interrupt(Silent):
    """Presses Ctrl-C once a number of updates are done."""

    def __init__(self, description: str) -> None:
        self.description = description

    def task(self, description, total, done=0):
        if description == self.description:
            raise KeyboardInterrupt
        return super().task(description, total, done)


def test_an_interrupted_run_ends_in_the_same_bits(unicycle, references, start, disturbance, make_tracker, tmp_path):
    tube = TubeLoss(references=1, counts=[1, 1], steps=4)
    options = TrackerTrainingOptions(steps=4, batch=4, rollout_steps=6, tube=tube, tube_steps=3)

    def run(resumable=None, progress=None):
        tracker = make_tracker()
        try:
            train_tracker(
                tracker,
                problem_of(unicycle, start, disturbance),
                options,
                references=references,
                generator=torch.Generator().manual_seed(0),
                resumable=resumable,
                progress=progress,
            )
        except KeyboardInterrupt:
            return None
        return tracker.state_dict()

    whole = run()
    checkpoint = Resumable(tmp_path / "run.npz")
    assert run(checkpoint, _Interrupt("training the tracker on its tubes")) is None
    resumed = run(checkpoint)
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


def test_rollouts_longer_than_the_reference_are_refused(unicycle, references, start, disturbance, make_tracker):
    with pytest.raises(ConfigError, match=re.escape("tracker_training.rollout_steps must lie in 1..12, found 40")):
        train_tracker(
            make_tracker(),
            problem_of(unicycle, start, disturbance),
            TrackerTrainingOptions(steps=1),
            references=references,
            generator=torch.Generator(),
        )


def test_before_the_loss_rises_with_the_tube_in_it_it_is_said_why(
    unicycle, references, start, disturbance, make_tracker
):
    class Listener(Silent):
        said: list[str] = []

        def say(self, text):
            self.said.append(text)

    problem = problem_of(unicycle, start, disturbance)
    for tube in (None, TubeLoss(references=1, counts=[1, 1], steps=3, shrink=0.25)):
        generator, progress = torch.Generator().manual_seed(0), Listener()
        progress.said = []
        options = TrackerTrainingOptions(steps=1, rollout_steps=4, tube=tube, tube_steps=1)
        train_tracker(make_tracker(), problem, options, references=references, generator=generator, progress=progress)
        why = "the tube's width joins the loss, with sets that grow from 25% of their size to all of it"
        assert [text[: len(why)] for text in progress.said] == ([] if tube is None else [why])
