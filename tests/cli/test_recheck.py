"""``sagemp recheck``: stored tubes in another scene."""

from __future__ import annotations

import json

import pytest
import torch
import yaml

from sagemp_cli.config.composition import compose
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.stages.recheck import kept_library
from sagemp_cli.storage import Library, read_artifact
from sagemp_cli.verification.verdict import Assessment, Outcome, Verdict


@pytest.fixture
def moved(tmp_path):
    """``moved(**changes)``: a file with the toy scene, changed."""

    def write(**changes):
        path = tmp_path / "moved.yaml"
        path.write_text(yaml.safe_dump(dict(compose(["effort=toy"])["scene"]) | changes))
        return path

    return write


def across(library, r):
    """A ball in the way of a reference."""
    middle = library.record.tubes.references[r, library.record.tubes.references.shape[1] // 2, :2]
    return [{"kind": "ball", "name": "thrown in", "center": middle.tolist(), "radius": 0.01}]


def test_tubes_in_their_own_scene_are_as_certified_as_before(sagemp, toy_folder, moved):
    result = sagemp("recheck", toy_folder / "library.h5", moved(), "--json")
    found = json.loads(result.output)
    assert found["answer"] == "VERIFIED" and result.exit_code == 0
    assert [r["verdict"] for r in found["references"]] == ["SAFE"] * found["certified"]


def test_an_obstacle_in_the_way_is_named_with_its_time(sagemp, toy_folder, moved):
    library = read_artifact(toy_folder / "library.h5", Library)
    result = sagemp("recheck", library.path, moved(obstacles=across(library, 0)))
    assert result.exit_code == 5
    assert "reference 0: MAY_COLLIDE at step" in result.output and "(thrown in)" in result.output


FAR = [{"kind": "ball", "name": "far away", "center": [1.9, 1.9], "radius": 0.01}]


def test_what_is_written_is_a_library_that_check_proves(sagemp, toy_folder, moved, tmp_path):
    there, out = moved(obstacles=FAR), tmp_path / "library.h5"
    assert sagemp("recheck", toy_folder / "library.h5", there, "--output", out).exit_code == 0
    new = read_artifact(out, Library)
    assert new.header.config["scene"] == yaml.safe_load(there.read_text())
    assert new.record.tubes.constraint_names == ("workspace", "far away")
    checked = sagemp("check", out)
    assert checked.exit_code == 0, checked.output


def test_a_library_keeps_what_is_certified_and_counts_what_is_not(toy_folder):
    record = read_artifact(toy_folder / "library.h5", Library).record
    count, n = record.tubes.references.shape[0], record.tubes.references.shape[2]
    assert count > 1
    verdicts = (Verdict(Outcome.MAY_COLLIDE, 3, "thrown in"), *[Verdict(Outcome.SAFE)] * (count - 1))
    scene = scene_from_mapping(compose(["effort=toy"])["scene"], state_dim=n, position_dim=2)
    found = Assessment(verdicts, torch.zeros(count, len(scene.constraint_names)), torch.zeros(count, n))
    left = kept_library(record, scene, found)
    own = record.tubes.cell_reference != 0
    assert (left.tubes.references == record.tubes.references[1:]).all()
    assert (left.tubes.tube_lower == record.tubes.tube_lower[own]).all()
    assert (left.tubes.relaxations.slope == record.tubes.relaxations.slope[own]).all()
    assert (left.tubes.cell_reference == record.tubes.cell_reference[own] - 1).all()
    assert (left.rejected_references[-1] == record.tubes.references[0]).all()
    before, after = (dict(zip(r.reason_names, r.reason_counts, strict=True)) for r in (record, left))
    assert after["tube in collision"] == before["tube in collision"] + 1


def test_a_certificate_of_another_scene_is_checked_there(sagemp, toy_folder, moved, tmp_path):
    out = tmp_path / "certificate.h5"
    result = sagemp("recheck", toy_folder / "certificate.h5", moved(obstacles=FAR), "--output", out)
    assert result.exit_code == 0, result.output
    checked = sagemp("check", out)
    assert checked.exit_code == 0 and "far away" in checked.output
    again = sagemp("recheck", toy_folder / "certificate.h5", moved(obstacles=FAR), "--output", out)
    assert again.exit_code == 2 and "--overwrite" in again.output


def test_a_library_of_nothing_is_not_written(sagemp, toy_folder, moved, tmp_path):
    everywhere = [{"kind": "block", "name": "flood", "lower": [-9, -9], "upper": [9, 9]}]
    result = sagemp("recheck", toy_folder / "library.h5", moved(obstacles=everywhere), "-o", tmp_path / "library.h5")
    assert result.exit_code == 5 and not (tmp_path / "library.h5").exists()
    assert "0 of" in result.output


def test_what_holds_no_tubes_or_is_no_scene_is_refused_in_one_line(sagemp, toy_folder, moved, tmp_path):
    refused = sagemp("recheck", toy_folder / "tracker.h5", moved())
    assert refused.exit_code == 2 and "certificates and libraries" in refused.output
    refused = sagemp("recheck", toy_folder / "library.h5", moved(goal={"lower": [0.0], "upper": [1.0]}))
    assert refused.exit_code == 2 and "scene.goal.lower" in refused.output
    refused = sagemp("recheck", toy_folder / "library.h5", tmp_path / "none.yaml")
    assert refused.exit_code == 2 and "no such file" in refused.output
