import dataclasses
import shutil

import h5py
import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

from sagemp_cli import storage
from sagemp_cli.checker import document
from sagemp_cli.checker.check import check
from sagemp_cli.cli.main import app
from sagemp_cli.errors import ArtifactError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.storage import Counterexample
from sagemp_cli.storage.content import content_hash


def run(*arguments):
    return CliRunner().invoke(app, ["check", *map(str, arguments)])


@pytest.mark.parametrize("robot", ["unicycle", "planar_quadrotor", "quadrotor"])
@pytest.mark.parametrize("symbols", [None, 40])
def test_what_the_affine_propagator_certifies_is_proved_again(robot, symbols, make, tmp_path):
    case = make(robot, propagator=Affine(symbols=symbols), horizon=6)
    report = check(case.write(tmp_path / "certificate.h5"))
    assert report.answer == "VERIFIED" and not report.problems
    assert [f.proved for f in report.findings] == [True]
    assert report.cells == 2 and report.horizon == 6
    # What is proved here is at least what the certificate says.
    stored = dict(zip(case.tubes.constraint_names, case.tubes.clearance[0].tolist(), strict=True))
    assert all(stored[name] <= value + 1e-12 for name, value in report.findings[0].clearance.items())


def test_two_processes_find_the_same_as_one(case, certificate):
    one, two = check(certificate), check(certificate, processes=2)
    assert dataclasses.replace(one, seconds=0) == dataclasses.replace(two, seconds=0)


def test_every_reference_of_a_file_is_checked(make, mutate, tmp_path):
    path = make(side=0.1).write(tmp_path / "two.h5")
    assert [f.proved for f in check(path).findings] == [True, True]

    def shrink(file):
        file["data/tubes/tube_upper"][3, 4, 0] -= 0.05

    found = check(mutate(path, tmp_path / "mutant.h5", shrink))
    assert found.answer == "UNKNOWN" and [f.proved for f in found.findings] == [True, False]
    assert "cell 3, step 3: state 0 is only proved to lie in" in found.findings[1].reason


def test_what_the_file_does_not_claim_is_not_proved(make, tmp_path):
    path = make(disc=[0.4, 0.3]).write(tmp_path / "certificate.h5")
    report = check(path)
    assert (report.answer, report.claimed) == ("UNKNOWN", "UNKNOWN")
    assert report.findings[0].reason == "the file does not claim that it is safe"
    result = run(path)
    assert result.exit_code == 5 and "reference 0: MAY_COLLIDE" in result.output


def test_tubes_without_relaxations_cannot_be_checked(case, tmp_path):
    bare = dataclasses.replace(case.tubes, relaxations=None, propagator="auto_lirpa", rigorous=False)
    path = case.write(tmp_path / "certificate.h5", tubes=bare)
    report = check(path)
    assert report.answer == "UNKNOWN"
    assert report.problems == (
        "the tubes were made by propagator 'auto_lirpa', which records no relaxations: they cannot be checked",
    )
    assert run(path).exit_code == 5


def falsified(case, path, *, depth_step=8, fraction=0.0):
    """A certificate with a rollout through the disc."""
    loop = ClosedLoop(case.problem.dynamics, case.tracker, torch.from_numpy(case.tubes.references[0]))
    w = torch.zeros(8, 4, dtype=torch.float64)
    states, _ = loop.rollout(case.problem.start.center, w)
    unsafe = dataclasses.replace(case.tubes, verdict=("UNSAFE",), step=np.array([depth_step]), constraint=("disc",))
    example = Counterexample(
        reference=0, kind="collision", step=depth_step, fraction=fraction, constraint="disc", depth=0.1,
        states=states.detach().numpy(), disturbances=w.numpy(),
    )  # fmt: skip
    return case.write(path, tubes=unsafe, verdict="FALSIFIED", counterexamples=(example,))


def test_a_counterexample_is_replayed_and_proved(make, tmp_path):
    path = falsified(make(disc=[0.6, 0.3]), tmp_path / "certificate.h5")
    assert check(path).answer == "FALSIFIED"
    assert run(path).exit_code == 10


def test_a_counterexample_between_two_samples_is_proved_there_and_nowhere_else(make, mutate, tmp_path):
    case = make()
    case.config["scene"]["obstacles"][0].update(center=[0.45, 0.0], radius=0.03)  # between the samples at 0.4 and 0.5
    path = falsified(case, tmp_path / "certificate.h5", depth_step=4, fraction=0.5)
    assert check(path).answer == "FALSIFIED"

    def at(step, fraction, between="segments"):
        def change(file):
            file["data/counterexamples/000000"].attrs["step"] = step
            file["data/counterexamples/000000"].attrs["fraction"] = fraction
            file["data/tubes"].attrs.update(between=between, parts=1 if between == "samples" else 8)

        return check(mutate(path, tmp_path / "mutant.h5", change))

    for step, fraction in (
        (4, 0.0),
        (5, 0.0),
        (4, 0.05),
        (3, 0.5),
        (4, 1.5),
        (3, 1.5),
        (5, -0.5),
        (8, 0.5),
        (4, np.nan),
    ):
        assert at(step, fraction).answer == "UNKNOWN", (step, fraction)
    found = at(4, 0.5, "samples")  # of the time between the samples nothing is claimed there
    assert found.answer == "UNKNOWN" and "none that the claim speaks of" in found.counterexamples[0][1]


def test_a_counterexample_that_violates_nothing_or_cheats_proves_nothing(make, mutate, tmp_path):
    clear = falsified(make(), tmp_path / "clear.h5")
    assert check(clear).answer == "UNKNOWN"
    path = falsified(make(disc=[0.6, 0.3]), tmp_path / "certificate.h5")

    def outside_start(file):
        file["data/counterexamples/000000/states"][0, 0] = 0.5

    def outside_w(file):
        file["data/counterexamples/000000/disturbances"][2, 0] = 0.5

    for change in (outside_start, outside_w):
        assert check(mutate(path, tmp_path / "mutant.h5", change)).answer == "UNKNOWN"


def changed_somewhere(file):
    """Changes one thing after the other, and says where."""
    nodes = [("/", file)]
    file.visititems(lambda name, node: nodes.append((name, node)))
    for name, node in nodes:
        for key, value in list(node.attrs.items()):
            if not key.startswith(("DIMENSION", "content_sha256")):
                node.attrs[key] = value + "x" if isinstance(value, str) else value + 1
                yield f"{name}@{key}"
                node.attrs[key] = value
        if isinstance(node, h5py.Dataset) and node.size:
            value = node[()]
            if h5py.check_string_dtype(node.dtype):
                node[...] = "x"
            elif node.dtype.kind == "f":
                node[...] = np.nextafter(value, 9)
            else:
                node[...] = value + 1
            yield name
            node[...] = value


def test_the_hash_changes_with_anything_in_the_file(certificate, tmp_path):
    path = tmp_path / "copy.h5"
    shutil.copy(certificate, path)
    with h5py.File(path, "r+", driver="core", backing_store=False) as file:
        before, different = content_hash(file), {}
        for place in changed_somewhere(file):
            different[place] = content_hash(file) != before
        assert content_hash(file) == before == file.attrs["content_sha256"]
    assert len(different) > 80 and all(different.values())


@pytest.mark.parametrize(
    "name", ["config", "data/tubes/tube_lower", "data/tubes/relaxations/slope", "data/loop/programs/000000/numbers"]
)
def test_the_hash_alone_rejects_a_change(name, certificate, mutate, tmp_path):
    def change(file):
        file[name][...] = "x" if name == "config" else np.nextafter(file[name][()], 9)

    with pytest.raises(ArtifactError, match=r"the content was changed after it was written \(its hash differs\)"):
        check(mutate(certificate, tmp_path / "mutant.h5", change, rehash=False))


def test_a_hash_does_not_depend_on_how_the_file_is_stored(certificate, mutate, tmp_path):
    def repack(file):
        data = file["data/tubes/tube_lower"][()]
        attributes = dict(file["data/tubes/tube_lower"].attrs)
        del file["data/tubes/tube_lower"]
        node = file["data/tubes"].create_dataset("tube_lower", data=data, compression="gzip", compression_opts=9)
        for key, value in attributes.items():
            node.attrs[key] = value

    assert check(mutate(certificate, tmp_path / "packed.h5", repack, rehash=False)).answer == "VERIFIED"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.attrs.__setitem__("schema_version", 9), "format 9 of 'sagemp/certificate' is newer than this"),
        (
            lambda f: f.attrs.__setitem__("schema_version", 2),
            "format 2 of 'sagemp/certificate' is an old one, 4 can be checked; make it again with 'sagemp verify",
        ),
        (lambda f: f.attrs.update(schema_version=1, stage="prove"), "make it again with 'sagemp prove --overwrite'"),
        (lambda f: f.attrs.__setitem__("schema", "sagemp/tracker"), "only sagemp/certificate and sagemp/library can"),
        (lambda f: f.attrs.__delitem__("content_sha256"), "has no content hash"),
        (lambda f: f["data/tubes"].__setitem__("copy", h5py.SoftLink("/data")), "/data/tubes/copy is a link"),
        (lambda f: f["data/tubes"].__setitem__("out", h5py.ExternalLink("o.h5", "/")), "/data/tubes/out is a link"),
    ],
)
def test_a_file_that_is_no_certificate_of_this_format_is_refused(change, message, certificate, mutate, tmp_path):
    path = mutate(certificate, tmp_path / "mutant.h5", change, rehash=False)
    with pytest.raises(ArtifactError, match=message):
        check(path)
    result = run(path)
    assert result.exit_code == 2 and message in result.stderr


def test_a_class_that_the_config_names_is_not_looked_for(certificate, mutate, tmp_path):
    def change(file):
        text = file["config"].asstr()[()].replace("sagemp_cli.dynamics.unicycle.Unicycle", "os.system")
        del file["config"]
        file.create_dataset("config", data=text, dtype=h5py.string_dtype())

    assert check(mutate(certificate, tmp_path / "mutant.h5", change)).answer == "VERIFIED"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["scene"].update(holes=[]), "the scene says 'holes', which is not understood"),
        (lambda c: c["scene"]["obstacles"][1].update(yaw=1.0), "the scene says 'yaw', which is not understood"),
        (lambda c: c["scene"]["obstacles"][0].update(kind="torus"), "obstacle 'disc' is of unknown kind 'torus'"),
        (lambda c: c.pop("start"), "'start'"),
        (lambda c: c["start"].update(radius=["a", 0, 0, 0]), "a number is needed, found something of type str"),
        (lambda c: c.update(horizon=9), "the horizon is 9, the tubes have 8 steps"),
        (lambda c: c["start"].update(center=[0.0] * 5), "the start has 5 and 4 numbers, 4 are needed"),
        (lambda c: c["scene"]["goal"].update(lower=[0.3] * 3), "zip() argument"),
    ],
)
def test_a_config_that_is_not_understood_is_refused(change, message, certificate, mutate, tmp_path):
    def edit(file):
        config = yaml.safe_load(file["config"].asstr()[()])
        change(config)
        del file["config"]
        file.create_dataset("config", data=yaml.safe_dump(config), dtype=h5py.string_dtype())

    with pytest.raises(ArtifactError) as error:
        check(mutate(certificate, tmp_path / "mutant.h5", edit))
    assert message in str(error.value)


def test_a_file_cut_off_at_any_place_is_refused(certificate, tmp_path):
    data, path = certificate.read_bytes(), tmp_path / "cut.h5"
    for size in (0, 10, len(data) // 3, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(ArtifactError, match="not a certificate, or a damaged one"):
            check(path)
    with pytest.raises(ArtifactError, match="no such file"):
        check(tmp_path / "none.h5")
    with pytest.raises(ArtifactError, match="is a folder, a file is needed"):
        check(tmp_path)


def test_the_command_says_what_was_proved(certificate, tmp_path):
    shutil.copy(certificate, tmp_path / "certificate.h5")
    result = run(tmp_path / "certificate.h5")
    assert result.exit_code == 0
    assert "VERIFIED: 1 of 1 references proved, 2 cells, K = 8 (the file claims VERIFIED)" in result.output
    assert "reference 0: proved, keeps 0.467 m from disc" in result.output
    as_json = run(tmp_path / "certificate.h5", "--json")
    assert as_json.exit_code == 0 and '"answer": "VERIFIED"' in as_json.output


def test_the_checker_knows_the_formats_that_are_written():
    written = {f"sagemp/{kind.name}": kind.version for kind in storage.KINDS}
    assert {schema: written[schema] for schema in document.KINDS} == document.KINDS
