"""Certificates of trackers that cut their controls off."""

import copy
import json

import pytest
import torch

from sagemp_cli.checker.check import check

from .conftest import make_case


@pytest.fixture(scope="module")
def saturated(tmp_path_factory):
    """One whose controls are cut off in some states and not in others."""
    case = make_case(limit=0.02)
    return case, case.write(tmp_path_factory.mktemp("saturated") / "certificate.h5")


def test_the_certificate_is_proved_and_its_controls_are_within_the_limits(saturated):
    case, path = saturated
    assert check(path).answer == "VERIFIED"
    lower, upper = case.tubes.control_lower, case.tubes.control_upper
    assert -0.02 <= lower.min() < upper.max() <= 0.02
    assert lower.min() == -0.02 or upper.max() == 0.02  # it is the limit that says so, not the tube
    start = case.problem.start.sample(50, torch.Generator().manual_seed(0))
    free = copy.deepcopy(case.tracker)
    free.saturate = False
    wanted = free(torch.as_tensor(case.tubes.references[0])[1:4] - start[:, None]).abs() / 0.02
    assert bool((wanted > 1).any()) and bool((wanted < 1).any())


def test_controls_closer_than_the_limit_are_refused(saturated, mutate, tmp_path):
    def change(file):
        for end in ("control_lower", "control_upper"):
            file[f"data/tubes/{end}"][...] *= 0.999

    report = check(mutate(saturated[1], tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and "control" in report.findings[0].reason


@pytest.mark.parametrize("claimed", [False, None, 1, "true"])
def test_a_file_that_says_otherwise_of_its_tracker_is_refused(saturated, claimed, mutate, tmp_path):
    def change(file):
        arguments = json.loads(file["data"].attrs["tracker_arguments"])
        arguments["saturate"] = claimed
        if claimed is None:
            del arguments["saturate"]
        file["data"].attrs["tracker_arguments"] = json.dumps(arguments)

    path = mutate(saturated[1], tmp_path / "mutant.h5", change)
    if claimed is False or claimed is None:
        assert check(path).answer == "UNKNOWN"
    else:
        with pytest.raises(Exception, match="tracker argument 'saturate' must be true or false"):
            check(path)


def test_a_tracker_that_does_not_saturate_is_not_taken_for_one_that_does(certificate, mutate, tmp_path):
    def change(file):
        arguments = json.loads(file["data"].attrs["tracker_arguments"]) | {"saturate": True}
        file["data"].attrs["tracker_arguments"] = json.dumps(arguments)

    report = check(mutate(certificate, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and "'clamp'" in report.findings[0].reason


def test_the_limit_itself_is_read_from_the_scales(saturated, mutate, tmp_path):
    def change(file):
        file["data/tracker/control_scale"][...] *= 1.01

    assert check(mutate(saturated[1], tmp_path / "mutant.h5", change)).answer == "UNKNOWN"
