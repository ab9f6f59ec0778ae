"""Certificates of a learned robot: proved from the file alone, with the weights that it holds, for both models."""

import copy
import dataclasses

import h5py
import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.errors import ArtifactError
from sagemp_cli.pipeline.models import weights_of
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.storage import TrueModel
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.deviation import Folded, split
from sagemp_cli.verification.verification import verify_references

FIRST = "data/dynamics/layers.0.weight"


@pytest.fixture(scope="module")
def write(case):
    """``write(path, robot, section)`` writes the certificate of the small unicycle case with a learned robot."""

    def write(path, robot, section):
        problem, references = dataclasses.replace(case.problem, dynamics=robot), torch.from_numpy(case.tubes.references)
        own, true = (
            verify_references(CellProver(propagator, problem, case.tracker), references, counts=[2, 1])
            for propagator in (Affine(), Folded(Affine()))
        )
        true, deviation = split(true, 2)
        learned = dataclasses.replace(case, config=case.config | {"dynamics": section}, tubes=tubes_record(own))
        record = TrueModel(tubes=tubes_record(true), deviation=deviation.numpy())
        return learned.write(path, dynamics=weights_of(robot), true_model=record)

    return write


@pytest.fixture
def learned(write, learned_unicycle, tmp_path):
    section = copy.deepcopy(learned_unicycle.__defaults__[0])
    return write(tmp_path / "learned.h5", learned_unicycle(section), section)


def test_both_the_network_and_its_model_are_proved(learned):
    report = check(learned)
    assert report.answer == "VERIFIED" and report.problems == ()
    assert [f.proved for f in report.findings] == [f.proved for f in report.true_model] == [True]
    assert report.true_model[0].clearance["disc"] < report.findings[0].clearance["disc"]


def test_a_changed_weight_is_refused_by_the_hash(learned, mutate, tmp_path):
    def change(file):
        file[FIRST][0, 2] = 0.1000001

    with pytest.raises(ArtifactError, match="the content was changed after it was written"):
        check(mutate(learned, tmp_path / "mutant.h5", change, rehash=False))


@pytest.mark.parametrize("place", [("0.weight", (1, 3), 0.12), ("1.weight", (0, 1), 0.4), ("2.bias", (1,), 0.3)])
def test_a_network_with_other_weights_is_not_proved(learned, mutate, tmp_path, place):
    name, index, value = place

    def change(file):
        file[f"data/dynamics/layers.{name}"][index] = value

    report = check(mutate(learned, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and not report.findings[0].proved


def test_a_smaller_deviation_is_not_believed_and_the_whole_file_is_not_proved(learned, mutate, tmp_path):
    def change(file):
        file["data/true_model/deviation"][0, 5, 1] *= 0.5

    report = check(mutate(learned, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and report.findings[0].proved and not report.true_model[0].proved
    assert report.problems[0].startswith(
        "the analytical model, reference 0: cell 0, step 5: deviation in state 1 is only"
    )


def test_a_narrower_fold_is_not_believed(learned, mutate, tmp_path):
    def change(file):
        group = file["data/true_model/tubes/relaxations"]
        assert group["operations"].asstr()[-1] == "identity"
        group["radius"][:, 4, -3] *= 0.5

    report = check(mutate(learned, tmp_path / "mutant.h5", change))
    assert "a recorded relaxation of 'identity' is wrong" in report.problems[0]


def test_the_networks_tube_does_not_pass_for_that_of_a_drifting_model(write, learned_unicycle, mutate, tmp_path):
    section = copy.deepcopy(learned_unicycle.__defaults__[0])
    path = write(tmp_path / "drifting.h5", learned_unicycle(section, drift=0.2), section)
    assert check(path).true_model[0].proved

    def change(file):
        for name in ("tube_lower", "tube_upper"):
            file["data/true_model/tubes"][name][()] = file["data/tubes"][name][()]

    report = check(mutate(path, tmp_path / "mutant.h5", change))
    assert report.findings[0].proved and not report.true_model[0].proved and report.answer == "UNKNOWN"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.__delitem__("data/dynamics"), "/data/true_model needs a learned robot"),
        (lambda file: file.__delitem__(FIRST), "dynamics: weight 'layers.0.weight' is missing"),
        (lambda file: file[FIRST].__setitem__((0, 0), np.nan), "dynamics: weight 'layers.0.weight' must be finite"),
        (
            lambda file: file["data/dynamics"].create_dataset("more", data=[1.0]),
            "dynamics: weight 'more' is not understood",
        ),
        (lambda file: file.__delitem__("data/true_model/deviation"), "not a certificate, or a damaged one"),
    ],
)
def test_a_file_whose_weights_are_not_those_of_its_robot_is_refused(learned, mutate, tmp_path, change, message):
    with pytest.raises(ArtifactError, match=message):
        check(mutate(learned, tmp_path / "mutant.h5", change))


def test_weights_beside_a_robot_of_formulas_are_refused(case, mutate, certificate, tmp_path):
    def change(file):
        file["data"].create_group("dynamics").create_dataset("layers.0.weight", data=np.zeros((2, 2)))

    with pytest.raises(ArtifactError, match="dynamics: weight 'layers.0.weight' is not understood"):
        check(mutate(certificate, tmp_path / "mutant.h5", change))


def test_references_of_the_two_claims_must_be_the_same(learned, mutate, tmp_path):
    def change(file):
        file["data/true_model/tubes/references"][0, 3, 0] += 1e-9

    assert any("its references are others" in p for p in check(mutate(learned, tmp_path / "m.h5", change)).problems)


def test_the_command_says_what_is_proved_of_which_model(learned):
    from sagemp_cli.cli.check import as_data, as_lines

    report = check(learned)
    assert "  the robot is a network learned from an analytical model; of that model itself:" in as_lines(report)
    assert as_data(report)["true_model"][0]["proved"] is True
    with h5py.File(learned) as file:
        assert set(file["data/dynamics"]) == {f"layers.{i}.{name}" for i in range(3) for name in ("weight", "bias")}
