"""Certificates of anybody's loop: no reference and no robot of ours, a scene or none, angles, several programs."""

import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.checker.claim import claim_rows, equation_lines
from sagemp_cli.sets import Box
from sagemp_cli.stages.prove import prove

START, W = Box.around([1.0, 0.2], [0.1, 0.1]), Box.around([0.0], [0.01])
STEP = "data/loop/programs"


def turn(x, w):
    """A vehicle that turns towards the origin."""
    angle = torch.atan2(x[..., 1], x[..., 0])
    return torch.stack([x[..., 0] - 0.1 * torch.cos(angle), x[..., 1] - 0.1 * torch.sin(angle) + w[..., 0]], dim=-1)


def shrink(x, w):
    return torch.stack([0.9 * x[..., 0] + 0.1 * w[..., 0], 0.8 * x[..., 1] * x[..., 0]], dim=-1)


def certificate(path, step, **options):
    prove(step, start=START, disturbance=W, horizon=4, partitions=[2, 1], restarts=1, certificate=path, **options)
    return path


def cool(x):
    """Linear, and disturbed by nothing: no variable of a step but the states has a say in the next state."""
    return torch.stack([0.9 * x[..., 0] + 0.1 * x[..., 1], 0.8 * x[..., 1]], dim=-1)


def test_a_linear_loop_without_disturbance_is_proved_step_by_step(tmp_path):
    path = tmp_path / "cool.h5"
    prove(cool, start=START, disturbance=None, horizon=40, restarts=1, certificate=path)
    report = check(path)
    assert report.answer == "VERIFIED", (report.problems, report.findings)


@pytest.mark.parametrize("step", [turn, shrink])
def test_that_a_loop_stays_in_its_tube_is_proved_without_a_scene(step, tmp_path):
    report = check(certificate(tmp_path / "own.h5", step))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    said = dict(claim_rows(report.document))
    assert said["proves"] == "x_k stays in its tube, no obstacle is claimed, no goal is claimed"
    assert said["X_I"] == "x0 0.9 to 1.1, x1 0.1 to 0.3"
    assert equation_lines(report.document)[-1].startswith("x1' = ")


SCENE = {
    "workspace": {"lower": [-2.0, -2.0], "upper": [2.0, 2.0]},
    "obstacles": [{"kind": "ball", "name": "tree", "center": [0.9, 1.0], "radius": 0.3}],
    "goal": {"lower": [0.3, -1.0], "upper": [0.9, 1.0]},
}


def test_a_scene_and_a_goal_are_proved_as_well(tmp_path):
    report = check(certificate(tmp_path / "own.h5", turn, scene=SCENE, state_names=("east", "north"), dt=0.5))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    assert report.findings[0].clearance["tree"] > 0.1
    assert dict(claim_rows(report.document))["goal at K"] == "east 0.3 to 0.9, north -1 to 1"


def test_an_obstacle_in_the_way_is_proved_to_be_hit(tmp_path):
    scene = SCENE | {"obstacles": [{"kind": "ball", "name": "tree", "center": [0.9, 0.2], "radius": 0.3}]}
    report = check(certificate(tmp_path / "own.h5", turn, scene=scene))
    assert report.answer == "FALSIFIED" and report.counterexamples == ((0, ""),)


def test_the_direction_of_an_angle_is_not_believed(mutate, tmp_path):
    source = certificate(tmp_path / "own.h5", turn)

    def change(file):
        relaxations = file["data/tubes/relaxations"]
        relaxations["slope"][:, 2, 1] *= 0.5  # the direction comes after its line

    report = check(mutate(source, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and "'atan2'" in report.findings[0].reason


def test_a_loop_may_have_several_programs_and_each_step_is_its_own(mutate, tmp_path):
    source = certificate(tmp_path / "own.h5", shrink)

    def twice(file, factor=1.0):
        file.copy(f"{STEP}/000000", f"{STEP}/000001")
        file[STEP].attrs["count"] = 2
        numbers = file[f"{STEP}/000001/numbers"]
        numbers[numbers[()] == 0.9] = 0.9 * factor
        file["data/loop/step_program"][()] = [0, 1, 0, 1]

    report = check(mutate(source, tmp_path / "same.h5", twice))
    assert report.answer == "VERIFIED"
    assert "steps 1, 3:" in equation_lines(report.document)
    other = check(mutate(source, tmp_path / "other.h5", lambda file: twice(file, 1.2)))
    assert other.answer == "UNKNOWN" and other.findings[0].reason.startswith("cell 0, step 1:")
