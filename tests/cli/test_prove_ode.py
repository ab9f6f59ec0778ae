"""``sagemp prove`` of a robot as an ODE: from a file and a network to a verdict about all times."""

import json

import pytest

from sagemp_cli.errors import UsageError
from sagemp_cli.stages.prove_ode import plant_of, prove_ode

ROBOT = """
import torch
from sagemp_cli.scenes.requirements import Inside


class Robot:
    period, horizon = 0.1, 12
    state_names = ("angle", "rate")
    start = ((0.2, 0.3), (-0.1, 0.1))
    requirements = [Inside({"angle": (-0.5, 0.5)})]

    def control(self, x):
        return (-2 * x[..., :1] - x[..., 1:]).clamp(-1.0, 1.0)

    def rate(self, x, u):
        return torch.cat([x[..., 1:], torch.sin(x[..., :1]) - 0.2 * x[..., 1:] + 3 * u], -1)


class Wants(Robot):
    network = "some.onnx"

    def control(self, x, network):
        return network(x)


class Other(Robot):
    period, horizon = 0.1000001, 13
    start = ((0.2, 0.31), (-0.1, 0.1))
    disturbance = ((0.0, 0.0), (-1e-9, 1e-9))
    requirements = [Inside({"angle": (-0.5, 0.49)})]

    def control(self, x):
        return 1.000001 * super().control(x)

    def rate(self, x, u):
        return super().rate(x, u) + 1e-6


class Fails(Robot):
    requirements = [Inside({"speed": (0.0, 1.0)})]


def step(x):
    return 0.9 * x
"""


@pytest.fixture
def robots(tmp_path, monkeypatch):
    name = f"robots_{abs(hash(str(tmp_path))) % 10**8}"  # modules are imported once in a process
    (tmp_path / f"{name}.py").write_text(ROBOT)
    monkeypatch.chdir(tmp_path)
    return f"{name}.py"


def test_a_robot_that_says_all_of_it_is_proved_with_one_argument(sagemp, robots, tmp_path):
    said = sagemp("prove", f"{robots}:Robot", "--json")
    assert said.exit_code == 0, said.stderr
    data = json.loads(said.stdout)
    assert data["verdict"] == "VERIFIED" and data["time"] == "continuous"
    assert data["requirements"][0]["margin"] > 0
    assert (tmp_path / data["figure"]).read_bytes().startswith(b"\x89PNG")
    checked = sagemp("check", data["certificate"])
    assert checked.exit_code == 0, checked.output
    assert "requirement inside  at all these times: angle -0.5 to 0.5" in checked.stdout
    same = sagemp("check", data["certificate"], "--against", f"{robots}:Robot")
    assert same.exit_code == 0 and "no difference" in same.stdout
    other = sagemp("check", data["certificate"], "--against", f"{robots}:Other")
    assert other.exit_code == 5
    for what in ("X_I", "W", "period", "K", "control", "ODE", "requirement 'inside'"):
        assert f"  {what}: proved " in other.stdout, what
    again = sagemp("check", data["certificate"], "--against", "experiment=x", "--network", "none.onnx")
    assert again.exit_code == 2 and "--network means nothing here" in again.stderr
    again = sagemp("recheck", data["certificate"], "disc")
    assert again.exit_code == 2 and "about requirements of an ODE of one's own" in again.stderr
    again = sagemp("prove", f"{robots}:Robot")
    assert again.exit_code == 2 and "--overwrite" in again.stderr


def test_a_goal_that_is_missed_is_falsified_and_said_so(sagemp, robots):
    said = sagemp("prove", f"{robots}:Robot", "--goal", "0:0.001,:", "--output", "missed.h5")
    assert said.exit_code == 10, said.stderr
    assert "FALSIFIED" in said.stdout and "an enclosure of it proves it" in said.stdout
    checked = sagemp("check", "missed.h5")
    assert checked.exit_code == 10 and "its counterexample is proved" in checked.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["Wants"], "control takes a network; say which: --network FILE, for instance some.onnx"),
        (["Wants", "--network", "none.onnx"], "none.onnx: no such file"),
        (["Fails"], "speaks of state 'speed', which the loop does not have"),
        (["Robot", "--dt", "0.1"], "--dt means nothing here"),
        (["Robot", "--period", "0"], "period must be a positive number"),
        (["Robot", "--substeps", "3"], "substeps must be a power of two, found 3"),
        (["Robot", "--propagator", "crown"], "bounds loops at their instants only"),
        (["Robot", "--names", "a,a"], "2 different words"),
        (["step", "--start", "0:1", "--horizon", "3", "--period", "0.1"], "--period means nothing here"),
        (["step", "--horizon", "3"], "--start is missing"),
    ],
)
def test_what_does_not_fit_is_one_line(sagemp, robots, arguments, says):
    said = sagemp("prove", f"{robots}:{arguments[0]}", *arguments[1:])
    assert said.exit_code == 2, said.output
    assert says in said.stderr and len(said.stderr.strip().splitlines()) == 1


def test_the_same_from_python():
    class Robot:
        period, horizon, start = 0.5, 4, ((1.0, 1.1),)

        def control(self, x):
            return -x

        def rate(self, x, u):
            return u

    proof = prove_ode(plant_of(Robot))
    assert str(proof.answer) == "VERIFIED" and proof.bounded
    low, high = proof.tube.lower[-1, 0], proof.tube.upper[-1, 0]
    assert float(low) <= 0.0625 and float(high) >= 0.06875  # x halves every period
    assert float(low) > 0.0624 and float(high) < 0.0689


@pytest.mark.parametrize("start", [((0.3, 0.2), (-0.1, 0.1)), ((0.2,), (-0.1, 0.1)), 3, ((float("nan"), 1.0), (0, 0))])
def test_a_start_that_is_no_box_is_refused_by_its_name(start):
    namespace = {}
    exec(ROBOT, namespace)  # noqa: S102
    robot = namespace["Robot"]()
    robot.start = start
    with pytest.raises(UsageError, match="start must be a pair"):
        plant_of(robot)
