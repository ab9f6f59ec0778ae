"""Certificates of a learned robot: proved from the file alone, with the weights that it holds, for both models."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.checker.claim import claim_rows
from sagemp_cli.dynamics.unicycle import Unicycle
from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.identification.transitions import Transitions, domain_of
from sagemp_cli.pipeline.loop_record import deviation_record
from sagemp_cli.pipeline.true_model import split
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.sets import Between
from sagemp_cli.storage import TrueModel
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verification import verify_references

from .conftest import STEP, constants_of, slots_of

TRUE = "data/true_model/program"


def layer(file, i, program=STEP):
    """Where matrix and bias of a layer of the robot's network are in the numbers of a program."""
    control = file[f"{program}/outputs"][1]
    return constants_of(file, [s for s in slots_of(file, "linear", program) if s > control][i], program)


@pytest.fixture(scope="module")
def write(case):
    """``write(path, robot, section)`` writes the certificate of the small unicycle case with a learned robot."""

    def write(path, robot, section):
        problem, references = dataclasses.replace(case.problem, dynamics=robot), torch.from_numpy(case.tubes.references)
        own, true = (
            verify_references(CellProver(Affine(), problem, case.tracker, compared), references, counts=[2, 1])
            for compared in (False, True)
        )
        true, deviation = split(true, 2)
        learned = dataclasses.replace(
            case, config=case.config | {"dynamics": section}, problem=problem, tubes=tubes_record(own)
        )
        record = TrueModel(
            program=deviation_record(problem, case.tracker), tubes=tubes_record(true), deviation=deviation.numpy()
        )
        return learned.write(path, true_model=record)

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


@pytest.mark.parametrize("place", [(0, 9, 0.12), (1, 1, 0.4), (2, 17, 0.3)])
def test_a_network_with_other_weights_is_not_proved(learned, mutate, tmp_path, place):
    number, entry, value = place

    def change(file):
        for program in (STEP, TRUE):  # else the two are not of the same network, which is a reason of its own
            file[f"{program}/numbers"][layer(file, number, program).start + entry] = value

    report = check(mutate(learned, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and not report.findings[0].proved
    assert report.problems == () or "step" in report.problems[0]


def other_weight(file):
    file[f"{TRUE}/numbers"][layer(file, 0, TRUE).start] += 1e-9


def no_deviation(file):
    file[f"{TRUE}/outputs"][2] = 0


def not_folded(file):
    slot = slots_of(file, "identity", TRUE)[0]
    file[f"{TRUE}/kinds"][slot] = "neg"
    place = file["data/true_model/tubes/relaxations"]
    for name in ("slope", "offset", "radius"):
        values = place[name][()][..., :-4]
        del place[name]
        place[name] = values


def another_control(file):
    control, sizes = file[f"{TRUE}/outputs"][1], file[f"{TRUE}/sizes"][()]
    file[f"{TRUE}/outputs"][1] = next(i for i in range(control) if sizes[i] == sizes[control])


@pytest.mark.parametrize("change", [other_weight, no_deviation, not_folded, another_control])
def test_the_model_must_be_the_network_with_the_deviation_in_w(change, learned, mutate, tmp_path):
    report = check(mutate(learned, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN"
    assert report.problems[0] == (
        "the analytical model: its step is not that of the network with the deviation added to w"
    )


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
        assert slots_of(file, "identity", TRUE)
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


def test_a_model_without_bounds_of_its_deviation_is_refused(learned, mutate, tmp_path):
    with pytest.raises(ArtifactError, match="not a certificate, or a damaged one"):
        check(mutate(learned, tmp_path / "mutant.h5", lambda file: file.__delitem__("data/true_model/deviation")))


def test_weights_beside_the_program_are_refused(mutate, certificate, tmp_path):
    def change(file):
        file["data"].create_group("dynamics").create_dataset("layers.0.weight", data=np.zeros((2, 2)))

    with pytest.raises(ArtifactError, match="/data holds 'dynamics', which no certificate does"):
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


def test_a_network_as_the_right_hand_side_of_an_ode_is_proved_and_its_model_is_not(case, learned_unicycle, tmp_path):
    section = copy.deepcopy(learned_unicycle.__defaults__[0])
    section["model"]["time"] = "continuous"
    robot = learned_unicycle(section)
    problem = dataclasses.replace(case.problem, dynamics=robot, between=Between.CONTINUOUS)
    references = torch.from_numpy(case.tubes.references)
    found = verify_references(CellProver(Affine(), problem, case.tracker), references, counts=[2, 1])
    config = case.config | {"dynamics": section}
    made = dataclasses.replace(case, config=config, problem=problem, tubes=tubes_record(found))
    report = check(made.write(tmp_path / "ode.h5"))
    assert report.answer == "VERIFIED" and report.true_model is None
    assert "tanh" in dict(claim_rows(report.document))["ODE"]
    with pytest.raises(UsageError, match="by way of the network is in discrete time"):
        verify_references(CellProver(Affine(), problem, case.tracker, compared=True), references, counts=[2, 1])


def test_a_network_learns_the_rate_of_an_ode_and_the_increment_of_a_map():
    limits = {
        "control_lower": [-1.0] * 2,
        "control_upper": [1.0] * 2,
        "state_lower": [-1.0] * 4,
        "state_upper": [1.0] * 4,
    }
    for time in ("discrete", "continuous"):
        model = Unicycle(dt=0.5, time=time, **limits)
        made = Transitions.draw(model, domain_of(model), 50, torch.Generator().manual_seed(0))
        rates = model.derivative(*made.inputs.split([4, 2], dim=-1))
        torch.testing.assert_close(made.increments, rates, rtol=1e-12, atol=1e-12)
