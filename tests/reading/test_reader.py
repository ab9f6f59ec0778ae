"""The reader process: what hostile files do to it is one line here."""

from __future__ import annotations

import os
import signal
import socket
import time
import zipfile

import h5py
import numpy as np
import pytest

from sagemp_cli.errors import ArtifactError
from sagemp_cli.reading import reader
from sagemp_cli.reading.reader import read_arrays, read_tree
from sagemp_cli.reading.regular import require_regular, sha256_if_there, sha256_of
from sagemp_cli.reading.tree import Group


@pytest.fixture
def hdf5(tmp_path):
    """``hdf5(fill)`` is the path of a file that ``fill`` wrote into."""

    def make(fill, name="a.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            fill(file)
        return tmp_path / name

    return make


def test_numbers_and_texts_are_handed_over_as_they_are(hdf5):
    def fill(file):
        file.attrs["text"], file.attrs["flag"], file.attrs["list"] = "µ", True, np.arange(3.0)
        file["one"], file["text"], file["empty"] = 1.5, "ä", np.zeros((0, 4))
        file["group/big"] = np.arange(6, dtype=">i4").reshape(2, 3)
        file["group/texts"] = np.array(["a", "", "größer"], dtype=object)

    path = hdf5(fill)
    tree, sha256 = read_tree(path)
    assert sha256 == sha256_of(path)
    assert (tree.attrs["text"], tree.attrs["flag"]) == ("µ", np.True_)
    assert tree.attrs["list"].tolist() == [0.0, 1.0, 2.0]
    assert (tree["one"][()], tree["text"][()], tree["empty"].shape) == (1.5, "ä", (0, 4))
    assert tree["group/big"].dtype == np.dtype(">i4")
    assert tree["group/big"][()].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert tree["group/texts"][()].tolist() == ["a", "", "größer"]
    assert "group/none" not in tree and "one/x" not in tree


def test_what_is_left_out_is_an_empty_group(hdf5):
    tree, _ = read_tree(hdf5(lambda file: file.create_dataset("data/x", data=1)), without=("data",))
    assert tree["data"] == Group("/data", {})


def external(file):
    file.create_dataset("x", shape=(4,), dtype="u1", external=[("/etc/passwd", 0, 4)])


def virtual(file):
    layout = h5py.VirtualLayout(shape=(4,), dtype="u1")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", shape=(4,))
    file.create_virtual_dataset("x", layout)


@pytest.mark.parametrize(
    ("fill", "message"),
    [
        (external, "x'? is stored in another file"),
        (virtual, "x'? is stored in another file"),
        (lambda f: f.__setitem__("x", h5py.ExternalLink("/etc/passwd", "/x")), "/x is a link"),
        (lambda f: f.__setitem__("x", h5py.SoftLink("/y")), "/x is a link"),
        (lambda f: f.create_dataset("x", shape=(2**40,), dtype="f8", chunks=(2**20,)), "unpacks into far more"),
        (lambda f: f.create_dataset("x", data=h5py.Empty("f8")), "x'? has no value"),
        (lambda f: f.create_dataset("x", data=np.zeros(9), chunks=(9,), compression="lzf"), "filter 32000"),
    ],
    ids=["external", "virtual", "external link", "soft link", "bomb", "null", "filter"],
)
def test_nothing_is_followed_out_of_a_file_or_unpacked_beyond_measure(hdf5, fill, message):
    path = hdf5(fill)
    for read in (read_tree, read_arrays):
        with pytest.raises(ArtifactError, match=f"a.h5: .*{message}"):
            read(path)


def latin(file):
    file.attrs.create("note", np.bytes_(b"\xff\xfe"))


def latin_text(file):
    kind = h5py.h5t.TypeID.copy(h5py.h5t.C_S1)
    kind.set_size(2)
    kind.set_cset(h5py.h5t.CSET_UTF8)
    attribute = h5py.h5a.create(file.id, b"note", kind, h5py.h5s.create(h5py.h5s.SCALAR))
    attribute.write(np.array(b"\xff\xfe", dtype="S2"), mtype=kind)


@pytest.mark.parametrize("fill", [latin, latin_text])
def test_text_that_is_not_utf8_is_one_line(hdf5, fill):
    with pytest.raises(ArtifactError, match="attribute /@note holds text that is not UTF-8"):
        read_tree(hdf5(fill))


def test_compound_types_and_deep_groups_are_refused(hdf5):
    with pytest.raises(ArtifactError, match="holds neither numbers nor text"):
        read_tree(hdf5(lambda file: file.create_dataset("x", data=np.zeros(2, dtype=[("a", "f8"), ("b", "i4")]))))
    with pytest.raises(ArtifactError, match="nested deeper than 16 levels"):
        read_tree(hdf5(lambda file: file.create_group("/".join("x" * 30))))


def test_a_chunk_that_is_larger_than_what_may_be_taken_is_one_line(hdf5):
    def fill(file):
        wide = file.create_dataset("x", shape=(1,), maxshape=(None,), dtype="f8", chunks=(2**28,), compression=1)
        wide.id.write_direct_chunk((0,), b"\x78\x9c")

    with pytest.raises(ArtifactError, match="a.h5: "):
        read_tree(hdf5(fill))


def test_what_does_not_come_to_an_end_is_ended_and_the_next_file_is_read(hdf5, monkeypatch):
    path = hdf5(lambda file: file.create_dataset("x", data=1.0))
    read_tree(path)
    process = reader._READER._process
    process.send_signal(signal.SIGSTOP)  # stands for a library that loops
    monkeypatch.setattr(reader, "_PATIENCE", 0.05)
    began = time.monotonic()
    with pytest.raises(ArtifactError, match="a.h5: .*reading it does not come to an end within"):
        read_tree(path)
    assert time.monotonic() - began < 20
    monkeypatch.undo()
    assert read_tree(path)[0]["x"][()] == 1.0


def test_a_reader_that_crashes_is_one_line_and_the_next_file_is_read(hdf5, monkeypatch):
    path = hdf5(lambda file: file.create_dataset("x", data=1.0))
    read_tree(path)
    reader._READER._process.kill()
    reader._READER._process.wait()
    assert read_tree(path)[0]["x"][()] == 1.0
    send = reader.wire.send

    def crash(stream, message):
        os.kill(reader._READER._process.pid, signal.SIGSEGV)
        send(stream, message)

    monkeypatch.setattr(reader.wire, "send", crash)
    with pytest.raises(ArtifactError, match="reading it ends the process that reads, with code -11"):
        read_tree(path)
    monkeypatch.undo()
    assert read_tree(path)[0]["x"][()] == 1.0


def test_pipes_devices_sockets_and_links_to_nothing_are_named_and_hold_up_nobody(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "lost.h5").symlink_to("nowhere")
    (tmp_path / "zero.h5").symlink_to("/dev/zero")
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(tmp_path / "s.h5"))
    server.close()
    for name, message in {
        "pipe.h5": "is a pipe, an HDF5 file is needed",
        "lost.h5": "is a link to nowhere, which is not there",
        "zero.h5": "is a device",
        "s.h5": "is a socket",
        "none.h5": "no such file",
        ".": "is a folder",
        "x" * 300: "cannot be read .File name too long",
        "a\0b": "cannot be read",
    }.items():
        with pytest.raises(ArtifactError, match=message):
            read_tree(tmp_path / name)
        with pytest.raises(ArtifactError):
            require_regular(tmp_path / name)
        assert sha256_if_there(tmp_path / name) is None


def test_npz_that_is_none_unpacks_too_far_or_has_a_giant_header_is_one_line(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.arange(3), text=np.array(["a", "bc"]))
    names, arrays = read_arrays(path)
    assert (names, arrays["x"].tolist(), arrays["text"].tolist()) == (["x", "text"], [0, 1, 2], ["a", "bc"])

    with path.open("wb") as file:
        np.save(file, np.arange(3))
    with pytest.raises(ArtifactError, match="no NPZ archive"):
        read_arrays(path)

    def packed(data):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("x.npy", data)

    start = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999,), }".ljust(118)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%s,), }" % b"9" * 40_000
    for data, message in (
        (bytes(2**28 + 1), "unpacks into far more"),
        (b"\x93NUMPY\x02\x00" + len(header).to_bytes(4, "little") + header, "cannot be read"),
        (b"\x93NUMPY\x01\x00\x76\x00" + start, "memory|cannot be read"),
    ):
        packed(data)
        with pytest.raises(ArtifactError, match=f"a.npz: .*({message})") as error:
            read_arrays(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("times", [1, 99])
def test_a_file_that_is_replaced_while_it_is_read_is_read_again(hdf5, monkeypatch, times):
    with np.errstate():  # the module is one for a process of its own
        from sagemp_cli.reading import process
    path = hdf5(lambda file: file.update(a=0.0))
    new = [hdf5(lambda file, i=i: file.update(a=float(i)), f"{i}.h5") for i in range(1, min(times, 9) + 1)]
    read = process.tree_of

    def meanwhile(*args, **options):
        tree = read(*args, **options)
        if new:
            os.replace(new.pop(0), path)
        return tree

    monkeypatch.setattr(process, "tree_of", meanwhile)
    monkeypatch.setattr(process, "_limit", lambda size: None)
    found = process.answer({"path": str(path), "format": "tree", "without": [], "hash": True, "damaged": ""})
    if times == 1:
        assert found["tree"]["a"][()] == 1.0 and found["sha256"] == sha256_of(path)
    else:
        assert found == {"refused": "was replaced while it was read; try again"}
