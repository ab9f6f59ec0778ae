"""Certificates of controls that lag: proved, printed as that, and no more believed than others."""

import dataclasses

import h5py
import numpy as np
import pytest
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.checker.claim import claim_rows
from sagemp_cli.cli.verdict import lag_words
from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.pipeline.against import differences
from sagemp_cli.pipeline.tubes import counterexample_record, tubes_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.continuous import propagation
from sagemp_cli.sets import Box
from sagemp_cli.stages.against_plant import plant_differences
from sagemp_cli.stages.export_monitor import export_monitor
from sagemp_cli.stages.prove_ode import Plant
from sagemp_cli.verification.attack.refutation import FalsifierOptions, attack
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verification import verify_references

from .conftest import make_case
from .continuous import flow_case


def lag(delay, jitter):
    return Box(*(torch.tensor([d, j], dtype=torch.float64) for d, j in zip(delay, jitter, strict=True)))


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    where = tmp_path_factory.mktemp("lag") / "certificate.h5"
    flow_case(where, horizon=3, lag=lag((0.0, 0.12), (0.005, 0.02)))
    return where


@pytest.mark.parametrize(
    ("late", "options"),
    [
        (lag((0.0, 0.05), (0.0, 0.0)), {"substeps": 1}),
        (lag((0.1, 0.1), (0.0, 0.0)), {"substeps": 4, "order": 3}),
        (lag((0.0, 0.0), (0.0, 0.03)), {"substeps": 2, "order": 1}),
        (lag((0.02, 0.2), (0.0, 0.0)), {"substeps": 2}),
    ],
)
def test_a_lagging_control_is_proved_again(late, options, tmp_path):
    path = tmp_path / "certificate.h5"
    flow_case(path, horizon=3, lag=late, **options)
    report = check(path)
    assert report.answer == "VERIFIED", report.findings[0].reason


def test_the_claim_says_when_the_control_is_measured_and_in_force(path, tmp_path):
    assert check(path).answer == "VERIFIED"
    rows = dict(claim_rows(check(path).document))
    assert rows["control"].startswith(
        "of x(t_k - j_k), t_k = k dt, j_k in [0.005, 0.02] s; in force from t_k + d_k, d_k in [0.0, 0.12] s, on until "
        "the next one is; whatever each of them is, but d_0 = j_0 = 0; "
    )
    plain = tmp_path / "plain.h5"
    flow_case(plain, horizon=3)
    assert dict(claim_rows(check(plain).document))["control"].startswith("of x(t_k) at t_k = k dt, held on ")


def put(name, index, value):
    def change(file):
        data = file[f"data/tubes/flow/{name}"]
        data[index] = value(data[index])

    return change


def bounds(delay, jitter):
    def change(file):
        file["data/loop/lag"][...] = [delay, jitter]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            put("jump", (0, 2, 1, 2), lambda v: v * 0.5),
            "cell 0, step 2: part 1: a late control changes the rate of",
        ),
        (put("jump", (1, 1, 0, 2), lambda v: -v), "cell 1, step 1: part 0: a late control changes the rate of state 2"),
        (put("jump", (0, 0, 0, 2), lambda v: 1.0), "cell 0, step 0: part 0: a control is said to change that is not"),
        (put("drift", (0, 1, 0, 0), lambda v: v * 0.5), "cell 0, step 1: part 0: state 0 may drift farther"),
        (put("upper", (1, 2, 0, 1), lambda v: v - 0.02), "cell 1, step 2: part 0: the flow of state 1"),
        (put("remainder_upper", (0, 1, 1, 0), lambda v: v * 0.5), "cell 0, step 1: part 1: the remainder of state 0"),
        (put("curve", (0, 1, 0, 0), lambda v: v * 0.3), "cell 0, step 1: part 0: the path of state 0 may bend more"),
        (put("measured_upper", (1, 2, 0), lambda v: v * 0.1 - 1e-9), "step 2: what is left out of the measured state"),
        (put("measured_lower", (0, 1, 1), lambda v: 1e-9), "step 1: what is left out of the measured state 1"),
        (put("measured_upper", (0, 0, 0), lambda v: -1e-300), "cell 0, step 0: of the first measured state"),
        (put("measured_lower", (0, 1, 1), lambda v: np.nan), "finite"),
        (put("jump", (0, 1, 0, 0), lambda v: np.inf), "finite"),
        (bounds([0.0, 0.13], [0.005, 0.02]), ""),
        (bounds([0.0, 0.12], [0.005, 0.03]), ""),
        (bounds([0.0, 0.12], [0.0, 0.02]), ""),
    ],
)
def test_what_is_not_so_is_not_proved(change, message, path, mutate, tmp_path):
    report = check(mutate(path, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and message in report.findings[0].reason


def without(name):
    return lambda file: file.__delitem__(name)


def test_a_loop_whose_first_state_is_measured_wrong_is_not_the_one_that_is_claimed(tmp_path, monkeypatch):
    """The sets are right for it, and so are their relaxations: what is wrong is one number of the file."""
    lagging, wrong = propagation._lagging, 0.02

    def forged(given, shares, guess, side):
        guess = guess.clone()
        guess[shares.jitter[1] == 0, :, -1] = wrong
        return lagging(given, shares, guess, side)

    monkeypatch.setattr(propagation, "_lagging", forged)
    case = flow_case(tmp_path / "certificate.h5", horizon=3, lag=lag((0.0, 0.12), (0.005, 0.02)), checked=False)
    flow = case.certificate.tubes.flow
    sides = {name: getattr(flow, name).copy() for name in ("measured_lower", "measured_upper")}
    for side in sides.values():
        assert not side[:, 0].any()
        side[:, 0] = wrong
    report = check(case.write(tmp_path / "forged.h5", flow=dataclasses.replace(flow, **sides)))
    assert report.answer == "UNKNOWN" and "step 0: of the first measured state" in report.findings[0].reason


@pytest.mark.parametrize("name", ["data/tubes/flow/jump", "data/tubes/flow/measured_upper"])
def test_bounds_that_are_not_there_are_none(name, path, mutate, tmp_path):
    assert check(mutate(path, tmp_path / "mutant.h5", without(name))).answer == "UNKNOWN"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("data/loop/lag"), "relaxations/slope must be float64 of shape"),
        (bounds([0.0, 0.19], [0.0, 0.02]), "more than a period"),
        (bounds([0.05, 0.04], [0.0, 0.02]), "no two intervals"),
        (bounds([0.0, np.nan], [0.0, 0.02]), "no two intervals"),
        (bounds([-0.01, 0.1], [0.0, 0.02]), "no two intervals"),
        (bounds([0.0, 0.0], [0.0, 0.02]), "must be float64 of shape"),
    ],
)
def test_a_lag_that_is_none_is_refused(change, message, path, mutate, tmp_path):
    with pytest.raises(ArtifactError, match=message):
        check(mutate(path, tmp_path / "mutant.h5", change))


def test_a_lag_without_continuous_time_is_refused(certificate, mutate, tmp_path):
    def late(file: h5py.File) -> None:
        file["data/loop"].create_dataset("lag", data=np.zeros((2, 2)))

    with pytest.raises(ArtifactError, match="continuous"):
        check(mutate(certificate, tmp_path / "mutant.h5", late))


def test_our_own_robots_lag_and_a_check_holds_that_against_what_is_asked(tmp_path):
    case = make_case(time="continuous", lag={"delay": 0.03, "jitter": 0.01})
    report = check(case.write(tmp_path / "certificate.h5"))
    assert report.answer == "VERIFIED"
    asked = case.config | {"dynamics": case.config["dynamics"] | {"delay": [0.01, 0.02], "jitter": 0.02}}
    found = {d.what: (d.proved, d.asked, d.covers) for d in differences(report, asked)}
    assert found["delay"] == ("0 to 0.03 s", "0.01 to 0.02 s", True)
    assert found["jitter"] == ("0 to 0.01 s", "0 to 0.02 s", False)


def test_what_the_attack_refutes_under_a_lag_the_checker_refutes(tmp_path):
    late = {"delay": [0.02, 0.05], "jitter": [0.0, 0.02]}
    made = make_case(time="continuous", disc=[0.4, 0.45], lag=late)
    found = verify_references(
        CellProver(Affine(), made.problem, made.tracker), torch.from_numpy(made.tubes.references), counts=[2, 1]
    )
    refuted = attack(
        found, made.problem, tracker=made.tracker, generator=torch.Generator().manual_seed(0),
        options=FalsifierOptions(restarts=2),
    )  # fmt: skip
    ((r, example),) = refuted.counterexamples
    assert example.disturbances.shape == (8, 6) and example.disturbances[:, 4].max() > 0.02
    record = counterexample_record(r, example, "disc")
    write = {"tubes": tubes_record(refuted.verification), "verdict": "FALSIFIED"}
    path = made.write(tmp_path / "certificate.h5", counterexamples=(record,), **write)
    report = check(path)
    assert report.answer == "FALSIFIED" and report.counterexamples == ((0, ""),)
    late = record.disturbances.copy()
    late[3, 4] = 0.06
    path = made.write(tmp_path / "other.h5", counterexamples=(dataclasses.replace(record, disturbances=late),), **write)
    assert check(path).counterexamples == ((0, "its delays and jitters are not within their bounds"),)


@pytest.mark.parametrize(
    ("delay", "jitter", "words"),
    [
        ((0.0, 0.02), (0.0, 0.0), "up to 0.02 s late"),
        ((0.02, 0.02), (0.001, 0.005), "0.02 s late, of a state 0.001 to 0.005 s old"),
        ((0.0, 0.0), (0.0, 0.01), "of a state up to 0.01 s old"),
    ],
)
def test_a_verdict_says_how_late_a_control_may_be(delay, jitter, words):
    assert lag_words([delay, jitter]) == words


@pytest.mark.parametrize(
    ("late", "missing"), [(((0.0, 0.05), (0.0, 0.02)), []), (((0.05, 0.05), (0.01, 0.02)), ["delay", "jitter"])]
)
def test_a_robot_whose_control_is_there_at_once_is_not_one_that_is_always_late(late, missing, tmp_path):
    (least, most), (newest, oldest) = late
    case = flow_case(tmp_path / "certificate.h5", horizon=3, lag=lag((least, most), (newest, oldest)))
    sides = Box(*(torch.tensor(case.config["start"][side], dtype=torch.float64) for side in ("lower", "upper")))
    loop = case.loop
    plant = Plant(loop.rate, lambda x: loop.control_given(None, x), 0.2, 3, sides, case.disturbance, None, ())
    report = check(tmp_path / "certificate.h5")
    assert report.answer == "VERIFIED"
    found = plant_differences(report, plant)
    assert {d.what for d in found} == {"delay", "jitter"}
    assert [d.what for d in found if not d.covers] == missing


def test_a_control_that_looks_ahead_is_not_one_of_the_state_alone(tmp_path):
    case = make_case(time="continuous")
    report = check(case.write(tmp_path / "certificate.h5"))
    start = Box(*(torch.from_numpy(getattr(case.tubes, f"start_{side}")[0]) for side in ("lower", "upper")))
    plant = Plant(lambda x, u: x + u[..., :1], lambda x: x, 0.05, 8, start, None, None, ())
    found = {d.what: (d.covers, d.proved) for d in plant_differences(report, plant)}
    assert found["control"][0] is False and "points of a reference" in found["control"][1]


def test_a_monitor_of_older_states_is_refused(path, tmp_path):
    with pytest.raises(UsageError, match="what is measured is up to 0.02 s old"):
        export_monitor(path, tmp_path / "monitor.npz")
