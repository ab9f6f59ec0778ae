import h5py
import numpy as np
import pytest

from sagemp_cli.errors import ArtifactError, NonFiniteError, UsageError
from sagemp_cli.pipeline.freshness import Freshness, survey
from sagemp_cli.pipeline.reference_file import read_references
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.storage import Certificate, read_artifact, sha256_of

from .conftest import Interrupt, assert_same

NAMES = ("px", "py", "theta", "v")


@pytest.fixture
def plans():
    return np.random.default_rng(0).normal(size=(3, 6, 4))


def save(path, array, name="references"):
    if path.suffix == ".npz":
        np.savez(path, **{name: array})
    else:
        with h5py.File(path, "w") as file:
            file[name] = array
    return path


def read(path):
    return read_references(path, horizon=5, state_names=NAMES)


@pytest.mark.parametrize("name", ["plans.h5", "plans.hdf5", "plans.npz"])
def test_references_are_read_as_they_are(tmp_path, plans, name):
    np.testing.assert_array_equal(read(save(tmp_path / name, plans)).numpy(), plans)
    single = read(save(tmp_path / name, plans.astype(np.float32)))
    np.testing.assert_array_equal(single.numpy(), plans.astype(np.float32).astype(np.float64))


@pytest.mark.parametrize("name", ["plans.h5", "plans.npz"])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda p: p[0], UsageError, r"references must have shape \(count, 6, 4\), found \(6, 4\)"),
        (lambda p: p[..., :3], UsageError, r"references must have shape \(count, 6, 4\), found \(3, 6, 3\)"),
        (lambda p: p[:0], UsageError, r"references must have shape \(count, 6, 4\), found \(0, 6, 4\)"),
        (lambda p: p[:, :4], UsageError, "references have 3 steps, but horizon is 5; they must have shape"),
        (lambda p: np.where(p == p[1, 2, 3], np.nan, p), NonFiniteError, "reference 1 is nan at step 2 in state 'v'"),
        (lambda p: np.where(p == p[2, 0, 0], np.inf, p), NonFiniteError, "reference 2 is inf at step 0 in state 'px'"),
        (
            lambda p: np.where(p == p[1, 0, 2], -1e300, p),
            ArtifactError,
            "reference 1 has theta = -1e[+]300 at step 0; at",
        ),
        (lambda p: p.astype(complex), ArtifactError, "'references' must hold real numbers, found type complex128"),
    ],
)
def test_wrong_references_are_one_line_with_the_file(tmp_path, plans, name, change, error, message):
    path = save(tmp_path / name, change(plans))
    with pytest.raises(error, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["plans.h5", "plans.npz"])
def test_files_that_are_none_are_one_line_too(tmp_path, plans, name):
    path = tmp_path / name
    with pytest.raises(ArtifactError, match="no such file"):
        read(path)
    path.write_bytes(b"PK\x03\x04 neither")
    with pytest.raises(ArtifactError, match="cannot be read"):
        read(path)
    path.unlink()
    with pytest.raises(ArtifactError, match="has no dataset 'references'; found: trajectories"):
        read(save(path, plans, "trajectories"))
    with pytest.raises(ArtifactError, match=r"must be HDF5 \(.h5, .hdf5\) or NPZ \(.npz\)"):
        read(tmp_path / "plans.csv")


def test_pickles_are_not_opened(tmp_path):
    path = tmp_path / "plans.npz"
    np.savez(path, references=np.array([{"any": "object"}], dtype=object))
    with pytest.raises(ArtifactError, match="cannot be read .*allow_pickle=False"):
        read(path)


def test_a_file_of_references_is_verified_and_resumed_chunk_by_chunk(work, toy_folder, tmp_path):
    stage = stage_named("verify")
    planned = read_artifact(toy_folder / "certificate.h5", Certificate).record.tubes.references
    shift = np.zeros((5, 1, 4))
    shift[:, 0, 1] = [0.0, 0.02, -0.02, 0.04, 0.06]
    source = save(tmp_path / "plans.npz", planned + shift)
    overrides = (f"verify.file={source}", "proof.memory=0.02", "verify.falsifier.restarts=0")

    def context(**options):
        return work("gen-data", "train-planner", "train-tracker", overrides=overrides, overwrite=True, **options)

    with pytest.raises(KeyboardInterrupt):
        stage.run(context(progress=Interrupt(after=8)))
    stopped = context(progress=Interrupt())
    assert not stopped.output_path("verify").exists()
    (folder,) = stopped.partial_folder("verify").iterdir()
    done = set(folder.glob("*.npz"))
    assert len(done) > 0
    path = stage.run(stopped)
    assert 0 < stopped.progress.resumed["propagating cells"] < 20
    assert not stopped.partial_folder("verify").exists()

    resumed = read_artifact(path, Certificate)
    np.testing.assert_array_equal(resumed.record.tubes.references, planned + shift)
    assert resumed.record.tubes.cell_reference.tolist() == np.repeat(np.arange(5), 4).tolist()
    assert {p.role: p.sha256 for p in resumed.header.parents}["references"] == sha256_of(source)
    whole = read_artifact(stage.run(context(progress=(again := Interrupt()))), Certificate)
    assert again.resumed["propagating cells"] == 0
    assert_same(resumed.record, whole.record)

    assert survey(context())["verify"].freshness is Freshness.FRESH
    save(source, planned)
    state = survey(context())["verify"]
    assert state.freshness is Freshness.STALE and state.why == "plans.npz has changed since"


def test_too_little_memory_is_one_clear_error(work):
    context = work("gen-data", "train-planner", "train-tracker", overrides=("proof.memory=0.0001",))
    with pytest.raises(UsageError, match="proof.memory is 0.0001 GiB, but the tubes and relaxations of up to 4 cells"):
        stage_named("verify").run(context)
    assert not context.output_path("verify").exists()


def test_an_adaptive_partition_is_written_and_can_be_read(work):
    overrides = ("proof.partitions=auto", "proof.budget=8")
    context = work("gen-data", "train-planner", "train-tracker", overrides=overrides)
    record = read_artifact(stage_named("verify").run(context), Certificate).record
    assert record.verdict == "VERIFIED" and len(record.tubes.cell_reference) <= 8
