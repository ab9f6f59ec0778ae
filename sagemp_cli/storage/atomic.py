"""Writing files whole or not at all.

HDF5 files are made in memory and written as bytes: the HDF5 library survives a full disk badly (it prints
pages of errors and may crash the process), the operating system's plain write reports it as one error.
"""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import h5py

from sagemp_cli.errors import ArtifactError, ResourceError
from sagemp_cli.reading.regular import is_there

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EMLINK)


def hdf5_image(fill: Callable[[h5py.File], None]) -> bytes:
    """The bytes of the HDF5 file that ``fill`` builds, in a format that old readers understand."""
    with h5py.File("image", "w", driver="core", backing_store=False, libver=("earliest", "v110")) as file:
        fill(file)
        file.flush()
        return file.id.get_file_image()


def write_whole(path: Path, data: bytes, *, overwrite: bool = False) -> Path:
    """Put ``data`` under the name ``path``: whole and flushed to the disk, or not at all.

    The bytes go to a hidden temporary file in the same folder, which then takes the final name in one step.

    Raises:
        ArtifactError: the name is taken and ``overwrite`` is false; the file there is untouched.
        ResourceError: the folder cannot be written or the disk is full; nothing is left behind.
    """
    refuse_existing(path, overwrite)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        _take_name(temporary, path, overwrite)
        _sync_folder(path.parent)
    except OSError as e:
        blocker = next((folder for folder in path.parents if folder.is_file()), None)
        why = reason_of(e) if blocker is None else f"{blocker} is a file where a folder is needed"
        raise ResourceError(f"{path}: cannot be written: {why}") from e
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    return path


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise if ``path`` is in the way: a stage calls this before it starts to work."""
    if path.is_dir():
        raise ArtifactError(f"{path}: is a folder, a file is wanted there")
    if is_there(path) and not overwrite:
        raise ArtifactError(f"{path}: exists already; pass --overwrite to replace it")


def reason_of(error: BaseException) -> str:
    """One line that says why the machine or the HDF5 library refused."""
    number = getattr(error, "errno", None)
    if number == errno.ENOSPC:
        return "no space left on the disk"
    if number in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "the folder or file is read-only"
    return " ".join(str(error).split()) or type(error).__name__


def _take_name(temporary: Path, path: Path, overwrite: bool) -> None:
    if not overwrite:
        try:
            os.link(temporary, path)  # unlike a rename, it fails if somebody else was faster
            return
        except FileExistsError:
            refuse_existing(path, overwrite)
        except OSError as e:  # a file system without hard links: check, then rename
            if e.errno not in _NO_LINKS:
                raise
            refuse_existing(path, overwrite)
    os.replace(temporary, path)


def _sync_folder(folder: Path) -> None:
    """Flush the new name itself, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
