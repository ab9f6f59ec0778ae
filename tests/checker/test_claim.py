"""What is printed of a certificate: the claim in full, equations that are the program, and what is only said."""

import dataclasses
import math

import numpy as np
import pytest

from sagemp_cli.checker.check import check, recheck
from sagemp_cli.checker.claim import claim_lines, claim_rows, disturbed, said_rows
from sagemp_cli.checker.document import read_document
from sagemp_cli.checker.equations import Names, equations

from .by_hand import line, program, run
from .test_untrusted_file import edited

CLAIMED = {
    "X_I": lambda c: c["start"].update(radius=[0.01, 0.0, 0.0, 0.0]),
    "W": lambda c: c["disturbance"].update(radius=[0.0] * 4),
    "obstacle": lambda c: [o.update(radius=0.0) for o in c["scene"]["obstacles"] if o["kind"] == "ball"],
    "workspace": lambda c: c["scene"]["workspace"].update(lower=[-99.0, -99.0]),
    "goal at K": lambda c: c["scene"]["goal"].update(lower=[-9.0] * 4),
}


def rows(path):
    found = {}
    for label, text in claim_rows(read_document(path)):
        found.setdefault(label, []).append(text)
    return found


@pytest.mark.parametrize("part", CLAIMED)
def test_an_easier_claim_is_printed_as_one(part, certificate, mutate, tmp_path):
    before = rows(certificate)
    after = rows(mutate(certificate, tmp_path / "easier.h5", edited(CLAIMED[part])))
    assert [label for label in before if before[label] != after[label]] == [part]


def test_the_claim_is_there_in_full_with_names_and_units(certificate):
    found = {label: texts[0] for label, texts in rows(certificate).items()}
    assert found["X_I"] == "px -0.05 to 0.05 m, py -0.04 to 0.04 m, theta 0 rad, v 1 m/s"
    assert found["W"].startswith("w_px -0.05 to 0.05, w_py 0, ")
    assert found["w enters"] == "px + 0.1 w_px, py + 0.1 w_py, theta + 0.1 w_theta, v + 0.1 w_v"
    assert found["for"].endswith("K = 8 steps")
    assert found["between"].startswith("segments: the safe set is kept over the whole of every step, on the straight")
    assert found["obstacle"] == "disc: ball around (0.4, 1), radius 0.5"
    assert found["goal at K"].startswith("px 0.3 to 1.3 m") and "turn_rate" in found["controls"]
    assert found["reference 0"].startswith("from px 0, py 0, theta 0, v 1 to px 0.8")
    assert found["step"].startswith("formulas of ") and "cos, sin, product" in found["step"]


def test_a_claim_about_the_samples_alone_is_printed_as_one(certificate, mutate, tmp_path):
    def change(file):
        file["data/tubes"].attrs.update(between="samples", parts=1)

    path = mutate(certificate, tmp_path / "samples.h5", change)
    assert "of the time between them NOTHING is claimed" in rows(path)["between"][0]
    assert check(path).answer == "VERIFIED"  # it is less than what was proved


def test_what_is_only_said_stands_apart(certificate):
    document = read_document(certificate)
    lines = claim_lines(document, "this is proved:")
    apart = lines.index("this is said by the file, not proved:")
    assert lines[0] == "this is proved:" and not any("small_unicycle" in text for text in lines[:apart])
    said = dict(said_rows(document))
    assert said["experiment"] == "small_unicycle" and said["between samples"] == "0.1 s" and said["robot"] == "unicycle"


FORMULAS = [
    line("pick", 0, entries=[0]), line("pick", 0, entries=[1]), line("sin", 2), line("mul", 3, 4), line("sub", 3, 5),
    line("neg", 6), line("constant", constants=[0.25]), line("mul", 8, 7), line("add", 9, 2), line("div", 10, 8),
    line("linear", 0, constants=[1, -2, 0.5, 3, -1, 0]), line("pick", 12, entries=[1]), line("pow", 13, constants=[3]),
    line("sub", 11, 14), line("join", 15, 13), line("add", 16, 1), line("maximum", 17, 12), line("reciprocal", 18),
    line("leaky_relu", 19, constants=[0.1]), line("sub", 18, 20), line("mul", 21, 12),
]  # fmt: skip


def test_equations_say_what_the_program_does():
    made = program(*FORMULAS, next=2 + len(FORMULAS) - 1)
    lines = equations(made, Names(["a", "b"], [], ["w"]))
    values = {
        "sin": math.sin, "maximum": max, "leaky_relu": lambda x, s: max(x, s * x), "a": 0.7, "b": -0.3, "w": 0.2,
    }  # fmt: skip
    for text in lines:
        name, _, formula = text.partition(" = ")
        for old in [n for n in values if "[" in n]:
            formula = formula.replace(old, old.replace("[", "_").replace("]", ""))
        known = {n.replace("[", "_").replace("]", ""): v for n, v in values.items()}
        values[name] = eval(formula.replace("^", "**"), {}, known)
    wanted = run(made, np.array([[0.7, -0.3]]), np.array([[0.2]]))[0]
    np.testing.assert_allclose([values["a'"], values["b'"]], wanted, rtol=1e-5)


def test_where_w_is_not_added_as_a_multiple_is_not_said_to_be():
    assert disturbed(program(line("mul", 0, 1), next=2)) is None
    assert disturbed(program(line("sin", 1), line("add", 0, 2), next=3)) is None
    np.testing.assert_array_equal(disturbed(program(line("neg", 0), next=2)), np.zeros((2, 1)))
    alike = program(line("identity", 1), line("add", 0, 2), next=3)
    np.testing.assert_array_equal(disturbed(alike), [[1.0], [1.0]])
    scaled = program(line("constant", constants=[3.0]), line("mul", 1, 2), line("add", 0, 3), next=4)
    np.testing.assert_array_equal(disturbed(scaled), [[3.0], [3.0]])


def test_a_recheck_finds_what_a_file_says_about_itself_and_not_its_reach_sets(certificate, mutate, tmp_path):
    assert recheck(certificate) == ""

    def far(file):
        file["data/tubes/clearance"][...] = 9.9

    def tight(file):
        file["data/tubes/tube_upper"][0, 3, 2] -= 1e-3

    found = mutate(certificate, tmp_path / "far.h5", far)
    assert "the clearance to" in recheck(found) and "the file says 9.9" in recheck(found)
    path = mutate(certificate, tmp_path / "tight.h5", tight)
    assert recheck(path) == "" and check(path).answer == "UNKNOWN"


def test_a_counterexample_that_fails_is_named(make, mutate, tmp_path):
    from sagemp_cli.cli.check import as_lines

    from .test_check import falsified

    report = check(falsified(make(), tmp_path / "clear.h5"))
    assert report.counterexamples == ((0, "its replay violates nothing for certain at step 8"),)
    assert any("counterexample to reference 0: NOT PROVED: its replay violates" in text for text in as_lines(report))


def test_a_control_that_is_the_state_itself_is_a_control_too(certificate):
    own = program(line("add", 0, 1), n=4, d=4, next=2, control=0)
    found = claim_rows(dataclasses.replace(read_document(certificate), programs=(own,)))
    assert "control" in [label for label, _ in found]
