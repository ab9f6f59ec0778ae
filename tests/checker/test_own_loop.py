"""Certificates of anybody's loop: no reference, no robot of ours, with and without a scene, differing steps, angles."""

import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.checker.claim import claim_rows, equation_lines
from sagemp_cli.pipeline.own_loop import LoopProof, certificate_of
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.program.loops import recorded
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import partition
from sagemp_cli.storage import Header, write_artifact

START, W = Box.around([1.0, 0.2], [0.1, 0.1]), Box.around([0.0], [0.01])


class Loop:
    """A step of one's own, which may depend on its number."""

    state_dim = 2

    def __init__(self, step, horizon=4):
        self.step, self.horizon = step, horizon


def turn(k, x, w):
    """A vehicle that turns towards the origin."""
    angle = torch.atan2(x[..., 1], x[..., 0])
    return torch.stack([x[..., 0] - 0.1 * torch.cos(angle), x[..., 1] - 0.1 * torch.sin(angle) + w[..., 0]], dim=-1)


def shrink(k, x, w):
    return torch.stack([0.9 * x[..., 0] + 0.1 * w[..., 0], 0.8 * x[..., 1] * x[..., 0]], dim=-1)


def in_turns(k, x, w):
    return shrink(k, x, w) if k % 2 else torch.cat([x[..., :1] * 0.9, torch.tanh(x[..., 1:])], dim=-1) + w * 0.1


def certificate(path, step, **options):
    loop = recorded(Loop(step), START, W)
    cells = partition(START, [2, 1])
    with torch.no_grad():
        run = Affine().run(loop, cells, W)
    proof = LoopProof(loop, START, W, cells, run.tube, run.recording(), "affine", True)
    record, config = certificate_of(proof, **options)
    return write_artifact(path, record, Header(stage="prove", experiment="own", config=config))


@pytest.mark.parametrize("step", [turn, shrink])
def test_that_a_loop_stays_in_its_tube_is_proved_without_a_scene(step, tmp_path):
    report = check(certificate(tmp_path / "own.h5", step))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    said = dict(claim_rows(report.document))
    assert said["proves"] == "x_k stays in its tube, no obstacle is claimed, no goal is claimed"
    assert said["X_I"] == "x0 0.9 to 1.1, x1 0.1 to 0.3"
    assert equation_lines(report.document)[-1].startswith("x1' = ")


def test_a_loop_whose_steps_differ_has_a_program_for_each(tmp_path):
    report = check(certificate(tmp_path / "own.h5", in_turns))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    assert report.document.step_program.tolist() == [0, 1, 2, 3] and report.document.lookahead == 0
    lines = equation_lines(report.document)
    assert lines[0] == "steps 0:" and any("tanh(x1)" in line for line in lines)


def test_a_loop_whose_steps_change_places_is_another_loop(mutate, tmp_path):
    source = certificate(tmp_path / "own.h5", in_turns)

    def change(file):
        file["data/loop/step_program"][()] = [1, 0, 3, 2]

    assert check(mutate(source, tmp_path / "mutant.h5", change)).answer == "UNKNOWN"


SCENE = {
    "workspace": {"lower": [-2.0, -2.0], "upper": [2.0, 2.0]},
    "obstacles": [{"kind": "ball", "name": "tree", "center": [0.9, 1.0], "radius": 0.3}],
    "goal": {"lower": [0.3, -1.0], "upper": [0.9, 1.0]},
}


def test_a_scene_and_a_goal_are_proved_as_well(tmp_path):
    path = certificate(tmp_path / "own.h5", turn, scene=SCENE, position=(0, 1), state_names=("east", "north"), dt=0.5)
    report = check(path)
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    assert report.findings[0].clearance["tree"] > 0.1
    assert dict(claim_rows(report.document))["goal at K"] == "east 0.3 to 0.9, north -1 to 1"


def test_an_obstacle_in_the_way_is_not_passed(tmp_path):
    scene = SCENE | {"obstacles": [{"kind": "ball", "name": "tree", "center": [0.9, 0.2], "radius": 0.3}]}
    report = check(certificate(tmp_path / "own.h5", turn, scene=scene, position=(0, 1)))
    assert report.answer == "UNKNOWN" and report.findings[0].claimed == "MAY_COLLIDE"


def test_the_direction_of_an_angle_is_not_believed(mutate, tmp_path):
    source = certificate(tmp_path / "own.h5", turn)

    def change(file):
        relaxations = file["data/tubes/relaxations"]
        relaxations["slope"][:, 2, 1] *= 0.5  # the direction comes after its line

    report = check(mutate(source, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and "'atan2'" in report.findings[0].reason
