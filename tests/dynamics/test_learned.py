"""A learned robot: the network is the derivative, all else is the analytical model's."""

import copy

import pytest
import torch

from sagemp_cli.config.binding import build
from sagemp_cli.config.composition import compose, options_of
from sagemp_cli.dynamics import Unicycle
from sagemp_cli.dynamics.learned import ACTIVATIONS
from sagemp_cli.errors import ConfigError

LEARNED = [name for name in options_of("dynamics") if name.endswith("_learned")]


@pytest.fixture
def section(learned_unicycle):
    return copy.deepcopy(learned_unicycle.__defaults__[0])


def points(count=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, d, dtype=torch.float64, generator=g) - 1 for d in (4, 2, 4))


@pytest.mark.parametrize("name", LEARNED)
def test_every_learned_option_is_the_counterpart_of_an_analytical_one(name):
    robot = build(compose([f"dynamics={name}"])["dynamics"], "dynamics")
    model = build(compose([f"dynamics={name.removesuffix('_learned')}"])["dynamics"], "dynamics")
    assert type(robot.analytical) is type(model) and robot.state_names == model.state_names
    assert [layer.out_features for layer in robot.layers] == [64, 64, 64, robot.state_dim]
    assert not set(robot.reads) & set(robot.position)


def test_names_limits_step_and_reading_of_w_are_those_of_the_model(section):
    section["model"]["disturbance"] = "state"
    robot = build(section, "dynamics")
    assert isinstance(robot.analytical, Unicycle) and Unicycle.analytical.fget(robot.model) is robot.model
    assert (robot.state_names, robot.control_units, robot.position) == (
        Unicycle.state_names, Unicycle.control_units, Unicycle.position)  # fmt: skip
    assert (robot.dt, robot.disturbance, robot.state_dim, robot.control_dim) == (0.1, "state", 4, 2)
    assert torch.equal(robot.control_upper, robot.model.control_upper)


def test_the_derivative_is_the_network_written_out(learned_unicycle):
    robot = learned_unicycle(scale=0.3, drift=0.25)
    x, u, _ = points()
    z = torch.cat([x[:, 2:], u], dim=1)
    hidden = torch.tanh(torch.tanh(0.3 * z)) / 0.3
    expected = hidden[:, [1, 0, 2, 3]]
    expected[:, 0] += 0.25
    torch.testing.assert_close(robot.derivative(x, u), expected, rtol=1e-14, atol=1e-14)


def test_without_weights_every_derivative_is_nan_and_only_the_layers_are_stored(section):
    robot = build(section, "dynamics")
    x, u, _ = points(3)
    assert robot.derivative(x, u).isnan().all()
    assert set(robot.state_dict()) == {f"layers.{i}.{name}" for i in range(3) for name in ("weight", "bias")}


@pytest.mark.parametrize("reading", ["derivative", "state"])
def test_the_deviation_is_what_w_must_change_by_to_make_the_models_step(section, learned_unicycle, reading):
    section["model"]["disturbance"] = reading
    robot = learned_unicycle(section, drift=0.1)
    x, u, w = points()
    predicted, deviation = robot.compared(x, u)
    assert torch.equal(predicted, robot.derivative(x, u))
    assert (deviation.abs() > 1e-3).any()
    torch.testing.assert_close(robot.step(x, u, w + deviation), robot.analytical.step(x, u, w), rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(robot.advance(x, predicted, w), robot.step(x, u, w), rtol=0, atol=0)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_its_step_is_enclosed_with_every_activation(section, activation):
    from sagemp_cli.reachability.affine.affine import Affine
    from sagemp_cli.sets import Box

    robot = build(section | {"activation": activation}, "dynamics")
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in robot.parameters():
            parameter.copy_(torch.randn(parameter.shape, dtype=torch.float64, generator=g))

    class Loop:
        horizon, state_dim = 1, 4

        def step(self, k, x, w):
            return robot.step(x, x[..., :2], w)

    start, w = Box.around([0.0] * 4, [0.5] * 4), Box.around([0.0] * 4, [0.1] * 4)
    tube = Affine().propagate(Loop(), start, w)
    after = Loop().step(0, start.sample(2000, g), w.sample(2000, g))
    assert (after >= tube.lower[1]).all() and (after <= tube.upper[1]).all()
    assert (tube.width[1] < 40 * (after.amax(0) - after.amin(0))).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": ["thta"]}, r"dynamics.inputs: there is no state 'thta' \(did you mean 'theta'\?\)"),
        ({"hidden": []}, r"dynamics.hidden must be a non-empty list of whole numbers of at least 1, found \[\]"),
        (
            {"activation": "tan"},
            r"dynamics.activation must be one of leaky_relu, .*, found 'tan' \(did you mean 'tanh'",
        ),
        (
            {"model": {"name": "mlp"}},
            "dynamics.model.name 'mlp': no such robot",
        ),
        ({"model": 3}, "dynamics.model must be a section with a name, found 3"),
    ],
)
def test_a_wrong_section_is_one_line(section, change, message):
    with pytest.raises(ConfigError, match=message) as caught:
        build(section | change, "dynamics")
    assert "\n" not in str(caught.value)


def test_a_learned_model_cannot_be_learned_from(section):
    with pytest.raises(ConfigError, match="must be an analytical robot model, found Learned"):
        build(section | {"model": copy.deepcopy(section)}, "dynamics")
