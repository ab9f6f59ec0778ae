"""What holds for every generative planner: plans, starts, conditions, training."""

import json
import math

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import ConfigError, NonFiniteError, UsageError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.planners import Diffusion, FlowMatching, Planner, PlannerTrainingOptions, Proposer, train_planner
from sagemp_cli.planners.generative import FADE
from sagemp_cli.problem import Problem
from sagemp_cli.sets import Box

KINDS = {
    "flow matching": (FlowMatching, {"method": "midpoint", "integration_steps": 4}),
    "ddim": (Diffusion, {"levels": 20, "denoising_steps": 5, "eta": 0.5}),
    "ddpm": (Diffusion, {"levels": 10, "denoising_steps": 5, "sampler": "ddpm"}),
}
POSITION, HORIZON = (0, 1), 40


def planner(name, **changes):
    kind, options = KINDS[name]
    return kind(**({"state_dim": 4, "horizon": HORIZON, "knots": 9, "width": 8} | options | changes))


@pytest.fixture(params=list(KINDS))
def name(request):
    return request.param


@pytest.fixture
def made(name, demonstrations, scene):
    found = planner(name)
    found.prepare(demonstrations, goal=scene.goal, generator=torch.Generator().manual_seed(0))
    return found.eval()


def sample(made, start, scene, count, *, seed=0, goal=None, how="sample"):
    drawn = torch.Generator().manual_seed(seed)
    return getattr(made, how)(start, goal or scene.goal, scene=scene, count=count, generator=drawn)


def test_references_begin_at_the_start_to_the_last_bit(made, scene):
    starts = torch.tensor([[0.1, 1 / 3, 0.0, 2.0], [-0.2, math.pi / 7, 0.1, 2.0]], dtype=torch.float64)
    references = sample(made, starts, scene, 2)
    assert references.dtype == torch.float64 and references.shape == (2, HORIZON + 1, 4)
    assert torch.equal(references[:, 0], starts)
    shared = sample(made, starts[1], scene, 3)
    assert torch.equal(shared[:, 0], starts[1].expand(3, 4))
    assert isinstance(made, Planner) and isinstance(made, Proposer)


def test_a_reference_is_its_proposal_moved_smoothly_onto_the_start(made, scene):
    start = torch.tensor([0.1, 0.3, 0.0, 2.0], dtype=torch.float64)
    moved = sample(made, start, scene, 5) - sample(made, start, scene, 5, how="propose")
    missed = moved[:, :1]
    assert missed.abs().min() > 0
    faded = round(FADE * HORIZON)
    assert moved[:, faded:].abs().max() < 1e-12
    share = (moved / missed)[:, : faded + 1]
    assert torch.allclose(share, share[:1, :, :1].expand_as(share), atol=1e-9)
    assert bool((share.diff(dim=1) < 0).all()) and torch.allclose(share[:, faded // 2], torch.tensor(0.5).double())
    assert share[:, 1].min() > 0.97 and share[:, faded - 1].max() < 0.03  # it sets in and ends gently


def test_samples_follow_from_the_generator_alone(made, scene):
    start = torch.tensor([0.0, 0.1, 0.0, 2.0], dtype=torch.float64)
    first = sample(made, start, scene, 4, seed=1)
    assert torch.equal(first, sample(made, start, scene, 4, seed=1))
    assert not torch.equal(first, sample(made, start, scene, 4, seed=2))
    assert (first[0] - first[1]).abs().max() > 1e-3


def test_a_planner_is_rebuilt_from_its_arguments_and_weights(made, scene):
    other = type(made)(**json.loads(json.dumps(made.arguments))).eval()
    other.load_state_dict(made.state_dict())
    start = torch.tensor([0.0, 0.1, 0.0, 2.0], dtype=torch.float64)
    assert torch.equal(sample(made, start, scene, 3), sample(other, start, scene, 3))


def test_start_and_goal_are_conditions_and_unbounded_states_of_the_goal_are_none(made, scene, demonstrations):
    start = demonstrations[0, 0]
    here = sample(made, start, scene, 2, how="propose")
    assert not torch.equal(here, sample(made, start + 0.1, scene, 2, how="propose"))
    there = Box.around((scene.goal.center + torch.tensor([0.5, 0.0, 0.0, 0.0])).tolist(), [0.4, 0.4, 0.5, 0.5])
    assert not torch.equal(here, sample(made, start, scene, 2, how="propose", goal=there))
    infinite = torch.tensor([0.4, 0.4, math.inf, math.inf], dtype=torch.float64)
    center = torch.tensor([8.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    free = Box(center - infinite, center + infinite)
    made.prepare(demonstrations, goal=free, generator=torch.Generator().manual_seed(0))
    goals = demonstrations[:2, -1]
    before, after = (
        made.conditions(demonstrations[:2, 0], g) for g in (goals, goals + torch.tensor([0.0, 0.0, 9.0, 9.0]))
    )
    assert torch.equal(before.vector, after.vector) and torch.equal(before.line, after.line)
    assert bool(torch.isfinite(sample(made, start, scene, 2, goal=free)).all())


def test_the_line_leads_from_start_to_goal(made, demonstrations):
    conditions = made.conditions(demonstrations[:3, 0], demonstrations[:3, -1])
    ends = made.normalizer.denormalize(conditions.line[:, [0, -1]].double())
    assert torch.allclose(ends, demonstrations[:3][:, [0, -1]], atol=1e-5)


def test_an_overflow_is_reported(made, scene):
    with torch.no_grad():
        made.network.leave[-1].bias.fill_(float("inf"))
    with pytest.raises(NonFiniteError, match="sampled reference contains NaN or infinity"):
        sample(made, torch.zeros(4), scene, 1)


def test_wrong_starts_are_named(made, scene):
    with pytest.raises(UsageError, match=r"start must have shape \(4,\) or \(3, 4\) for 3 references, found \(2, 4\)"):
        sample(made, torch.zeros(2, 4), scene, 3)


def problem_in(scene):
    limits = {"control_lower": [-9.0] * 2, "control_upper": [9.0] * 2}
    robot = Unicycle(dt=0.1, state_lower=[-9.0] * 4, state_upper=[9.0] * 4, **limits)
    return Problem(robot, scene, Box.around([0.0] * 4, [0.1] * 4), Box.around([0.0] * 4, [0.0] * 4), HORIZON)


def train(made, demonstrations, held_out, scene, **changes):
    about = {"generator": torch.Generator().manual_seed(0), "resumable": changes.pop("resumable", None)}
    options = PlannerTrainingOptions(**({"steps": 8} | changes))
    problem = problem_in(scene)
    return train_planner(made, demonstrations, held_out=held_out, problem=problem, options=options, **about)


def test_an_interrupted_training_resumes_to_the_same_planner(name, demonstrations, held_out, scene, tmp_path):
    whole, resumed = planner(name), planner(name)
    train(whole, demonstrations, held_out, scene)

    class Interrupted(KINDS[name][0].loss_type):
        def __call__(self, module, step, generator):
            value = super().__call__(module, step, generator)
            if step == 6 and module.training:
                raise KeyboardInterrupt
            return value

    class Impatient(KINDS[name][0]):
        loss_type = Interrupted

    checkpoint = tmp_path / "planner.h5"
    with pytest.raises(KeyboardInterrupt):
        train(Impatient(**resumed.arguments), demonstrations, held_out, scene, resumable=Resumable(checkpoint))
    train(resumed, demonstrations, held_out, scene, resumable=Resumable(checkpoint))
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", ["flow matching", "ddim"])
def test_both_sides_are_learned_from_demonstrations_that_take_either(name, two_sided, held_out, scene):
    made = planner(name, width=16, knots=12)
    options = {"steps": 250, "learning_rate": 4e-3, "ema_decay": 0.98, "loss": {"batch_size": 64}}
    history = train(made, two_sided, two_sided[:20], scene, **options)
    figures = {key: values[-1] for key, values in history.validation.items()}
    assert figures["held-out loss"] < 0.5 * history.validation["held-out loss"][0]
    assert 0.25 < figures["share L"] < 0.75 and figures["share L"] + figures["share R"] == pytest.approx(1)
    assert figures["collision-free"] > 0.8 and figures["in goal"] > 0.8
    assert figures["start error"] < 0.2 and figures["roughness"] < 2.5
    start = torch.tensor([-0.1, 0.6, -0.15, 2.2], dtype=torch.float64)
    middle = sample(made, start, scene, 40)[:, HORIZON // 2, 1]
    assert bool((middle > 1).any()) and bool((middle < -1).any())  # from one and the same start


@pytest.mark.parametrize(
    ("name", "changes", "text"),
    [
        ("flow matching", {"method": "adams"}, r"method must be one of \('euler', .*\), found 'adams'"),
        ("flow matching", {"integration_steps": 0}, "integration_steps must be positive, found 0"),
        ("flow matching", {"horizon": 0}, "state_dim and horizon must be positive, found 4 and 0"),
        ("ddim", {"prediction": "x"}, r"prediction must be one of \('knots', 'v', 'epsilon'\), found 'x'"),
        ("ddim", {"sampler": "dpm"}, r"sampler must be one of \('ddim', 'ddpm'\), found 'dpm'"),
        ("ddim", {"denoising_steps": 21}, "denoising_steps must lie between 1 and levels, found 21 and 20"),
        ("ddim", {"eta": 1.5}, r"eta must lie in \[0, 1\], found 1.5"),
        ("ddim", {"knots": 3}, r"knots must lie between 4 and horizon \+ 1 = 41, found 3"),
    ],
)
def test_wrong_options_are_one_line(name, changes, text):
    with pytest.raises(ConfigError, match=text) as caught:
        planner(name, **changes)
    assert "\n" not in str(caught.value)


def test_a_wrong_batch_size_is_named(made, demonstrations):
    with pytest.raises(ConfigError, match="batch_size must be positive, found 0"):
        made.loss_type(made, demonstrations, steps=10, batch_size=0)
