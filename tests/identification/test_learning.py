"""Learning a robot model: what is learned from, what comes out, and what its enclosures cost."""

import copy

import numpy as np
import pytest
import torch

from sagemp_cli.config.binding import build
from sagemp_cli.errors import ConfigError
from sagemp_cli.identification import DynamicsTrainingOptions, EnclosureWeight, Transitions, domain_of, learn_dynamics
from sagemp_cli.identification.enclosure_loss import enclosure_error
from sagemp_cli.learning.checkpoint import Resumable

SHORT = {"transitions": 2000, "held_out": 500, "steps": 150, "batch": 128, "learning_rate": 1e-2, "ema_decay": 0.9}


@pytest.fixture
def robot(learned_unicycle):
    section = copy.deepcopy(learned_unicycle.__defaults__[0]) | {"hidden": [16, 16]}
    section["model"] |= {"state_lower": [-9.0, -9.0, -1.0, 0.0], "state_upper": [9.0, 9.0, 1.0, 2.0]}
    section["model"] |= {"control_lower": [-1.0, -1.0], "control_upper": [1.0, 1.0]}
    return build(section, "dynamics")


def learn(robot, seed=0, **options):
    about = {key: options.pop(key) for key in ("resumable", "progress") if key in options}
    wanted = DynamicsTrainingOptions(**(SHORT | options))
    return learn_dynamics(robot, wanted, generator=torch.Generator().manual_seed(seed), **about)


def test_transitions_are_steps_of_the_model_from_its_whole_domain(robot):
    domain = domain_of(robot.analytical, 0.1)
    assert domain.lower.tolist() == pytest.approx([-10.8, -10.8, -1.2, -0.2, -1.2, -1.2])
    data = Transitions.draw(robot.analytical, domain, 4000, torch.Generator().manual_seed(0))
    assert bool(domain.contains(data.inputs).all())
    assert (data.inputs.amin(0) < domain.lower + 0.02 * domain.width).all()
    x, u = data.inputs.split([4, 2], dim=1)
    torch.testing.assert_close(data.increments, robot.analytical.derivative(x, u), rtol=1e-9, atol=1e-9)


def test_learning_predicts_unseen_transitions_and_says_how_well(robot):
    history, errors = learn(robot)
    spread = Transitions.draw(
        robot.analytical, domain_of(robot.analytical), 2000, torch.Generator().manual_seed(1)
    ).increments.std(0)
    assert (errors.rms < 0.5 * spread.numpy()).all() and (errors.largest >= errors.rms).all()
    assert errors.counts.sum(axis=1).tolist() == [500] * 4
    curve = history.validation["theta error"]
    assert curve[-1] < curve[0]
    assert curve[-1] == pytest.approx(errors.rms[2], rel=1e-3)  # what is stored is what was validated, unfolded


def test_the_network_knows_nothing_of_states_that_it_does_not_read(robot):
    learn(robot, steps=5)
    assert (robot.layers[0].weight[:, :2] == 0).all() and (robot.layers[0].weight[:, 2:] != 0).all()
    assert all(layer.weight.dtype == torch.float64 for layer in robot.layers)


def test_the_same_seed_gives_the_same_weights(robot):
    learn(robot, steps=5)
    first = [p.clone() for p in robot.parameters()]
    learn(robot, steps=5)
    assert all(torch.equal(a, b) for a, b in zip(first, robot.parameters(), strict=True))
    learn(robot, seed=1, steps=5)
    assert not torch.equal(first[0], robot.layers[0].weight)


def test_an_interrupted_run_resumes_in_the_same_bits(robot, tmp_path):
    class Stop:
        def __init__(self, after):
            self.after = after

        def task(self, description, total, done=0):
            return self

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return False

        def advance(self, steps=1, note=""):
            self.after -= steps
            if self.after < 0:
                raise KeyboardInterrupt

        def say(self, text):
            pass

    options = {"steps": 60, "batch": 2000, "enclosure": EnclosureWeight(boxes=2)}
    learn(robot, **options)
    whole = [p.clone() for p in robot.parameters()]
    with pytest.raises(KeyboardInterrupt):
        learn(robot, **options, resumable=Resumable(tmp_path / "c.h5"), progress=Stop(0))
    learn(robot, **options, resumable=Resumable(tmp_path / "c.h5"))
    assert all(torch.equal(a, b) for a, b in zip(whole, robot.parameters(), strict=True))


def test_the_enclosure_loss_makes_boxes_cheaper_to_enclose(robot):
    plain, _ = learn(robot, enclosure=EnclosureWeight(weight=0.0))
    taught, _ = learn(robot, enclosure=EnclosureWeight(weight=0.3))
    assert taught.figures["enclosure"][-20:].mean() < 0.7 * plain.figures["enclosure"][-20:].mean()


def test_the_enclosure_error_is_nearly_what_the_propagator_adds():
    from sagemp_cli.reachability.affine.affine import Affine
    from sagemp_cli.sets import Box

    torch.manual_seed(0)
    layers = [torch.nn.Linear(a, b, dtype=torch.float64) for a, b in ((3, 8), (8, 8), (8, 3))]
    center, radius = torch.tensor([0.2, -0.1, 0.4]).double(), torch.tensor([0.3, 0.5, 0.2]).double()
    guess = enclosure_error(layers, "softplus", center, radius)

    class Loop:
        horizon, state_dim = 1, 3

        def step(self, k, x, w):
            for i, layer in enumerate(layers):
                x = layer(torch.nn.functional.softplus(x) if i else x)
            return x

    start, nothing = Box(center - radius, center + radius), Box(torch.zeros(3).double(), torch.zeros(3).double())
    with torch.no_grad():
        run = Affine().run(Loop(), start, nothing, keep_steps=True)
    added = np.abs(run.steps[0].after.coefficients[0, :, 6:]).sum(-1)  # beyond states and disturbances
    np.testing.assert_allclose(guess.detach().numpy(), added, rtol=0.05)


def test_errors_are_counted_in_bins_that_reach_to_the_largest(robot):
    _, errors = learn(robot, steps=5)
    np.testing.assert_allclose(errors.edges[:, -1], errors.largest)
    np.testing.assert_allclose(errors.edges[:, 0], -errors.largest)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"transitions": 0}, "dynamics_training.transitions must be a positive whole number, found 0"),
        ({"margin": -0.5}, "dynamics_training.margin must not be negative, found -0.5"),
    ],
)
def test_a_wrong_option_is_one_line(robot, option, message):
    with pytest.raises(ConfigError, match=message):
        learn(robot, **option)


def test_a_wrong_enclosure_is_one_line():
    with pytest.raises(ConfigError, match="dynamics_training.enclosure needs weight >= 0"):
        EnclosureWeight(radius=0.0)
