"""Records in HDF5 groups: what is declared is what is stored."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np
import pytest

from sagemp_cli.errors import ArtifactError, NonFiniteError
from sagemp_cli.reading.budget import Budget, RefusedError
from sagemp_cli.reading.hdf5 import tree_of
from sagemp_cli.storage import record as records
from sagemp_cli.storage.record import array, group, scalar, texts, weights, write_record


@dataclass(frozen=True, kw_only=True)
class Inner:
    values: np.ndarray = array("rows", "inner values")


@dataclass(frozen=True, kw_only=True)
class Sample:
    states: np.ndarray = array("rows K+1", "states", units="m")
    controls: np.ndarray = array("rows K", "controls", finite=False)
    label: tuple[str, ...] = texts("rows", "labels")
    net: dict[str, np.ndarray] = weights("weights")
    count: int = scalar("a count")
    share: float = scalar("a share", units="%")
    good: bool = scalar("a flag")
    inner: Inner = group(Inner, "an inner record")
    note: str | None = scalar("a note", optional=True)


def sample(**changes):
    values = {
        "states": np.arange(6.0).reshape(2, 3),
        "controls": np.ones((2, 2)),
        "label": ("a", "b"),
        "net": {"w": np.eye(2)},
        "count": 3,
        "share": 0.5,
        "good": True,
        "inner": Inner(values=np.array([1.0])),
    }
    return Sample(**(values | changes))


def read_record(node, record, where):
    return records.read_record(tree_of(node, Budget(0)), record, where)


@pytest.fixture
def node():
    with h5py.File("memory", "w", driver="core", backing_store=False) as file:
        yield file.create_group("data")


def test_a_record_is_read_back_as_written(node):
    write_record(node, sample(note="µ"))
    found = read_record(node, Sample, "file")
    assert np.array_equal(found.states, np.arange(6.0).reshape(2, 3))
    assert (found.label, found.count, found.share, found.good, found.note) == (("a", "b"), 3, 0.5, True, "µ")
    assert np.array_equal(found.net["w"], np.eye(2))
    assert np.array_equal(found.inner.values, [1.0])


def test_an_optional_field_may_be_absent(node):
    write_record(node, sample())
    assert read_record(node, Sample, "file").note is None


def test_dimensions_units_and_meaning_are_stored_beside_the_data(node):
    write_record(node, sample())
    assert [d.label for d in node["states"].dims] == ["rows", "K+1"]
    assert node["states"].attrs["units"] == "m"
    assert node["states"].attrs["doc"] == "states"
    assert node.attrs["share.units"] == "%"


def test_numpy_scalars_are_stored_as_plain_ones(node):
    write_record(node, sample(count=np.int64(4), good=np.bool_(False), share=np.float32(0.5)))
    found = read_record(node, Sample, "file")
    assert (found.count, found.good, found.share) == (4, False, 0.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": np.ones((2, 4))}, "Sample.controls: dimension K should have size 3, found 2"),
        ({"states": np.ones(2)}, r"Sample.states must have dimensions \(rows, K\+1\), found shape \(2,\)"),
        ({"label": ("a",)}, "Sample.label: dimension rows should have size 2, found 1"),
        ({"count": "3"}, "Sample.count must be of type int, found str"),
        ({"count": True}, "Sample.count must be of type int, found bool"),
        ({"good": 1}, "Sample.good must be of type bool, found int"),
        ({"inner": None}, "Sample.inner is missing"),
    ],
)
def test_writing_refuses_what_was_not_declared(node, changes, message):
    with pytest.raises(ArtifactError, match=message):
        write_record(node, sample(**changes))


def test_writing_refuses_nan_where_numbers_must_be_finite_and_says_where(node):
    states = np.zeros((2, 3))
    states[1, 2] = np.nan
    with pytest.raises(NonFiniteError, match=r"Sample.states is nan at rows 1, K 2; only finite numbers"):
        write_record(node, sample(states=states))
    with pytest.raises(NonFiniteError, match=r"Sample.net.w is inf at index0 0"):
        write_record(node, sample(net={"w": np.array([np.inf])}))


def test_infinity_is_kept_where_the_declaration_allows_it(node):
    write_record(node, sample(controls=np.full((2, 2), -np.inf)))
    assert np.isneginf(read_record(node, Sample, "file").controls).all()


def replaced(name, value):
    def change(node):
        del node[name]
        node[name] = value

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda node: node.__delitem__("states"), "f.h5: /data/states is missing"),
        (lambda node: node.attrs.__delitem__("count"), "f.h5: /data/count is missing"),
        (replaced("states", np.ones((2, 3), "f4")), "/data/states has type float32, float64 is required"),
        (replaced("states", np.full((2, 3), np.nan)), "/data/states is nan at rows 0, K 0"),
        (replaced("states", np.ones((2, 9))), "/data/controls: dimension K should have size 8, found 2"),
        (replaced("label", np.ones(2)), "/data/label must hold text, found type float64"),
        (replaced("net", 1.0), "/data/net must be a group"),
        (lambda node: node["net"].__setitem__("v", np.array([np.nan])), "/data/net/v is nan at index0 0"),
        (lambda node: node["net"].__setitem__("v", "text"), "/data/net/v must be numeric"),
        (lambda node: node.attrs.__setitem__("count", "many"), "/data/count must be of type int, found str"),
        (lambda node: node.attrs.__setitem__("count", [1, 2]), "/data/count must be of type int, found ndarray"),
    ],
)
def test_reading_names_the_file_and_the_place_that_does_not_fit(node, damage, message):
    write_record(node, sample())
    damage(node)
    with pytest.raises((ArtifactError, NonFiniteError), match=message):
        read_record(node, Sample, "f.h5")


@pytest.mark.parametrize("link", [h5py.ExternalLink("other.h5", "/x"), h5py.SoftLink("/data/controls")])
def test_links_are_refused_because_an_artifact_holds_all_of_its_data(node, link):
    write_record(node, sample())
    del node["states"]
    node["states"] = link
    with pytest.raises(RefusedError, match="/data/states is a link"):
        read_record(node, Sample, "f.h5")


def test_data_kept_in_another_file_is_refused(node, tmp_path):
    write_record(node, sample())
    (tmp_path / "raw").write_bytes(bytes(48))
    del node["states"]
    node.create_dataset("states", shape=(2, 3), dtype="f8", external=[(str(tmp_path / "raw"), 0, 48)])
    with pytest.raises(RefusedError, match="/data/states is stored in another file"):
        read_record(node, Sample, "f.h5")


def test_our_own_large_arrays_are_no_bombs_however_well_they_would_pack(node, monkeypatch):
    rows = np.full((300, 300), np.inf)  # an unbounded tube
    write_record(node.create_group("small"), sample(states=np.zeros((300, 301)), controls=rows, label=("",) * 300))
    monkeypatch.setattr(records, "_LARGE", 2**18)
    write_record(node.create_group("large"), sample(states=np.zeros((300, 301)), controls=rows, label=("",) * 300))
    assert node["small/controls"].id.get_storage_size() * 20 < rows.nbytes
    assert node["large/controls"].id.get_storage_size() >= rows.nbytes
    assert node["large/controls"].fletcher32
