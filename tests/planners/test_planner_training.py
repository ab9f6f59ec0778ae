"""Training planners: the loss, the learned plans, and the figures about them."""

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import ConfigError, NonFiniteError, UsageError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.planners import NeuralODE, PlannerTrainingOptions, train_planner
from sagemp_cli.planners.neural_ode import NeuralODELoss
from sagemp_cli.problem import Problem
from sagemp_cli.sets import Box

POSITION, HORIZON = (0, 1), 40


def planner():
    return NeuralODE(state_dim=4, horizon=HORIZON, dt=0.1, hidden=[32, 32])


def problem_in(scene):
    limits = {"control_lower": [-9.0] * 2, "control_upper": [9.0] * 2}
    robot = Unicycle(dt=0.1, state_lower=[-9.0] * 4, state_upper=[9.0] * 4, **limits)
    return Problem(robot, scene, Box.around([0.0] * 4, [0.1] * 4), Box.around([0.0] * 4, [0.0] * 4), HORIZON)


def train(made, demonstrations, held_out, scene, **changes):
    about = {"generator": torch.Generator().manual_seed(0), "resumable": changes.pop("resumable", None)}
    options = PlannerTrainingOptions(**({"steps": 400} | changes))
    problem = problem_in(scene)
    return train_planner(made, demonstrations, held_out=held_out, problem=problem, options=options, **about)


@pytest.fixture(scope="module")
def trained(demonstrations, held_out, scene):
    made = planner()
    return made, train(made, demonstrations, held_out, scene)


def test_plans_from_new_starts_keep_clear_and_reach_the_goal(trained):
    figures = {name: values[-1] for name, values in trained[1].validation.items()}
    assert figures["median position error"] < 0.2
    assert figures["collision-free"] >= 0.85
    assert figures["in goal"] >= 0.9
    assert figures["goal error"] < 0.25


def test_the_validation_curve_has_the_loss_on_held_out_demonstrations(trained, demonstrations, held_out, scene):
    course = trained[1].validation["held-out loss"]
    assert course[-1] < 0.1 * course[0]
    known = train(planner(), demonstrations, demonstrations, scene, steps=10).validation["held-out loss"]
    unknown = train(planner(), demonstrations, held_out, scene, steps=10).validation["held-out loss"]
    assert not (known == unknown).any()


def test_the_side_follows_from_the_start(trained, scene):
    starts = torch.tensor([[0.0, 0.7, 0.0, 2.0], [0.0, -0.7, 0.0, 2.0]], dtype=torch.float64)
    starts[:, 2] = torch.atan2(-2 * starts[:, 1], torch.tensor(8.0))
    plans = trained[0].sample(starts, scene.goal, scene=scene, count=2, generator=torch.Generator())
    middle = plans[:, HORIZON // 2, 1]
    assert middle[0] > 1 and middle[1] < -1


def test_both_phases_bring_their_loss_down(trained):
    figures = trained[1].figures
    derivative, trajectory = figures["derivative loss"], figures["trajectory loss"]
    assert derivative[270:280].mean() < 0.1 * derivative[:10].mean()
    assert torch.isnan(torch.from_numpy(trajectory[:280])).all()
    assert trajectory[-10:].mean() < 0.05


def test_training_depends_on_the_generator_alone(demonstrations, held_out, scene):
    first, second = planner(), planner()  # different random weights before
    for made in (first, second):
        train(made, demonstrations, held_out, scene, steps=10)
    for a, b in zip(first.state_dict().values(), second.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_an_interrupted_training_resumes_to_the_same_planner(demonstrations, held_out, scene, tmp_path):
    whole, resumed = planner(), planner()
    train(whole, demonstrations, held_out, scene, steps=12)

    class Interrupted(NeuralODELoss):
        def __call__(self, module, step, generator):
            value = super().__call__(module, step, generator)
            if step == 10:
                raise KeyboardInterrupt
            return value

    class Impatient(NeuralODE):
        loss_type = Interrupted

    with pytest.raises(KeyboardInterrupt):
        half = Impatient(**resumed.arguments)
        train(half, demonstrations, held_out, scene, steps=12, resumable=Resumable(tmp_path / "planner.h5"))
    train(resumed, demonstrations, held_out, scene, steps=12, resumable=Resumable(tmp_path / "planner.h5"))
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_windows_grow_to_the_whole_horizon(demonstrations):
    loss = NeuralODELoss(planner(), demonstrations, steps=100, derivative_share=0.5, first_window=5)
    lengths = [loss.window(step) for step in range(50, 100)]
    assert lengths[0] == 5 and lengths == sorted(lengths)
    assert set(lengths[34:]) == {HORIZON}


def test_the_derivative_target_attracts(demonstrations, scene):
    """On one demonstration the best field in closed form is (z_{k+1} - z_k)/h - pull (z - z_k): its loss is zero."""

    class Ideal(torch.nn.Module):
        def __init__(self, states):
            super().__init__()
            self.states = states

        def forward(self, z, t):
            k = (t * HORIZON).round().long()
            return (self.states[k + 1] - self.states[k]) * HORIZON - 3.0 * (z - self.states[k])

    made = planner()
    made.prepare(demonstrations[:1], goal=scene.goal, generator=torch.Generator().manual_seed(0))
    loss = NeuralODELoss(made, demonstrations[:1], steps=10, derivative_share=1.0, pull=3.0)
    made.field = Ideal(made.normalizer.normalize(demonstrations[0]).float())
    assert float(loss(made, 0, torch.Generator().manual_seed(0))[0]) < 1e-8
    weaker = NeuralODELoss(made, demonstrations[:1], steps=10, derivative_share=1.0, pull=1.0, spread=0.5)
    assert float(weaker(made, 0, torch.Generator().manual_seed(0))[0]) == pytest.approx((2 * 0.5) ** 2, rel=0.1)


def test_wrong_demonstrations_and_options_are_named(demonstrations, held_out, scene):
    with pytest.raises(UsageError, match=r"^demonstrations must have shape \(count, 41, 4\), found \(60, 40, 4\)"):
        train(planner(), demonstrations[:, 1:], held_out, scene)
    with pytest.raises(UsageError, match=r"^held-out demonstrations must have shape .* found \(0, 41, 4\)"):
        train(planner(), demonstrations, held_out[:0], scene)
    broken = demonstrations.clone()
    broken[3, 4, 1] = float("inf")
    with pytest.raises(NonFiniteError, match="^demonstrations contain NaN or infinity"):
        train(planner(), broken, held_out, scene)
    with pytest.raises(ConfigError, match=r"derivative_share must lie in \[0, 1\].* found 1.5, 64"):
        train(planner(), demonstrations, held_out, scene, loss={"derivative_share": 1.5})
