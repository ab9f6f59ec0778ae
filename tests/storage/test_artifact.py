"""Artifacts: provenance, round trips, and what a reader says about files that are none."""

from __future__ import annotations

import dataclasses
import random

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sagemp_cli.errors import ArtifactError, NonFiniteError, SagempError
from sagemp_cli.storage import (
    KINDS,
    Certificate,
    Demonstrations,
    Header,
    Parent,
    Rollouts,
    open_header,
    read_any_artifact,
    read_artifact,
    sha256_of,
    write_artifact,
)

HEADER = Header(
    stage="gen-data",
    experiment="unicycle_node",
    config={"name": "unicycle_node", "dynamics": {"dt": 0.1}, "small": 1e-07, "list": [1, 2.5, None, "2x2"]},
    seed=3,
    parents=(Parent("planner", "planner.h5", "ab" * 32),),
    seconds=1.5,
)


def same(a, b):
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name)
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.fixed_dictionaries({d: st.integers(0, 4) for d in ("count", "rejected", "cells", "report", "rollouts")}),
)
def test_every_kind_is_read_back_as_written_whatever_its_sizes(kind, seed, sizes, example, tmp_path_factory):
    path = tmp_path_factory.mktemp("artifacts") / f"{kind.name}.h5"
    record = example(kind.record, seed=seed, **sizes)
    write_artifact(path, record, HEADER)
    found = read_artifact(path, kind.record)
    assert same(found.record, record)
    assert found.sha256 == sha256_of(path)


def test_provenance_is_read_back_as_written(example, tmp_path):
    path = write_artifact(tmp_path / "a.h5", example(Demonstrations), HEADER)
    kind, header = open_header(path)
    assert kind.record is Demonstrations
    filled = {"created_utc", "version", "packages"}
    for f in dataclasses.fields(Header):
        if f.name not in filled:
            assert getattr(header, f.name) == getattr(HEADER, f.name), f.name
    assert header.created_utc.endswith("+00:00")
    assert set(header.packages) >= {"torch", "numpy", "h5py"}


def test_a_parent_is_recorded_by_relative_path_and_hash(example, tmp_path):
    path = write_artifact(tmp_path / "a.h5", example(Demonstrations), HEADER)
    parent = read_artifact(path, Demonstrations).as_parent("demonstrations", tmp_path / "sub")
    assert parent == Parent("demonstrations", "../a.h5", sha256_of(path))


def test_large_arrays_carry_checksums_that_reveal_a_flipped_bit(example, tmp_path):
    record = example(Rollouts, rollouts=300, K=20)
    path = write_artifact(tmp_path / "a.h5", record, HEADER)
    with h5py.File(path) as file:
        chunk = file["data/states"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 4
    path.write_bytes(data)
    with pytest.raises(ArtifactError, match=r"a.h5: not a readable HDF5 file .*filter"):
        read_artifact(path, Rollouts)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ArtifactError, match="none.h5: no such file"):
        read_artifact(tmp_path / "none.h5", Rollouts)


def test_a_folder_is_no_artifact(tmp_path):
    with pytest.raises(ArtifactError, match="is a folder, an HDF5 file is needed"):
        read_artifact(tmp_path, Rollouts)


def test_a_file_that_is_not_hdf5_is_refused(tmp_path):
    (tmp_path / "a.h5").write_text("not HDF5")
    with pytest.raises(ArtifactError, match="a.h5: not a readable HDF5 file"):
        read_artifact(tmp_path / "a.h5", Rollouts)


def test_a_truncated_file_is_refused(example, tmp_path):
    path = write_artifact(tmp_path / "a.h5", example(Rollouts), HEADER)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(ArtifactError, match="a.h5: not a readable HDF5 file .*truncated"):
        read_artifact(path, Rollouts)


def test_a_foreign_hdf5_file_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["weights"] = np.ones(3)
    with pytest.raises(ArtifactError, match=r"not an artifact of sagemp \(schema 'none'; known: sagemp/demonstrations"):
        read_artifact(tmp_path / "a.h5", Rollouts)


def test_an_artifact_of_another_kind_is_refused(example, tmp_path):
    path = write_artifact(tmp_path / "a.h5", example(Demonstrations), HEADER)
    with pytest.raises(ArtifactError, match="is an artifact of kind 'demonstrations', 'rollouts' is needed here"):
        read_artifact(path, Rollouts)


def test_a_file_that_was_changed_is_read_by_nobody_but_who_looks_at_it(example, tmp_path):
    path = write_artifact(tmp_path / "a.h5", example(Rollouts), HEADER)
    with h5py.File(path, "r+") as file:
        file["data/states"][...] = 0.0
    with pytest.raises(ArtifactError, match=r"a.h5: the content was changed after it was written .* with --overwrite"):
        read_artifact(path, Rollouts)
    assert not read_any_artifact(path)[1].unchanged


def test_a_newer_format_is_refused(example, tmp_path):
    path = write_artifact(tmp_path / "a.h5", example(Rollouts), HEADER)
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 99
    with pytest.raises(ArtifactError, match="format 99 of 'rollouts' is newer than this sagemp reads .*update sagemp"):
        read_artifact(path, Rollouts)


@pytest.mark.parametrize("name", ["schema_version", "stage", "experiment", "seed", "packages"])
def test_missing_provenance_is_refused(example, tmp_path, name):
    path = write_artifact(tmp_path / "a.h5", example(Rollouts), HEADER)
    with h5py.File(path, "r+") as file:
        del file.attrs[name]
    with pytest.raises(ArtifactError, match="a.h5: not an artifact of sagemp, or a damaged one"):
        open_header(path)


@pytest.mark.parametrize("text", ["just text", "{unclosed", "!!python/object/apply:os.system ['true']"])
def test_a_config_that_is_no_plain_mapping_is_refused_and_never_executed(example, tmp_path, text):
    path = write_artifact(tmp_path / "a.h5", example(Rollouts), HEADER)
    with h5py.File(path, "r+") as file:
        del file["config"]
        file["config"] = text
    with pytest.raises(ArtifactError, match="a.h5: "):
        open_header(path)


def test_nan_in_a_reference_is_refused_on_writing_and_on_reading(example, tmp_path):
    record = example(Certificate)
    references = record.tubes.references.copy()
    references[1, 2, 3] = np.nan
    broken = dataclasses.replace(record, tubes=dataclasses.replace(record.tubes, references=references))
    with pytest.raises(NonFiniteError, match="Tubes.references is nan at count 1, K 2, n 3"):
        write_artifact(tmp_path / "a.h5", broken, HEADER)
    assert list(tmp_path.iterdir()) == []

    path = write_artifact(tmp_path / "a.h5", record, HEADER)
    with h5py.File(path, "r+") as file:
        file["data/tubes/references"][1, 2, 3] = np.inf
    with pytest.raises(NonFiniteError, match="a.h5: /data/tubes/references is inf at count 1, K 2, n 3"):
        read_artifact(path, Certificate)


def test_an_unbounded_tube_can_be_stored(example, tmp_path):
    record = example(Certificate)
    upper = np.full_like(record.tubes.tube_upper, np.inf)
    open_tube = dataclasses.replace(record, tubes=dataclasses.replace(record.tubes, tube_upper=upper))
    path = write_artifact(tmp_path / "a.h5", open_tube, HEADER)
    assert np.isposinf(read_artifact(path, Certificate).record.tubes.tube_upper).all()


def test_random_damage_never_escapes_as_anything_but_a_one_line_error(example, tmp_path):
    whole = write_artifact(tmp_path / "a.h5", example(Certificate), HEADER).read_bytes()
    path, draw, refused = tmp_path / "b.h5", random.Random(0), 0
    for _ in range(60):
        data = bytearray(whole)
        for _ in range(draw.choice([1, 4, 64])):
            data[draw.randrange(len(data))] = draw.randrange(256)
        path.write_bytes(data[: draw.choice([len(data), len(data), draw.randrange(len(data))])])
        try:
            read_artifact(path, Certificate)
        except SagempError as e:
            refused += 1
            assert e.exit_code == 2
            assert str(path) in str(e)
            assert "\n" not in str(e)
    assert refused > 15


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("a: " + 60_000 * "[" + 60_000 * "]", "more than 100000"),
        ("a: " + 40_000 * "[" + 40_000 * "]", "more than 100 levels deep"),
        ("a: &b [1, 2]\nc: *b\n", "alias"),
        ("a: !!python/object/apply:os.getcwd []\n", "damaged"),
    ],
    ids=["too long", "too deep", "alias", "object"],
)
def test_a_config_that_is_more_than_plain_data_is_refused(config, message, example, tmp_path):
    path = write_artifact(tmp_path / "certificate.h5", example(Certificate), HEADER)
    with h5py.File(path, "r+") as file:
        del file["config"]
        file.create_dataset("config", data=config, dtype=h5py.string_dtype())
    with pytest.raises(ArtifactError, match=message):
        open_header(path)
