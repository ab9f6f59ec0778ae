"""What all chunks of a run share."""

import pickle

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box
from sagemp_cli.verification import cells
from sagemp_cli.verification.cells import CellProver, Chunk

START = Box.around([0.1, 0.0, 0.0, 1.0], [0.1, 0.1, 0.0, 0.0])


@pytest.fixture
def prover():
    limits = {"control_lower": [-1.5, -2.0], "control_upper": [1.5, 2.0]}
    unicycle = Unicycle(dt=0.1, state_lower=[-3.0, -4.0, -1.6, 0.0], state_upper=[9.0, 4.0, 1.6, 3.0], **limits)
    tracker = Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[4])
    w = Box.around([0.0] * 4, [0.05, 0.05, 0.0, 0.02])
    scene = Scene(Box([-9.0] * 2, [9.0] * 2), (), Box([-9.0] * 4, [9.0] * 4))
    return CellProver(Affine(), Problem(unicycle, scene, START, w, 5), tracker)


def chunk(index, shift=0.0):
    references = START.center.expand(1, 6, 4) + shift
    return Chunk(index, torch.zeros(1, dtype=torch.int64), references, Box(START.lower[None], START.upper[None]))


@pytest.fixture
def recordings(monkeypatch):
    """The loops that were recorded."""
    made, record = [], cells.recorded
    monkeypatch.setattr(cells, "recorded", lambda *args: made.append(args[0]) or record(*args))
    return made


def test_the_step_is_recorded_once_for_all_chunks_and_goes_along_to_other_processes(prover, recordings):
    found = [prover.prove(chunk(i, 0.1 * i)) for i in range(3)]
    sent = pickle.loads(pickle.dumps(prover))
    again = sent.prove(chunk(2, 0.2))
    assert len(recordings) == 1
    assert torch.equal(again.tube.upper, found[2].tube.upper)


def test_every_chunk_has_its_own_references(prover):
    found = [prover.prove(chunk(i, 0.1 * i)).tube for i in range(2)]
    for i, tube in enumerate(found):
        alone = CellProver(prover.propagator, prover.problem, prover.tracker)
        loop = alone.loop(chunk(i, 0.1 * i).references)
        expected = Affine().propagate(loop, chunk(i).cells, prover.problem.disturbance)
        assert torch.equal(tube.lower, expected.lower) and torch.equal(tube.upper, expected.upper)
    assert not torch.equal(found[0].upper, found[1].upper)
