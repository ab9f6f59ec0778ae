"""Files that are made to mislead, to cost more than they are, or to end the checker with anything but an answer."""

import dataclasses
import time

import h5py
import numpy as np
import pytest
import torch
import yaml

from sagemp_cli.checker.check import check
from sagemp_cli.checker.document import KINDS
from sagemp_cli.errors import ArtifactError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.storage import Counterexample

from .conftest import STEP, constants_of, slots_of

HUGE = 10**400
NOT_READ = "not a certificate, or a damaged one"


def edited(edit):
    """A change of the config, written as the stages write it."""

    def change(file):
        config = yaml.safe_load(file["config"].asstr()[()])
        edit(config)
        rewrite(file, yaml.safe_dump(config, sort_keys=True))

    return change


def rewrite(file, text):
    del file["config"]
    file.create_dataset("config", data=text, dtype=h5py.string_dtype())


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c["scene"]["obstacles"][0].update(center=[0.4, 0.0], radius=-0.5), "the radius of obstacle 'disc'"),
        (
            lambda c: c["scene"]["obstacles"][1].update(lower=[2.0, 1.0], upper=[-1.0, -1.0]),
            "a box whose corners are the wrong way round",
        ),
        (lambda c: c["scene"]["obstacles"][0].update(center="91"), "found something of type str"),
        (lambda c: c["scene"]["obstacles"][0].update(radius=True), "found something of type bool"),
        (lambda c: c["scene"]["obstacles"][0].update(radius=HUGE), "too large"),
        (lambda c: c["start"].update(angle=1.0), "the start says 'angle', which is not understood"),
        (lambda c: c["start"].update(radius=[HUGE] * 4), "too large"),
        (lambda c: c["disturbance"].update(lower=[-1.0] * 4), "the disturbance says 'lower'"),
        (lambda c: c.update(horizon=True), "the horizon is True"),
        (lambda c: c.update(horizon=8.5), "the horizon is 8.5"),
        (lambda c: c["start"].pop("radius"), "the start says 'center', which is not understood"),
    ],
)
def test_a_config_that_could_be_misunderstood_is_refused(edit, message, certificate, mutate, tmp_path):
    with pytest.raises(ArtifactError, match=r"/config") as error:
        check(mutate(certificate, tmp_path / "mutant.h5", edited(edit)))
    assert message in str(error.value)


ALIASES = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda t: "start:\n  center: [0.0, 0.0, 0.0, 1.0]\n  radius: [9.0, 9.0, 9.0, 9.0]\n" + t, "is there twice"),
        (lambda t: t.replace("horizon: 8", "horizon: 010"), "can be read in two ways"),
        (lambda t: t.replace("horizon: 8", "horizon: +8"), "could be misread"),
        (lambda t: ALIASES + t.replace("name: disc", "name: *a39"), "holds an alias"),
        (lambda t: "q: &q {dt: 0.2}\n" + t.replace("  dt: 0.1\n", "  <<: *q\n"), "can be read in two ways"),
        (lambda t: t + "z: " + "[" * 1500, "levels deep"),
        (lambda t: t + "z: " + "[" * 200_000, "characters, more than"),
    ],
)
def test_a_config_in_any_other_writing_is_refused(write, message, certificate, mutate, tmp_path):
    def change(file):
        rewrite(file, write(file["config"].asstr()[()]))

    with pytest.raises(ArtifactError, match=NOT_READ) as error:
        check(mutate(certificate, tmp_path / "mutant.h5", change))
    assert message in str(error.value)


def test_a_formula_that_divides_by_zero_proves_nothing(make, mutate, tmp_path):
    source = make("quadrotor", horizon=4).write(tmp_path / "source.h5")

    def change(file):
        constants = [constants_of(file, s) for s in slots_of(file, "constant")]
        inertia = next(c for c in constants if file[f"{STEP}/numbers"][c].tolist() == [0.5])
        file[f"{STEP}/numbers"][inertia] = 0.0

    report = check(mutate(source, tmp_path / "mutant.h5", change))
    assert report.answer == "UNKNOWN" and report.findings[0].reason


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: g.attrs.__setitem__("lookahead", 2), "its operands have 8 and 12 entries"),
        (lambda g: g.attrs.__setitem__("lookahead", -1), "lookahead is -1"),
        (lambda g: g.attrs.__setitem__("lookahead", 10**12), "lookahead is 10000"),
        (lambda g: put(g, "position", np.array([0, 4])), "must be entries of 4 states"),
        (lambda g: put(g, "position", np.array([1, 1])), "names a state twice"),
        (lambda g: put(g, "position", np.array([0.0, 1.0])), "must be entries of 4 states"),
        (lambda g: put(g, "position", np.array([0])), "the dimensions of 1 positions and 4 states"),
        (lambda g: put(g, "step_program", np.zeros(7, np.int64)), "must be 8 numbers of its 1 programs"),
        (lambda g: put(g, "step_program", np.ones(8, np.int64)), "must be 8 numbers of its 1 programs"),
        (lambda g: put(g, "step_program", -np.ones(8, np.int64)), "must be 8 numbers of its 1 programs"),
        (lambda g: put(g, "state_names", ["px", "py", "theta"]), "must name 4 states and 2 controls"),
        (lambda g: put(g, "state_names", ["px", "px", "theta", "v"]), "has a name twice"),
        (lambda g: put(g, "state_names", ["p" * 99, "py", "theta", "v"]), "in short words"),
        (lambda g: put(g, "more", np.zeros(2)), "/data/loop holds 'more', which no certificate does"),
        (lambda g: g.__delitem__("programs/000000"), "needs a program"),
    ],
)
def test_a_loop_that_makes_no_sense_is_refused(change, message, certificate, mutate, tmp_path):
    with pytest.raises(ArtifactError) as error:
        check(mutate(certificate, tmp_path / "mutant.h5", lambda file: change(file["data/loop"])))
    assert message in str(error.value)


def put(group, name, values):
    if name in group:
        del group[name]
    group.create_dataset(name, data=values, dtype=h5py.string_dtype() if isinstance(values, list) else None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: put(g, "outputs", np.array([0, 1])), "outputs must be three slots"),
        (lambda g: put(g, "outputs", np.array([-1, -1, -1])), "outputs are -1"),
        (lambda g: put(g, "outputs", np.array([0, 99, -1])), "outputs are 0, 99"),
        (lambda g: put(g, "sizes", g["sizes"][()] + 1), "sizes are not those of its instructions' results"),
        (lambda g: put(g, "operand_begin", g["operand_begin"][()][::-1]), "operand_begin does not take operands apart"),
        (lambda g: put(g, "operand_begin", g["operand_begin"][()][:-1]), "with"),
        (lambda g: put(g, "numbers", g["numbers"][()][:-1]), "number_begin does not take numbers apart"),
        (lambda g: put(g, "numbers", g["numbers"][()].astype("f4")), "must be a list of float64"),
        (lambda g: put(g, "operands", np.full_like(g["operands"][()], 10**9)), "only earlier ones are there"),
        (lambda g: put(g, "kinds", g["kinds"].asstr()[()][:-1].tolist()), "must be a list of int64 with"),
        (lambda g: put(g, "kinds", [*g["kinds"].asstr()[:-1], "x" * 10**6]), "there is no such instruction"),
    ],
)
def test_a_program_that_makes_no_sense_is_refused(change, message, certificate, mutate, tmp_path):
    with pytest.raises(ArtifactError) as error:
        check(mutate(certificate, tmp_path / "mutant.h5", lambda file: change(file[STEP])))
    assert message in str(error.value) and len(str(error.value)) < 400


def hostile(kinds, reads, numbers=(), entries=(), outputs=(0, -1, -1)):
    """A program of any lines, with the constants and entries of the last one."""

    def change(file):
        group, count = file[STEP], len(kinds)
        put(group, "kinds", list(kinds))
        put(group, "sizes", np.full(count, 4))
        put(group, "operand_begin", np.cumsum([0, *map(len, reads)]))
        put(group, "operands", np.array([r for some in reads for r in some], np.int64))
        for name, begin, values in (("numbers", "number_begin", numbers), ("indices", "index_begin", entries)):
            put(group, begin, np.array([0] * count + [len(values)]))
            put(group, name, np.array(values, np.float64 if name == "numbers" else np.int64))
        put(group, "outputs", np.array(outputs))

    return change


START, READS = ["state", "disturbance", "numbers"], [(), (), ()]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (hostile([*START, "neg"], [*READS, (3,)]), "only earlier ones are there"),
        (hostile([*START, "neg", "neg"], [*READS, (4,), (3,)]), "only earlier ones are there"),
        (hostile([*START, *["join"] * 60], [*READS, *[(i, i) for i in range(2, 62)]]), "more than 200000 entries"),
        (hostile([*START, *["neg"] * 10_000], [*READS, *[(0,)] * 10_000]), "too many texts|more than 10000"),
        (hostile([*START, *["sin"] * 9_000], [*READS, *[(i,) for i in range(2, 9_002)]]), "more than 20000000"),
        (hostile([*START, "pick"], [*READS, (0,)], entries=[0] * 300_000), "more than 200000 entries"),
        (hostile([*START, "constant"], [*READS, ()], numbers=[np.nan]), "its constants must be finite"),
        (hostile([*START, "linear"], [*READS, (0,)], numbers=[np.inf] * 20), "its constants must be finite"),
        (hostile([*START, "join"], [*READS, (0,) * 300_000]), "more than 200000 entries"),
    ],
)
def test_a_hostile_program_ends_in_one_line_at_once(change, message, certificate, mutate, tmp_path):
    path = mutate(certificate, tmp_path / "mutant.h5", change)
    began = time.perf_counter()
    with pytest.raises(ArtifactError) as error:
        check(path)
    assert time.perf_counter() - began < 60
    assert any(m in str(error.value) for m in message.split("|"))
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def many_names(file):
    """Fourteen groups, each with ten names in the one before: 10^13 paths."""
    group = file.create_group("many")
    for _ in range(13):
        inner = group.create_group("0")
        for i in range(1, 10):
            group[str(i)] = inner
        group = inner


def nothing_stored(file):
    file.create_dataset("data/large", shape=(2**40,), dtype="f8", chunks=(2**20,))


def one_text_for_all(file):
    count = 10_000
    texts = file.create_dataset("data/texts", shape=(count,), dtype=h5py.string_dtype(), chunks=(count,))
    texts[0] = "x" * 60_000
    file.flush()
    first = texts.id.read_direct_chunk((0,))[1][:16]
    texts.id.write_direct_chunk((0,), first * count)
    for i in range(2):
        copy = file.create_dataset(f"data/same{i}", shape=(count,), dtype=h5py.string_dtype(), chunks=(count,))
        copy.id.write_direct_chunk((0,), first * count)


def lists_of_any_length(file):
    file.create_dataset("data/lists", shape=(2,), dtype=h5py.vlen_dtype("f8"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (many_names, "an object in it has several names"),
        (nothing_stored, "it unpacks into far more than a file of its size holds"),
        (one_text_for_all, "it unpacks into far more|too many texts"),
        (lists_of_any_length, "it holds lists of any length"),
    ],
)
def test_a_file_that_unpacks_into_more_than_it_can_hold_is_refused_at_once(
    change, message, certificate, mutate, tmp_path
):
    with pytest.raises(ArtifactError, match=message):
        check(mutate(certificate, tmp_path / "mutant.h5", change, rehash=False))


def test_of_constraints_with_one_name_the_nearest_is_reported(certificate, mutate, tmp_path):
    def change(file):
        edited(lambda c: [o.update(name="tree") for o in c["scene"]["obstacles"]])(file)
        file["data/tubes/constraint_names"][...] = ["workspace", "tree", "tree"]

    nearest = check(certificate).findings[0].clearance
    assert nearest["disc"] < nearest["wall"]
    found = check(mutate(certificate, tmp_path / "mutant.h5", change)).findings[0].clearance
    assert found == {"workspace": nearest["workspace"], "tree": nearest["disc"]}


def test_a_library_is_not_falsified_by_saying_so(make, mutate, tmp_path):
    def change(file):
        file.attrs["schema"], file.attrs["schema_version"] = "sagemp/library", KINDS["sagemp/library"]
        file["data"].attrs["verdict"] = "FALSIFIED"

    path = make(disc=[0.4, 0.3]).write(tmp_path / "unknown.h5")
    assert check(mutate(path, tmp_path / "mutant.h5", change)).answer == "UNKNOWN"


def test_what_begins_outside_the_configs_sets_refutes_nothing(case, mutate, tmp_path):
    loop = ClosedLoop(case.problem.dynamics, case.tracker, torch.from_numpy(case.tubes.references[0]))
    start = torch.tensor([0.4, 0.9, 0.0, 1.0], dtype=torch.float64)  # in the disc
    w = torch.zeros(8, 4, dtype=torch.float64)
    tubes = dataclasses.replace(
        case.tubes,
        verdict=("UNSAFE",),
        step=np.array([0]),
        fraction=np.array([0.0]),
        constraint=("disc",),
        start_lower=np.full((1, 4), -5.0),
        start_upper=np.full((1, 4), 5.0),
    )
    example = Counterexample(
        reference=0, kind="collision", step=0, fraction=0.0, constraint="disc", depth=0.4,
        states=loop.rollout(start, w)[0].detach().numpy(), disturbances=w.numpy(),
    )  # fmt: skip
    path = case.write(tmp_path / "certificate.h5", tubes=tubes, verdict="FALSIFIED", counterexamples=(example,))
    assert check(path).answer == "UNKNOWN"
