"""States that a file leaves out, against robots that drove them."""

import numpy as np
import pytest
import torch

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.planar_quadrotor import PlanarQuadrotor
from sagemp_cli.dynamics.quadrotor import Quadrotor
from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ArtifactError
from sagemp_cli.planners.completion import complete

DT = 0.05
WIDE = {"state_lower": -100.0, "state_upper": 100.0, "control_lower": -100.0, "control_upper": 100.0}


class Charged(Dynamics):
    """A robot of somebody else, with a state that nothing says anything about."""

    state_names = ("px", "py", "vx", "charge")
    control_names = ("ax",)
    position = (0, 1)
    rates = {"vx": "px"}


def robot(kind):
    n, m = len(kind.state_names), len(kind.control_names)
    return kind(dt=DT, **{key: [value] * (n if key.startswith("state") else m) for key, value in WIDE.items()})


def driven(kind, start, controls):
    """States ``(K+1, n)`` of a robot under controls ``(K, m)``."""
    model, x = robot(kind), torch.tensor(start, dtype=torch.float64)
    states = [x]
    for u in torch.tensor(controls, dtype=torch.float64):
        x = model.step(x, u, torch.zeros_like(x))
        states.append(x)
    return torch.stack(states).numpy()


def completed(states, kind, *given):
    values = {name: states[:, kind.state_names.index(name)] for name in given}
    return complete(values, robot(kind), where="plan.csv: trajectory")


def test_heading_and_speed_of_a_unicycle_are_those_that_it_had():
    """Forward differences undo the Euler step; only the last row is not seen. The heading turns twice around."""
    controls = np.stack([np.full(100, 3.0), np.linspace(-0.5, 0.5, 100)], axis=1)
    states = driven(Unicycle, [0.0, 0.0, 0.5, 2.0], controls)
    found, notes = completed(states, Unicycle, "px", "py")
    np.testing.assert_allclose(found[:-1], states[:-1], atol=1e-9)
    assert found[-2, 2] - found[0, 2] > 4 * np.pi
    assert notes == ["v: speed of the position's differences", "theta: direction of the position's differences"]


def test_a_robot_that_stands_still_keeps_its_heading():
    places = {"px": np.array([0.0, 0.0, 0.0, 0.0, 0.0]), "py": np.array([0.0, 0.0, 1.0, 1.0, 1.0])}
    found, _ = complete(places, robot(Unicycle), where="")
    np.testing.assert_allclose(found[:, 2], np.pi / 2)
    np.testing.assert_allclose(found[:, 3], [0, 1 / DT, 0, 0, 0])
    still, _ = complete({"px": np.ones(3), "py": np.ones(3)}, robot(Unicycle), where="")
    np.testing.assert_array_equal(still[:, 2:], 0)


def test_tilt_and_rates_of_a_planar_quadrotor_are_those_that_it_had():
    controls = np.stack([np.full(40, 5.0), 0.02 * np.sin(np.arange(40) / 4)], axis=1)
    states = driven(PlanarQuadrotor, [0.0, 1.0, 0.1, 0.3, 0.0, 0.0], controls)
    found, notes = completed(states, PlanarQuadrotor, "px", "pz")
    np.testing.assert_allclose(found[:-3], states[:-3], atol=1e-8)
    assert [note.partition(":")[0] for note in notes] == ["vx", "vz", "phi", "omega"]


def test_attitude_and_rates_of_a_quadrotor_are_those_that_it_had_while_tilts_are_small():
    k, model = np.arange(40), robot(Quadrotor)
    thrust = np.full(40, 9.81 * model.mass)
    torques = 0.03 * np.array([np.sin(k / 5), np.cos(k / 5), np.zeros(40)])
    states = driven(Quadrotor, [0.0] * 12, np.stack([thrust, *torques], axis=1))
    assert 0.02 < np.abs(states[:, 3:6]).max() < 0.2
    found, notes = completed(states, Quadrotor, "px", "py", "pz")
    np.testing.assert_allclose(found[:-3, :9], states[:-3, :9], atol=1e-3)
    np.testing.assert_allclose(found[:-3, 9:], states[:-3, 9:], atol=1e-3)
    assert "psi: taken as 0" in notes


def test_given_states_are_not_touched():
    states = np.random.default_rng(0).normal(size=(6, 4))
    found, notes = completed(states, Unicycle, *Unicycle.state_names)
    np.testing.assert_array_equal(found, states)
    assert notes == []


def test_what_cannot_be_filled_in_is_named():
    with pytest.raises(ArtifactError, match="^plan.csv: trajectory has no py; positions cannot be filled in"):
        completed(np.zeros((5, 4)), Unicycle, "px", "theta")
    with pytest.raises(ArtifactError, match="has no charge, and there is no rule to fill it in"):
        complete({"px": np.zeros(3), "py": np.zeros(3)}, robot(Charged), where="plan.csv")


def test_a_robot_of_somebody_else_says_itself_what_is_the_rate_of_what():
    given = {"px": np.array([0.0, 1.0, 3.0]), "py": np.zeros(3), "charge": np.ones(3)}
    found, notes = complete(given, robot(Charged), where="")
    np.testing.assert_allclose(found[:, 2], [1 / DT, 2 / DT, 2 / DT])
    assert notes == ["vx: differences of px"]
