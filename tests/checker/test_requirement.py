"""What a stranger's ODE has to do: proved again from the file alone, by the checker's own margins."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check, check_document
from sagemp_cli.checker.claim import claim_rows, equation_lines
from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.scenes.requirements import Holds, Inside
from sagemp_cli.verification.verdict import Answer

from .required import PERIOD, REQUIREMENTS, K, in_two_ways, margin_of, proof, written
from .test_flow_mutants import solutions

FINE = 16


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    where = tmp_path_factory.mktemp("required") / "body.h5"
    made = in_two_ways()
    assert made.answer is Answer.VERIFIED, made.verdicts
    written(made, where)
    return where


@pytest.fixture(scope="module")
def report(path):
    return check(path)


def test_cells_that_are_divided_in_two_ways_are_proved_with_all_that_is_required(report):
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    document = report.document
    assert [(ode.substeps, ode.order) for ode in document.odes] == [(1, 3), (4, 2)]
    assert document.cell_ode.tolist() == [0, 1]
    assert document.constraints == tuple(r.name for r in REQUIREMENTS)
    assert min(report.findings[0].margins.values()) > 0


def test_the_claim_says_what_has_to_hold_and_when(report):
    rows = claim_rows(report.document)
    said = {label: text for label, text in reversed(rows)}
    assert said["requirement inside"] == "at all these times: angle -0.5 to 0.5 rad, rate -2 to 0.5 rad/s"
    assert said["requirement later"] == "at all t in [2 dt, K dt] = [0.25, 0.5] s: angle -0.2 to 0.29 rad"
    assert said["requirement slow"] == "at t = K dt = 0.5 s: rate -0.99 to 0 rad/s"
    assert said["requirement corner"].startswith("at all these times: not in the box angle 0.2 to 0.3 rad, rate -2 to")
    assert said["requirement energy"] == "at all these times: 1.5 - sqrt(angle^2 + rate^2 + 0.01) >= 0"
    assert said["requirement kinked"].startswith("at all t in [0.4 dt, 2.4 dt] = [0.05, 0.3] s: ")
    texts = [text for label, text in rows if label == "requirement kinked"]
    assert texts[-1] == "all of g1, g2 > 0"
    assert ("ODE", "angle' = rate + w_angle") in rows
    assert any(line.startswith("requirement energy: ") for line in equation_lines(report.document))
    assert "1 cell: each period as a whole" in dict(rows)["how it is proved"]


def test_no_solution_under_switching_signals_has_a_smaller_margin_at_any_time(report):
    document = report.document
    states = np.concatenate(solutions(document, np.random.default_rng(3), count=400))
    times = np.arange(K * FINE + 1) / FINE
    for one in document.requirements:
        asked = (one.first <= times) & (times <= one.last)
        least = margin_of(one, states[:, asked]).min()
        assert least >= report.findings[0].margins[one.name] - 1e-9, one.name


@pytest.mark.parametrize("one", range(len(REQUIREMENTS)))
def test_a_margin_that_is_larger_than_solutions_have_it_is_not_proved(report, one):
    document = report.document
    clearance = document.tubes["clearance"].copy()
    clearance[0, one] += 0.05
    made = dataclasses.replace(document, tubes={**document.tubes, "clearance": clearance})
    found = check_document(made, report.path)
    assert found.answer == "UNKNOWN"
    assert f"the margin of '{document.constraints[one]}' is only proved to be" in found.findings[0].reason


@pytest.mark.parametrize("value", [0.0, -1e-9, math.nan, math.inf, -math.inf])
def test_a_margin_that_proves_nothing_is_not_enough(report, value):
    document = report.document
    clearance = document.tubes["clearance"].copy()
    clearance[0, 5] = value  # which is strict
    made = dataclasses.replace(document, tubes={**document.tubes, "clearance": clearance})
    assert check_document(made, report.path).answer == "UNKNOWN"


def test_a_margin_that_just_holds_is_proved(report):
    document = report.document
    clearance = np.zeros_like(document.tubes["clearance"])
    clearance[0, 3:] = 1e-300  # strict ones
    made = dataclasses.replace(document, tubes={**document.tubes, "clearance": clearance})
    assert check_document(made, report.path).answer == "VERIFIED"


def test_an_angle_that_jumps_is_bounded_by_its_whole_circle(tmp_path):
    """Behind the jump a rate of change says nothing; without one the same margin is proved."""
    turned = Holds(lambda x: 2.0 - torch.atan2(x[..., :1] - 0.25, x[..., 1:] - 0.5), name="turn")
    made = proof([turned])
    assert made.answer is Answer.UNKNOWN  # the angle is pi for angles above 0.25, -pi below
    written(made, tmp_path / "turn.h5")
    report = check(tmp_path / "turn.h5")
    assert report.answer == "UNKNOWN" and report.claimed == "UNKNOWN"
    clearance = np.array([[1.0]])
    tubes = {**report.document.tubes, "clearance": clearance, "verdict": ["SAFE"], "step": np.array([-1])}
    claimed = dataclasses.replace(
        report.document, tubes={**tubes, "constraint": [""], "fraction": np.zeros(1)}, verdict="VERIFIED"
    )
    found = check_document(claimed, report.path)
    assert found.answer == "UNKNOWN" and "margin of 'turn' is only proved to be -1.14" in found.findings[0].reason


def test_margins_of_all_kinds_of_operations_are_proved_again(tmp_path):
    """With kinks, jumps and branches too: what has no derivative is bounded over the whole of each part."""
    margins = {
        "where": lambda x: 2 + torch.where(x[..., :1] > 0.25, x[..., :1], x[..., 1:]),
        "jumps": lambda x: 4 + torch.floor(x[..., :1] * 10) + torch.sign(x[..., 1:]) + torch.remainder(x[..., :1], 0.3),
        "larger": lambda x: 3 + torch.maximum(x[..., :1], x[..., 1:]) - torch.minimum(x[..., :1], x[..., 1:] * 2),
        "limits": lambda x: 3 + x.clamp(-0.1, 0.2) + torch.nn.functional.gelu(x),
        "shares": lambda x: torch.softmax(x, -1),
        "quotient": lambda x: 3 - 1 / (x[..., :1] + 2) + torch.exp(x[..., 1:]) * torch.tanh(x[..., :1]),
        "angle": lambda x: 4 - torch.atan2(x[..., 1:], x[..., :1]),
    }
    made = proof([Holds(g, name=name) for name, g in margins.items()], horizon=2, substeps=2, order=2)
    assert made.answer is Answer.VERIFIED
    written(made, tmp_path / "kinds.h5")
    report = check(tmp_path / "kinds.h5")
    assert report.answer == "VERIFIED", report.findings
    states = np.concatenate(solutions(report.document, np.random.default_rng(3), count=200))
    for one in report.document.requirements:
        assert margin_of_torch(margins[one.name], states) >= report.findings[0].margins[one.name] - 1e-9, one.name


def margin_of_torch(function, states):
    return float(function(torch.from_numpy(states)).min())


def test_what_is_not_bounded_or_not_proved_is_stored_as_that(tmp_path):
    written(proof([Inside({"angle": (-0.5, 0.25)})]), tmp_path / "open.h5")
    report = check(tmp_path / "open.h5")
    assert report.answer == "UNKNOWN" and report.findings[0].claimed == "MAY_VIOLATE"
    assert not report.findings[0].margins


def test_nothing_asked_is_a_tube_that_is_proved(tmp_path):
    written(proof([]), tmp_path / "tube.h5")
    report = check(tmp_path / "tube.h5")
    assert report.answer == "VERIFIED" and not report.document.requirements


def test_what_is_broken_is_refuted_again_by_a_solution_that_the_checker_follows(tmp_path):
    made = proof([Inside({"angle": (-0.5, 0.28)})], restarts=1)
    assert made.answer is Answer.FALSIFIED and not made.pieces
    written(made, tmp_path / "broken.h5")
    report = check(tmp_path / "broken.h5")
    assert report.answer == "FALSIFIED" and report.counterexamples == ((0, ""),)
    assert report.findings[0].claimed == "UNSAFE"


def edited(where, **values):
    def change(file):
        group = file["data/requirements/000001"]
        (group if where is None else group[where]).attrs.update(values)

    return change


def emptied(file):
    del file["data/requirements/000001/margins/kinds"]


def named_alike(file):
    file["data/requirements/000002"].attrs["name"] = "later"


def read_disturbance(file):
    outputs = file["data/requirements/000001/margins/outputs"]
    outputs[1] = 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edited(None, first=-0.5), "speaks of periods -0.5 to 4.0, not within 0 to 4"),
        (edited(None, first=float("nan")), "speaks of periods nan"),
        (edited(None, last=4.5), "speaks of periods 2.0 to 4.5"),
        (edited(None, first=3.0, last=2.0), "speaks of periods 3.0 to 2.0"),
        (edited(None, first=2), "first and last are float64 numbers"),
        (edited(None, every=1), "every and strict are truth values"),
        (edited(None, name=""), "needs a short name"),
        (edited(None, name="x" * 61), "needs a short name"),
        (named_alike, "has a name twice"),
        (emptied, "kinds"),
        (read_disturbance, "read the disturbance"),
        (lambda file: file["data/requirements/000001"].create_dataset("more", data=[1.0]), "holds 'more'"),
    ],
)
def test_what_is_no_requirement_is_refused(change, message, path, mutate, tmp_path):
    with pytest.raises(ArtifactError, match=message):
        check(mutate(path, tmp_path / "mutant.h5", change))


def test_requirements_get_names_of_their_own_and_short_ones():
    twice = [Inside({"angle": (-9.0, 9.0)}, name=n) for n in ("a", "a 2", "a", "a")]
    assert [v.name for v in proof(twice).verdicts] == ["a", "a 2", "a 3", "a 4"]
    with pytest.raises(UsageError, match="1 to 50 characters, found ''"):
        proof([Inside({"angle": (-9.0, 9.0)}, name="")])


def test_times_mean_samples_where_they_are_near_them():
    """0.3 s at a period of 0.1 s is the third sample, though neither is a binary fraction."""
    made = proof([Inside({"angle": (-9.0, 9.0)}, when=(PERIOD * (2 + 1e-9), PERIOD * 2.5))])
    (one,) = made.requirements
    assert (one.first, one.last) == (2.0, 2.5)
    ends, parts = one.times(made.loop, 2)
    assert ends.nonzero()[:, 0].tolist() == [4, 5] and parts.nonzero()[:, 0].tolist() == [4]
