"""Trackers from ONNX files in a closed loop, and ours written as ONNX and read back."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.errors import ArtifactError, ConfigError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.controller import Controller, lookahead_errors
from sagemp_cli.loop.onnx_format.tracker import INPUTS, OnnxTracker
from sagemp_cli.loop.onnx_format.writing import as_network, rounding_to_float32, write_onnx
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.interval.interval import Interval
from sagemp_cli.reachability.lirpa import adapter as lirpa_adapter
from sagemp_cli.reachability.lirpa.auto_lirpa import AutoLirpa
from sagemp_cli.sets import Box

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
node = onnx.helper.make_node
SIZES = {"errors": 8, "state": 4, "state_and_reference": 12}


@pytest.fixture
def file_for(saved):
    """``file_for(entries)``: a small network from so many numbers to two controls."""

    def save(entries):
        rng = np.random.default_rng(entries)
        constants = {
            "w": (0.3 * rng.normal(size=(6, entries))).astype(np.float32),
            "b": (0.1 * rng.normal(size=6)).astype(np.float32),
            "v": (0.3 * rng.normal(size=(6, 2))).astype(np.float32),
        }
        nodes = [
            node("Gemm", ["x", "w", "b"], ["h"], transB=1),
            node("Tanh", ["h"], ["t"]),
            node("MatMul", ["t", "v"], ["y"]),
        ]
        return saved(nodes, constants, shape=["N", entries], outputs=["N", 2])

    return save


@pytest.fixture
def robot():
    limits = {"control_lower": [-2.0] * 2, "control_upper": [2.0] * 2}
    return Unicycle(dt=0.1, **limits, state_lower=[-9.0] * 4, state_upper=[9.0] * 4)


REFERENCE = torch.stack([torch.linspace(0, 1.2, 13), *([torch.zeros(13)] * 2), torch.ones(13)], -1).double()
START = Box.around([0.0, 0.0, 0.0, 1.0], [0.1, 0.1, 0.05, 0.0])
DISTURBANCE = Box.around([0.0] * 4, [0.02, 0.02, 0.01, 0.01])


@pytest.mark.parametrize("inputs", INPUTS)
@pytest.mark.parametrize("propagator", [Affine(), Interval(), Best()], ids=lambda p: p.name)
def test_the_tube_of_a_foreign_tracker_holds_its_rollouts(inputs, propagator, file_for, robot):
    path = file_for(SIZES[inputs])
    tracker = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(path), inputs=inputs, control_offset=[0.1, 0.0])
    assert tracker.lookahead == {"errors": 2, "state": 1, "state_and_reference": 2}[inputs]
    loop = ClosedLoop(robot, tracker, REFERENCE)
    tube = propagator.propagate(loop, START, DISTURBANCE)
    generator = torch.Generator().manual_seed(0)
    x = START.sample(200, generator)
    states, _ = loop.rollout(x, DISTURBANCE.sample(200 * 12, generator).unflatten(0, (200, 12)))
    assert bool((states >= tube.lower).all() and (states <= tube.upper).all())
    assert float(tube.width[-1].max()) < 10 * float((states.amax(0) - states.amin(0))[-1].max())


@pytest.mark.parametrize("inputs", INPUTS)
def test_controls_are_those_of_the_network_on_what_it_is_given(inputs, file_for, evaluated):
    path = file_for(SIZES[inputs])
    options = {"inputs": inputs, "control_scale": [2.0, 0.5], "control_offset": [0.25, -1.0]}
    tracker = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(path), **options)
    x, window = torch.randn(7, 4).double(), torch.randn(7, tracker.lookahead, 4).double()
    errors = (window - x[:, None]).flatten(1)
    given = {"errors": errors, "state": x, "state_and_reference": torch.cat([x, window.flatten(1)], 1)}[inputs]
    expected = evaluated(path, given) * torch.tensor([2.0, 0.5]) + torch.tensor([0.25, -1.0])
    torch.testing.assert_close(tracker.control(window, x), expected, rtol=1e-5, atol=1e-6)


def test_what_is_stored_makes_the_same_tracker_again(file_for):
    tracker = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(file_for(8)), control_scale=[2.0, 3.0])
    again = OnnxTracker(**json.loads(json.dumps(tracker.arguments({}))))
    again.load_state_dict(tracker.state_dict())
    x, window = torch.randn(9, 4).double(), torch.randn(9, 2, 4).double()
    assert torch.equal(again.control(window, x), tracker.control(window, x))


def test_a_network_that_does_not_fit_the_robot_is_refused(file_for):
    path = str(file_for(8))
    with pytest.raises(ConfigError, match=r"takes 8 numbers; with tracker.inputs=state a robot of 4 states gives 4"):
        OnnxTracker.taken(state_dim=4, control_dim=2, path=path, inputs="state")
    with pytest.raises(ConfigError, match=r"takes 8 numbers.* a robot of 3 states gives a multiple of 3"):
        OnnxTracker.taken(state_dim=3, control_dim=2, path=path)
    with pytest.raises(ConfigError, match=r"gives 2 numbers, the robot has 1 controls"):
        OnnxTracker.taken(state_dim=4, control_dim=1, path=path)
    with pytest.raises(ConfigError, match=r"must be one of errors, state, state_and_reference, found 'all'"):
        OnnxTracker.taken(state_dim=4, control_dim=2, path=path, inputs="all")
    with pytest.raises(ConfigError, match="tracker.path must name an ONNX file"):
        OnnxTracker.taken(state_dim=4, control_dim=2)
    with pytest.raises(ArtifactError, match="no such file"):
        OnnxTracker.taken(state_dim=4, control_dim=2, path="nowhere.onnx")


HOSTILE = {
    "no mapping": [],
    "no layers": {"inputs": 4, "layers": []},
    "endless": {"inputs": 4, "layers": [{"kind": "linear", "size": 10**12, "reads": [0], "numbers": []}]},
    "a later vector": {"inputs": 4, "layers": [{"kind": "tanh", "size": 4, "reads": [1], "numbers": []}]},
    "another size": {"inputs": 4, "layers": [{"kind": "tanh", "size": 3, "reads": [0], "numbers": []}]},
    "another kind": {"inputs": 4, "layers": [{"kind": "system", "size": 4, "reads": [0], "numbers": []}]},
    "text": {"inputs": 4, "layers": ["tanh"]},
    "a flag": {"inputs": True, "layers": [{"kind": "tanh", "size": 4, "reads": [0], "numbers": []}]},
    "half an entry": {
        "inputs": 4,
        "layers": [{"kind": "pick", "size": 1, "reads": [0], "numbers": [], "entries": [0.5]}],
    },
    "no entry": {"inputs": 4, "layers": [{"kind": "pick", "size": 1, "reads": [0], "numbers": [], "entries": [4]}]},
    "a list as slope": {"inputs": 4, "layers": [{"kind": "leaky_relu", "size": 4, "reads": [0], "numbers": [[]]}]},
}


@pytest.mark.parametrize("what", HOSTILE)
def test_stored_networks_that_are_none_are_refused(what):
    with pytest.raises(ConfigError):
        OnnxTracker(state_dim=4, control_dim=2, inputs="state", network=HOSTILE[what])


def test_a_stored_tracker_reads_no_file(file_for):
    with pytest.raises(ConfigError, match="made by train-tracker"):
        OnnxTracker(state_dim=4, control_dim=2, path=str(file_for(8)))


TRACKERS = {
    "plain": {},
    "saturating": {"saturate": True, "control_scale": [1.5, 0.7], "control_offset": [0.1, -3.0]},
    "scaled, another slope": {"error_scale": [0.3, 0.7, 1.1, 2.0], "negative_slope": 0.25},
    "relu": {"negative_slope": 0.0},
}


@pytest.fixture(params=TRACKERS)
def ours(request):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        return Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[8, 5], **TRACKERS[request.param])


def test_a_written_tracker_gives_the_same_controls_by_onnx_itself(ours, tmp_path, evaluated):
    errors = torch.randn(200, 3, 4, generator=torch.Generator().manual_seed(0)).double()
    with torch.no_grad():
        expected = ours(errors)
    write_onnx(ours, tmp_path / "exact.onnx")
    found = evaluated(tmp_path / "exact.onnx", errors.flatten(1))
    assert float((found - expected).abs().max()) <= 1e-13 * (1 + float(expected.abs().max()))
    write_onnx(ours, tmp_path / "single.onnx", float32=True)
    rough = evaluated(tmp_path / "single.onnx", errors.flatten(1))
    assert 0 < float((rough - expected).abs().max()) <= 1e-5
    number, control = rounding_to_float32(ours)
    assert 0 < number < 1e-6 and 0 < control < 1e-6
    # The largest change on other random inputs, of the network whose numbers are the rounded ones, is of that size.
    rounded = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(tmp_path / "single.onnx"))
    x = 2 * torch.rand(4096, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1
    largest = float((rounded.network(x) - as_network(ours)(x)).abs().max())
    assert 0.5 * largest <= control <= 2 * largest


def test_a_written_tracker_read_again_is_the_same_tracker(ours, tmp_path):
    write_onnx(ours, tmp_path / "net.onnx")
    again = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(tmp_path / "net.onnx"))
    x, window = torch.randn(100, 4).double(), torch.randn(100, 3, 4).double()
    with torch.no_grad():
        assert torch.equal(again.control(window, x), ours.control(window, x))
        write_onnx(again, tmp_path / "twice.onnx")
        twice = OnnxTracker.taken(state_dim=4, control_dim=2, path=str(tmp_path / "twice.onnx"))
        assert torch.equal(twice.control(window, x), ours.control(window, x))
    assert twice.arguments({}) | {"path": ""} == again.arguments({}) | {"path": ""}


def test_a_foreign_network_of_every_kind_of_layer_survives_writing(saved, tmp_path, evaluated):
    rng = np.random.default_rng(0)
    constants = {
        "w": rng.normal(size=(3, 6)).astype(np.float32),
        "k": rng.normal(size=6).astype(np.float32),
        "v": rng.normal(size=(6, 1)).astype(np.float32),
        "hi": np.float32(0.5),
    }
    nodes = [
        node("Transpose", ["x"], ["t"]),
        node("Flatten", ["t"], ["f0"], axis=0),
        node("MatMul", ["f0", "v"], ["one"]),
        node("Sub", ["k", "f0"], ["a"]),
        node("Sigmoid", ["a"], ["b"]),
        node("Softplus", ["b"], ["c"]),
        node("Div", ["a", "c"], ["d"]),
        node("LeakyRelu", ["d"], ["e"], alpha=0.3),
        node("Mul", ["e", "one"], ["f"]),
        node("Clip", ["f", "", "hi"], ["g"]),
        node("Elu", ["g"], ["h"]),
        node("Relu", ["h"], ["i"]),
        node("Add", ["i", "h"], ["y"]),
    ]
    tracker = OnnxTracker.taken(
        state_dim=3, control_dim=6, path=str(saved(nodes, constants, shape=[2, 3], outputs=[1, 6]))
    )
    write_onnx(tracker, tmp_path / "again.onnx")
    errors = torch.randn(50, 6, generator=torch.Generator().manual_seed(0)).double()
    found, expected = evaluated(tmp_path / "again.onnx", errors), tracker.network(errors)
    assert float(expected.std()) > 0.01
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    again = OnnxTracker.taken(state_dim=3, control_dim=6, path=str(tmp_path / "again.onnx"))
    torch.testing.assert_close(again.network(errors), expected, rtol=1e-14, atol=1e-14)


def test_activations_of_later_versions_survive_writing(saved, tmp_path):
    kinds = ["Gelu", "Mish", "HardSwish", "Softsign", "Erf", "Exp", "Sqrt", "Neg", "Sin", "Abs", "Cos", "Softmax"]
    names = ["x", *(f"h{i}" for i in range(len(kinds) + 1)), "y"]
    nodes = [node(kind, [names[i]], [names[i + 1]]) for i, kind in enumerate(kinds)]
    nodes.append(node("Gelu", [names[len(kinds)]], [names[len(kinds) + 1]], approximate="tanh"))
    nodes.append(node("Elu", [names[-2]], ["y"], alpha=0.5))
    path = str(saved(nodes, {}, shape=[1, 6], outputs=[1, 6], opset=20))
    tracker = OnnxTracker.taken(state_dim=3, control_dim=6, path=path)
    write_onnx(tracker, tmp_path / "again.onnx")
    again = OnnxTracker.taken(state_dim=3, control_dim=6, path=str(tmp_path / "again.onnx"))
    errors = torch.randn(50, 6, generator=torch.Generator().manual_seed(0)).double()
    assert float(tracker.network(errors).std()) > 1e-4
    torch.testing.assert_close(again.network(errors), tracker.network(errors), rtol=1e-14, atol=1e-14)


def test_writing_never_replaces_a_file_unasked_and_refuses_numbers_beyond_float32(ours, tmp_path):
    path = tmp_path / "net.onnx"
    write_onnx(ours, path)
    before = path.read_bytes()
    with pytest.raises(ArtifactError, match="exists already"):
        write_onnx(ours, path)
    with torch.no_grad():
        ours.layers[0].weight[0, 0] = 1e39
    with pytest.raises(ConfigError, match="too large for float32"):
        write_onnx(ours, path, float32=True, overwrite=True)
    assert path.read_bytes() == before


class BodyFrame(Tracker):
    """The paper's tracker on errors that are turned into the robot's own frame."""

    def features(self, window, x):
        e = lookahead_errors(window, x)
        cos, sin = torch.cos(x[..., 2:3]), torch.sin(x[..., 2:3])
        ahead, aside = cos * e[..., 0] + sin * e[..., 1], cos * e[..., 1] - sin * e[..., 0]
        return torch.stack([ahead, aside, e[..., 2], e[..., 3]], dim=-1)


class Proportional(Controller):
    """No network at all."""

    trains = False

    def __init__(self):
        super().__init__()
        self.state_dim, self.control_dim, self.lookahead = 4, 2, 1

    def control(self, window, x):
        e = lookahead_errors(window, x)[..., 0, :]
        return torch.stack([2.0 * e[..., 2] + torch.tanh(e[..., 1]), 1.5 * e[..., 3] + e[..., 0]], dim=-1)


def body_frame():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        return BodyFrame(state_dim=4, control_dim=2, lookahead=2, hidden=[6], saturate=True)


@pytest.mark.parametrize("make", [body_frame, Proportional])
@pytest.mark.parametrize("propagator", [Affine(), Interval()], ids=lambda p: p.name)
def test_the_tube_of_a_controller_of_ones_own_holds_its_rollouts(make, propagator, robot):
    loop = ClosedLoop(robot, make(), REFERENCE)
    tube = propagator.propagate(loop, START, DISTURBANCE)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        x, w = START.sample(200, generator), DISTURBANCE.sample(200 * 12, generator).unflatten(0, (200, 12))
        states, _ = loop.rollout(x, w)
    assert bool((states >= tube.lower).all() and (states <= tube.upper).all())
    if propagator.name == "affine":
        assert float(tube.width[-1].max()) < 3 * float((states.amax(0) - states.amin(0))[-1].max())


@pytest.mark.skipif(
    lirpa_adapter._installed() is None and lirpa_adapter._carried() is None, reason="no auto_LiRPA is installed"
)
def test_auto_lirpa_bounds_what_does_not_fold_reference_by_reference(robot):
    references = torch.stack([REFERENCE[:4], REFERENCE[:4] + torch.tensor([0.0, 0.1, 0.0, 0.0])])
    start = Box(
        START.lower + (references[:, 0] - references[:1, 0]), START.upper + (references[:, 0] - references[:1, 0])
    )
    loop = ClosedLoop(robot, body_frame(), references)
    with torch.no_grad():
        tube = AutoLirpa(mode="one_step").propagate(loop, start, DISTURBANCE)
        generator = torch.Generator().manual_seed(0)
        w = DISTURBANCE.sample(400 * 3, generator).unflatten(0, (200, 2, 3))
        x = start.lower + torch.rand(200, 2, 4, generator=generator) * start.width
        states, _ = loop.rollout(x, w)
    assert tube.lower.shape == (2, 4, 4)
    assert bool((states >= tube.lower - 1e-9).all() and (states <= tube.upper + 1e-9).all())


def test_features_of_ones_own_are_written_as_the_network_s_input(tmp_path, evaluated):
    tracker = body_frame()
    write_onnx(tracker, tmp_path / "net.onnx")
    x, window = torch.randn(20, 4).double(), torch.randn(20, 2, 4).double()
    with torch.no_grad():
        found = evaluated(tmp_path / "net.onnx", tracker.features(window, x).flatten(1))
        torch.testing.assert_close(found, tracker.control(window, x), rtol=1e-12, atol=1e-12)


def test_what_has_no_layers_that_are_known_is_not_written(tmp_path):
    with pytest.raises(UsageError, match="Proportional cannot be written as ONNX"):
        as_network(Proportional())
