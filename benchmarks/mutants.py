"""Damaged and hostile files, made of right ones: what :mod:`mutated_files` gives to the commands.

Bytes flipped, files cut off, and changes that know the format: every dataset and attribute replaced by other types,
shapes and values, links and data in other files, texts that are none, JSON and YAML edited; half of them with the
hashes renewed, their own and those that later files have of them.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

CANARY = "canary-7f3a"
"""Content of a file beside the mutants; whatever prints it has followed a way out."""
ORDER = ("demonstrations", "planner", "tracker", "certificate", "library")
FILES = {"plan": ("plan.h5", "plan.npz", "plan.csv"), "scene": ("scene.yaml",), "experiment": ("experiment.yaml",)}
"""What is damaged beside artifacts, and the right ones."""


def mutant(folder: Path, target: str, draw: random.Random) -> tuple[Path, str]:
    """Put everything right, then one file wrong; its path and what was done to it."""
    here = folder / "artifacts/unicycle_node-toy"
    shutil.rmtree(folder / "artifacts", ignore_errors=True)
    here.mkdir(parents=True)
    for right in (folder / "right/unicycle_node-toy").glob("*.h5"):
        shutil.copy(right, here / right.name)
    if target in FILES:
        right = folder / draw.choice(FILES[target])
        path = folder / f"mutant{right.suffix}"
        shutil.copy(right, path)
    else:
        path = here / f"{target}.h5"
    ways = {".h5": [flip, flip_early, cut, *[change] * 3], ".yaml": [flip, cut, *[rewrite] * 4]}
    way = draw.choice(ways.get(path.suffix, [flip, flip_early, cut, scramble]))
    how = f"{way.__name__} {way(path, draw) or ''}".strip()
    if target not in FILES and draw.random() < 0.5:
        try:
            relink(here)
            how += ", relinked"
        except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError):
            pass  # too damaged to be written to
    return path, how


def flip(path: Path, draw: random.Random, within: int | None = None) -> None:
    """Change 1 to 64 bytes anywhere."""
    data = bytearray(path.read_bytes())
    for _ in range(draw.choice([1, 1, 2, 8, 64])):
        data[draw.randrange(min(len(data), within or len(data)))] = draw.randrange(256)
    path.write_bytes(data)


def flip_early(path: Path, draw: random.Random) -> None:
    """The same among the first bytes, where the structure is."""
    flip(path, draw, 8192)


def cut(path: Path, draw: random.Random) -> None:
    """Cut off the end, or put zeros there."""
    data = path.read_bytes()
    kept = draw.randrange(len(data))
    path.write_bytes(data[:kept] + draw.choice([b"", bytes(len(data) - kept)]))


def scramble(path: Path, draw: random.Random) -> str:
    """Replace a piece of the text of a CSV (or of the bytes of an archive) by something odd."""
    odd = draw.choice(
        [b"1e308", b"-1e300", b"nan", b",,,", b"\xff\xfe", b'"', b"x" * 200_000, b"\n\n", b"0x1", b"9" * 400]
    )
    data = path.read_bytes()
    at = draw.randrange(len(data))
    path.write_bytes(data[:at] + odd + data[at + draw.choice([0, 1, 5]) :])
    return odd[:12].decode("latin-1")


def rewrite(path: Path, draw: random.Random) -> str:
    """Edit a text in YAML one to three times."""
    text = path.read_text()
    for _ in range(draw.choice([1, 1, 2, 3])):
        text = _edited(text, draw)
    if draw.random() < 0.3:  # a line once more, which is a key twice
        lines = text.splitlines()
        lines.insert(draw.randrange(len(lines)), draw.choice(lines))
        text = "\n".join(lines)
    path.write_text(text)
    return ""


def change(path: Path, draw: random.Random) -> str:
    """Change one dataset or attribute of an HDF5 file, with a renewed hash half of the time."""
    with h5py.File(path, "r+") as file:
        places: list[tuple[str, str]] = []
        file.visititems(lambda name, node: places.append((name, "")))
        file.visititems(lambda name, node: places.extend((name, key) for key in node.attrs))
        places += [("/", key) for key in file.attrs] + [("config", "")] * ("config" in file)
        name, key = draw.choice(places)
        how = _change_attribute(file[name], key, draw) if key else draw.choice(_DATASET)(file, name, draw)
        if draw.random() < 0.5 and "content_sha256" in file.attrs:
            _rehash(file)
    return f"{name}@{key}: {how}"


_TEXTS = ("", "x" * 70_000, "[" * 3000, '{"a": 1, "a": 2}', "null", "010", "\x1b[31m", "1e999", "../../x", "ä")


def _change_attribute(node: h5py.Group | h5py.Dataset, key: str, draw: random.Random) -> str:
    old = node.attrs[key]
    choice = draw.randrange(6)
    if choice == 0:
        del node.attrs[key]
        return "deleted"
    if choice == 1 and isinstance(old, str):
        node.attrs[key] = _edited(old, draw)
        return "edited"
    if choice == 2:
        node.attrs[key] = h5py.Empty("f8")
        return "empty"
    if choice == 3:
        node.attrs.create(key, np.bytes_(b"\xff\xfe\x80"))
        return "no UTF-8"
    if choice == 4:
        node.attrs[key] = draw.choice(_TEXTS)
        return "text"
    node.attrs[key] = draw.choice([-1, 0, 10**18, np.nan, np.inf, 1e308, np.zeros(3), True, np.zeros((2, 2), "u1")])
    return "number"


def _edited(text: str, draw: random.Random) -> str:
    """A text (JSON or YAML mostly) with a number scaled, or a few characters changed."""
    at = draw.randrange(len(text)) if text else 0
    odd = draw.choice(
        ["00000000", "-", "[]", "1e300", ": yes", "\n", "{", "null", "&a ", "!!int ", "99999999", '"', "${", "1:30"]
    )
    return text[:at] + odd + text[at + draw.choice([0, 1, 3]) :]


def _values(file: h5py.File, name: str, draw: random.Random) -> str:
    node = file[name]
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "fiu" or not node.size:
        return _replace(file, name, draw)
    data = node[()]
    flat = np.atleast_1d(data).reshape(-1)
    odd = draw.choice([np.nan, np.inf, -np.inf, 1e308, -1e300, 0, 1e9, -1, 2**31, 1e-320])
    with np.errstate(all="ignore"):
        flat[draw.randrange(len(flat)) :: draw.choice([1, len(flat)])] = np.array(odd).astype(data.dtype)
    node[...] = flat.reshape(data.shape)
    return f"values {odd}"


def _replace(file: h5py.File, name: str, draw: random.Random) -> str:
    node = file[name]
    shape = getattr(node, "shape", (2,)) or ()
    shapes = [shape, shape[1:], (*shape, 1), (0, *shape[1:]), tuple(s + 1 for s in shape), ()]
    dtype = draw.choice(["f8", "f4", ">f8", "i8", "u1", "c16", "S3", "f2", "?"])
    shape = draw.choice(shapes)
    del file[name]
    file.create_dataset(name, data=np.zeros(shape, dtype))
    return f"{dtype} {shape}"


def _text(file: h5py.File, name: str, draw: random.Random) -> str:
    node = file[name]
    old = node.asstr()[()] if isinstance(node, h5py.Dataset) and h5py.check_string_dtype(node.dtype) else ""
    text = _edited(old, draw) if isinstance(old, str) and old and draw.random() < 0.7 else draw.choice(_TEXTS)
    del file[name]
    file.create_dataset(name, data=text, dtype=h5py.string_dtype())
    return "text"


def _outside(file: h5py.File, name: str, draw: random.Random) -> str:
    del file[name]
    canary = str((Path("outside") / "canary").resolve())
    match draw.randrange(5):
        case 0:
            file.create_dataset(name, shape=(len(CANARY),), dtype="u1", external=[(canary, 0, len(CANARY))])
        case 1:
            file[name] = h5py.ExternalLink(str(Path("outside/plan.h5").resolve()), "/references")
        case 2:
            file[name] = h5py.SoftLink("/config")
        case 3:
            layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
            layout[:] = h5py.VirtualSource(str(Path("outside/plan.h5").resolve()), "t", shape=(3,))
            file.create_virtual_dataset(name, layout)
        case _:
            file[name] = file["data"] if "data" in file and not name.startswith("data") else file["/"]
    return "outside"


def _huge(file: h5py.File, name: str, draw: random.Random) -> str:
    del file[name]
    shape = draw.choice([(2**40,), (2**16, 2**16), (2**27,)])
    file.create_dataset(name, shape=shape, dtype="f8", chunks=tuple(min(s, 2**14) for s in shape))
    return f"huge {shape}"


def _gone(file: h5py.File, name: str, draw: random.Random) -> str:
    del file[name]
    return "deleted"


_DATASET: tuple[Callable[[h5py.File, str, random.Random], str], ...]
_DATASET = (_values, _values, _values, _replace, _replace, _text, _text, _outside, _huge, _gone)


def _rehash(file: h5py.File) -> None:
    from sagemp_cli.storage.content import content_hash

    try:
        file.attrs["content_sha256"] = content_hash(file)
    except Exception:  # what has no canonical form keeps the old hash
        return


def relink(folder: Path) -> None:
    """Renew the hashes that later files have of earlier ones, so that nothing looks stale."""
    from sagemp_cli.storage import sha256_of

    for name in ORDER:
        with h5py.File(folder / f"{name}.h5", "r+") as file:
            for role, node in file["parents"].items():
                node.attrs["sha256"] = sha256_of(folder / f"{role}.h5")
            _rehash(file)
