"""Files appear whole or not at all, and nothing is replaced unasked."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import textwrap

import h5py
import pytest

from sagemp_cli.errors import ArtifactError, ResourceError
from sagemp_cli.storage import atomic
from sagemp_cli.storage.atomic import hdf5_image, write_whole


def everything_in(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_file_is_written_whole_and_readable_by_others(tmp_path):
    path = write_whole(tmp_path / "new" / "file.h5", b"content")
    assert path.read_bytes() == b"content"
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert everything_in(path.parent) == ["file.h5"]


def test_an_existing_file_is_kept_unless_overwriting_was_asked_for(tmp_path):
    path = tmp_path / "file.h5"
    path.write_bytes(b"old")
    with pytest.raises(ArtifactError, match="file.h5: exists already; pass --overwrite to replace it"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    write_whole(path, b"new", overwrite=True)
    assert path.read_bytes() == b"new"
    assert everything_in(tmp_path) == ["file.h5"]


def test_a_folder_in_the_way_is_refused_even_when_overwriting(tmp_path):
    with pytest.raises(ArtifactError, match="is a folder, a file is wanted there"):
        write_whole(tmp_path, b"", overwrite=True)


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    path = tmp_path / "file.h5"
    link = os.link

    def slow(source, target):
        path.write_bytes(b"somebody else's")
        link(source, target)

    monkeypatch.setattr(atomic.os, "link", slow)
    with pytest.raises(ArtifactError, match="exists already"):
        write_whole(path, b"ours")
    assert path.read_bytes() == b"somebody else's"
    assert everything_in(tmp_path) == ["file.h5"]


def test_file_systems_without_hard_links_work(tmp_path, monkeypatch):
    def refuse(source, target):
        raise OSError(errno.ENOTSUP, "not supported")

    monkeypatch.setattr(atomic.os, "link", refuse)
    assert write_whole(tmp_path / "file.h5", b"x").read_bytes() == b"x"


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "file.h5: cannot be written: no space left on the disk"),
        (errno.EROFS, "file.h5: cannot be written: the folder or file is read-only"),
    ],
)
def test_a_refusing_disk_is_one_line_and_leaves_what_was_there(tmp_path, monkeypatch, number, message):
    path = tmp_path / "file.h5"
    path.write_bytes(b"old")

    def refuse(handle):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(atomic.os, "fsync", refuse)
    with pytest.raises(ResourceError, match=message):
        write_whole(path, b"new", overwrite=True)
    assert path.read_bytes() == b"old"
    assert everything_in(tmp_path) == ["file.h5"]


def test_an_interrupt_leaves_nothing_behind(tmp_path, monkeypatch):
    def press(handle):
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic.os, "fsync", press)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "file.h5", b"new")
    assert everything_in(tmp_path) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_read_only_folder_is_named(tmp_path):
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(ResourceError, match="the folder or file is read-only"):
            write_whole(tmp_path / "file.h5", b"new")
    finally:
        tmp_path.chmod(0o755)


def test_a_file_where_a_folder_is_needed_is_named(tmp_path):
    (tmp_path / "artifacts").write_text("a file")
    with pytest.raises(ResourceError, match="artifacts is a file where a folder is needed"):
        write_whole(tmp_path / "artifacts" / "file.h5", b"new")


def test_a_file_size_limit_of_the_system_is_an_error_and_no_crash(tmp_path):
    script = """
        import resource, signal, sys
        from pathlib import Path
        from sagemp_cli.errors import ResourceError
        from sagemp_cli.storage.atomic import write_whole
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            write_whole(Path(sys.argv[1]), bytes(100_000))
        except ResourceError as e:
            print(e)
    """
    command = [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "file.h5")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "cannot be written" in done.stdout
    assert everything_in(tmp_path) == []


def test_images_are_hdf5_files_that_old_readers_open(tmp_path):
    image = hdf5_image(lambda file: file.create_dataset("x", data=[1.0, 2.0]))
    path = write_whole(tmp_path / "file.h5", image)
    assert image[8] == 0  # version 0 of the superblock: every reader since 1999
    with h5py.File(path) as file:
        assert list(file["x"]) == [1.0, 2.0]
