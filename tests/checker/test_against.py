"""What a file proves beside what a config asks for."""

import copy

import pytest
from typer.testing import CliRunner

from sagemp_cli.checker.check import check
from sagemp_cli.cli.main import app
from sagemp_cli.pipeline.against import differences


@pytest.fixture(scope="module")
def report(certificate):
    return check(certificate)


def test_of_the_same_config_there_is_no_difference(case, report):
    assert differences(report, case.config) == []


def test_a_proof_at_the_samples_alone_covers_no_config(certificate, case, mutate, tmp_path):
    def change(file):
        file["data/tubes"].attrs.update(between="samples", parts=1)

    [found] = differences(check(mutate(certificate, tmp_path / "samples.h5", change)), case.config)
    assert (found.what, found.proved, found.asked, found.covers) == ("between", "samples", "segments", False)


ASKED = {
    "X_I": (lambda c: c["start"].update(radius=[0.01, 0.04, 0.0, 0.0]), True),
    "X_I ": (lambda c: c["start"].update(radius=[0.06, 0.04, 0.0, 0.0]), False),
    "W": (lambda c: c["disturbance"].update(radius=[0.01, 0.0, 0.02, 0.02]), True),
    "W ": (lambda c: c["disturbance"].update(radius=[0.05, 0.01, 0.02, 0.02]), False),
    "K": (lambda c: c.update(horizon=9), False),
    "obstacle disc": (lambda c: c["scene"]["obstacles"][0].update(radius=0.6), True),
    "obstacle disc ": (lambda c: c["scene"]["obstacles"][0].update(radius=1.0), False),
    "workspace": (lambda c: c["scene"]["workspace"].update(upper=[0.5, 9.0]), False),
    "goal": (lambda c: c["scene"]["goal"].update(lower=[0.4, -3.0, -3.0, -3.0]), True),
    "goal ": (lambda c: c["scene"]["goal"].update(lower=[1.0, -3.0, -3.0, -3.0]), False),
}


@pytest.mark.parametrize("what", ASKED)
def test_each_difference_is_listed_and_said_to_be_covered_or_not(what, case, report):
    change, covers = ASKED[what]
    config = copy.deepcopy(case.config)
    change(config)
    assert [(d.what, d.covers) for d in differences(report, config)] == [(what.strip(), covers)]


def test_another_robot_is_found_at_points(case, report):
    config = copy.deepcopy(case.config)
    config["dynamics"]["disturbance"] = "state"
    (found,) = differences(report, config)
    assert found.what == "step" and not found.covers and "at 64 points" in found.proved


def test_the_command_ends_with_5_where_the_proof_does_not_cover_what_is_asked(certificate):
    result = CliRunner().invoke(app, ["check", str(certificate), "--against", "experiment=unicycle_node"])
    assert result.exit_code == 5 and "against the config: does NOT cover what it asks" in result.output
    assert "K: proved 8, asked 100: does NOT cover" in result.output


def test_inspect_shows_claim_equations_and_config(certificate):
    def shown(*options):
        return CliRunner().invoke(app, ["inspect", str(certificate), *options]).output

    assert "px' = px + 0.1 * (v * cos(theta) + w_px)" in shown("--equations")
    assert shown("--config").startswith("disturbance:\n  radius:\n  - 0.05\n")
    assert "claimed, not checked here" in shown() and "said by the file, not proved" in shown()
