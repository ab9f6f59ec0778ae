"""Campaign of damaged and hostile files: thousands of mutants, over every command that reads files.

    python benchmarks/mutated_files.py [--mutants 10000] [--seed 0] [--out build/mutated_files.jsonl]

Mutants are bytes flipped, files cut off, and changes that know the format: every dataset and attribute replaced by
other types, shapes and values, links and data in other files, texts that are none, JSON and YAML edited; half of them
with the hashes renewed, their own and those that later files have of them. Each is given to the commands that read
such a file, many in one process (imports cost more than a mutant). A command has to end with a documented exit code
within 60 s of processor time and 2 GiB, and must not say what is in a file beside the mutant. The process
is watched: one that hangs is ended, noted and replaced. One line of JSON for each command that failed, and a summary
at the end; exit code 1 if there was a finding.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import h5py
import numpy as np

CODES = {0, 2, 5, 10, 124, 130}
SECONDS, MEMORY = 60.0, 2**31
CANARY = "canary-7f3a"
"""Content of a file beside the mutants; whatever prints it has followed a way out."""
ORDER = ("demonstrations", "planner", "tracker", "certificate", "library")
EXPERIMENT = ("effort=toy",)
FROM_FILE = ("effort=toy", "name=mine", "planner=from_file", "planner_training=null")
READERS = {
    "certificate": (["check", "{file}"], ["inspect", "{file}"], ["status"], ["verify"]),
    "library": (["check", "{file}"], ["inspect", "{file}", "--json"], ["status", "--json"], ["execute", "--overwrite"]),
    "tracker": (["inspect", "{file}"], ["status"], ["verify", "--overwrite"], ["build-library", "--overwrite"]),
    "planner": (["inspect", "{file}"], ["verify", "--overwrite"], ["execute", "--overwrite"]),
    "plan": (["train-planner", "--overwrite"],),
}


def main() -> None:
    """Watch workers until all mutants are done."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--mutants", type=int, default=10_000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--out", type=Path, default=Path("build/mutated_files.jsonl"))
    options.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.worker is not None:
        work(given.worker, range(given.seed, given.seed + given.mutants))
        return
    given.out.parent.mkdir(parents=True, exist_ok=True)
    tally, seed, end = Tally(given.out.with_suffix(".summary.json")), given.seed, given.seed + given.mutants
    with tempfile.TemporaryDirectory() as folder, given.out.open("a") as out:
        prepare(Path(folder))
        while seed < end:
            seed = watch(Path(folder), seed, end, tally, out)
    tally.save(seed)
    print(tally.path.read_text())
    sys.exit(tally.findings > 0)


@dataclass
class Tally:
    """What was done so far, saved every now and then: a campaign takes hours."""

    path: Path
    ends: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    most_mib: int = 0
    findings: int = 0

    def add(self, line: dict[str, Any]) -> None:
        """Count the end of one command."""
        self.ends[f"{line['command']} -> {line['code']}"] += 1
        self.slowest = max(self.slowest, line["seconds"])
        self.most_mib = max(self.most_mib, line["memory"] >> 20)
        if self.ends.total() % 100 == 0:
            self.save(line["seed"])

    def save(self, seed: int) -> None:
        """Write it down, with the seed that comes next."""
        self.path.write_text(json.dumps({**vars(self), "path": self.path.name, "seed": seed}, indent=2))


def watch(folder: Path, seed: int, end: int, tally: Tally, out: TextIO) -> int:
    """Run one worker until it is done or hangs; the seed to go on with."""
    command = [sys.executable, __file__, "--worker", str(folder), "--seed", str(seed), "--mutants", str(end - seed)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    heard, text, about = time.monotonic(), b"", {"seed": seed, "command": "start"}

    def note(line: dict[str, Any]) -> None:
        tally.findings += 1
        out.write(json.dumps(line) + "\n")
        out.flush()

    while True:
        part = process.stdout.read()
        if part:
            heard, text = time.monotonic(), text + part
        *lines, text = text.split(b"\n")
        for line in map(json.loads, lines):
            if line["what"] == "begin":
                about = line
                continue
            tally.add(line)
            if line["wrong"]:
                note(line)
        ended, hangs = process.poll() is not None, time.monotonic() - heard > 10 * SECONDS
        if ended and not part and process.returncode == 0:
            return end
        if (ended and not part) or hangs:
            process.kill()
            note(about | {"wrong": "hangs" if hangs else f"the process ended with {process.wait()}"})
            return about["seed"] + 1
        time.sleep(0.2)


def prepare(folder: Path) -> None:
    """Make one small experiment, and plan files of each kind, from which all mutants are made."""
    for arguments in (["run", *EXPERIMENT],):
        command = [sys.executable, "-m", "sagemp_cli", *arguments]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        if done.returncode not in (0, 5, 10):
            sys.exit(f"the experiment could not be made: {done.stderr}")
    with h5py.File(folder / "artifacts/unicycle_node-toy/demonstrations.h5") as file:
        states = file["data/states"][:3]
        dt = 0.1
    time_of = dt * np.arange(states.shape[1])
    with h5py.File(folder / "plan.h5", "w") as file:
        file["references"], file["t"] = states, time_of
    np.savez_compressed(folder / "plan.npz", px=states[..., 0], py=states[..., 1], t=time_of)
    rows = [f"{i},{t},{x[0]},{x[1]}" for i, plan in enumerate(states) for t, x in zip(time_of, plan, strict=True)]
    (folder / "plan.csv").write_text("\n".join(["trajectory,t,px,py", *rows]))
    (folder / "canary").write_text(CANARY)
    shutil.copytree(folder / "artifacts", folder / "right")


def work(folder: Path, seeds: range) -> None:
    """Make mutants and give them to the commands, in this process."""
    os.chdir(folder)
    from typer.testing import CliRunner

    from sagemp_cli.cli.main import app

    runner = CliRunner()
    for seed in seeds:
        draw = random.Random(seed)
        target = draw.choice((*READERS, "plan"))
        path, how = mutant(Path(), target, draw)
        for command in READERS[target]:
            arguments = [part.format(file=path) for part in command]
            if command[0] not in ("check", "inspect"):
                arguments += EXPERIMENT if target != "plan" else (*FROM_FILE, f"planner.path={path}")
            about = {"seed": seed, "target": target, "how": how, "command": command[0]}
            print(json.dumps({"what": "begin", **about}), flush=True)
            with open("/proc/self/clear_refs", "w") as file:
                file.write("5")
            began = time.process_time()
            result = runner.invoke(app, arguments, prog_name="sagemp")
            seconds, memory = time.process_time() - began, most_memory()  # busy machines wait
            said = result.output + str(getattr(result, "stderr", ""))
            wrong = [
                *(["exit code"] if result.exit_code not in CODES else []),
                *(["internal error"] if "internal error" in said or "Traceback" in said else []),
                *(["time"] if seconds > SECONDS else []),
                *(["memory"] if memory > MEMORY else []),
                *(["followed"] if CANARY in said else []),
            ]
            line = {"what": "end", **about, "code": result.exit_code, "seconds": seconds, "memory": memory}
            print(json.dumps(line | {"wrong": ", ".join(wrong), "said": said[-400:] if wrong else ""}), flush=True)


def most_memory() -> int:
    """Peak of this process's memory since it was reset, in bytes."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


def mutant(folder: Path, target: str, draw: random.Random) -> tuple[Path, str]:
    """Put everything right, then one file wrong; its path and what was done to it."""
    here = folder / "artifacts/unicycle_node-toy"
    for right in (folder / "right/unicycle_node-toy").iterdir():
        shutil.copy(right, here / right.name)
    if target == "plan":
        path = folder / f"mutant{draw.choice(['.h5', '.npz', '.csv'])}"
        shutil.copy(folder / f"plan{path.suffix}", path)
    else:
        path = here / f"{target}.h5"
    ways = [flip, flip_early, cut] + ([change] * 3 if path.suffix == ".h5" else [scramble])
    way = draw.choice(ways)
    how = f"{way.__name__} {way(path, draw) or ''}".strip()
    if target != "plan" and draw.random() < 0.5:
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
    odd = draw.choice(["00000000", "-", "[]", "1e300", ": yes", "\n", "{", "null", "&a ", "!!int ", "99999999", '"'])
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
    canary = str(Path("canary").resolve())
    match draw.randrange(5):
        case 0:
            file.create_dataset(name, shape=(len(CANARY),), dtype="u1", external=[(canary, 0, len(CANARY))])
        case 1:
            file[name] = h5py.ExternalLink("plan.h5", "/references")
        case 2:
            file[name] = h5py.SoftLink("/config")
        case 3:
            layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
            layout[:] = h5py.VirtualSource("plan.h5", "t", shape=(3,))
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


if __name__ == "__main__":
    main()
