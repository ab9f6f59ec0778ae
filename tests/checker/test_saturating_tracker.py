"""Certificates of trackers that cut their controls off."""

import copy

import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check

from .conftest import STEP, constants_of, make_case, slots_of


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


def limits(file):
    """Where the limits of the clamp are in the numbers."""
    (slot,) = slots_of(file, "clamp")
    return constants_of(file, slot)


@pytest.mark.parametrize(("factor", "shift"), [(0.9, 0.0), (1.01, 0.0), (1.0, 0.01), (float("inf"), 0.0)])
def test_another_limit_is_another_loop(factor, shift, saturated, mutate, tmp_path):
    def change(file):
        place = limits(file)
        file[f"{STEP}/numbers"][place] = file[f"{STEP}/numbers"][place] * factor + shift

    report = check(mutate(saturated[1], tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and "'clamp'" in report.findings[0].reason


def test_a_step_that_cuts_nothing_off_is_not_proved_by_one_that_does(saturated, mutate, tmp_path):
    def change(file):
        (slot,), place = slots_of(file, "clamp"), limits(file)
        file[f"{STEP}/kinds"][slot] = "identity"
        numbers = np.delete(file[f"{STEP}/numbers"][()], np.r_[place])
        del file[f"{STEP}/numbers"]
        file[f"{STEP}/numbers"] = numbers
        file[f"{STEP}/number_begin"][slot + 1 :] -= place.stop - place.start

    report = check(mutate(saturated[1], tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and "'identity'" in report.findings[0].reason


def test_the_limit_itself_is_read_from_the_scales(saturated, mutate, tmp_path):
    def change(file):
        (slot,) = slots_of(file, "clamp")
        scale = constants_of(file, next(s for s in slots_of(file, "constant") if s > slot))
        file[f"{STEP}/numbers"][scale] *= 1.01

    assert check(mutate(saturated[1], tmp_path / "mutant.h5", change)).answer == "UNKNOWN"
