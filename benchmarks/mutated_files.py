"""Campaign of damaged and hostile files: thousands of mutants, over every command that reads files.

    python benchmarks/mutated_files.py [--mutants 10000] [--seed 0] [--folder build/mutated_files] [--fresh 50]

Each mutant (``mutants.py``) is given to one of the commands that read such a file, drawn at random (those that make a
file anew, which take longest, a fifth as often); with ``--all`` to each of them. A command has to end with a documented
exit code within 60 s of processor time, and it and its reader process within 2 GiB each. It must not open a file beside
the mutant that it was not told of, must not say what is in one, must change no file but its own output, and leave
nothing half-written.

What is measured is the *forked* form (``forked.py``): a process that has imported everything once forks for each
command, since imports cost more than a mutant. ``--fresh`` mutants, evenly spread, are given to the same commands in
fresh processes as well, which have to end as the forks did.

The campaign goes on where it was stopped, from the summary in its folder; a finding is one line of JSON in
``findings.jsonl`` there. Exit code 1 if there was one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from forked import ONE_THREAD, ROOT, Ended, command, forked, preload
from mutants import CANARY, FILES, mutant

CODES = {0, 2, 5, 10, 124, 130}
SECONDS, MEMORY = 60.0, 2**31
PATIENCE = 10
"""Seconds of waiting for each second of processor time: machines are busy."""
HERE = "artifacts/unicycle_node-toy"
EXPERIMENT = ("effort=toy",)
FROM_FILE = ("effort=toy", "name=mine", "planner=from_file", "planner_training=null")
READERS = {
    "certificate": (
        ["check", "{file}"],
        ["inspect", "{file}"],
        ["inspect", "{file}", "--equations"],
        ["status", *EXPERIMENT],
        ["verify", *EXPERIMENT],
    ),
    "library": (
        ["check", "{file}"],
        ["inspect", "{file}", "--json"],
        ["status", "--json", *EXPERIMENT],
        ["execute", "--overwrite", *EXPERIMENT],
    ),
    "tracker": (
        ["inspect", "{file}"],
        ["status", *EXPERIMENT],
        ["verify", "--overwrite", *EXPERIMENT],
        ["build-library", "--overwrite", *EXPERIMENT],
    ),
    "planner": (
        ["inspect", "{file}"],
        ["verify", "--overwrite", *EXPERIMENT],
        ["execute", "--overwrite", *EXPERIMENT],
    ),
    "plan": (
        ["train-planner", "--overwrite", *FROM_FILE, "planner.path={file}"],
        ["verify", *EXPERIMENT, "verify.file={file}"],
    ),
    "scene": (["config", "validate", *EXPERIMENT, "scene={file}"],),
    "experiment": (["config", "validate", "experiment={file}", *EXPERIMENT],),
}
WEIGHTS = {"certificate": 5, "library": 4, "tracker": 4, "planner": 4, "plan": 4, "scene": 1, "experiment": 1}
YAML = ("scene", "experiment")
OUTPUTS = {
    "verify": "certificate*.h5",
    "build-library": "library.h5",
    "execute": "rollouts.h5",
    "train-planner": "planner.h5",
}


def main() -> None:
    """Go through the mutants."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--mutants", type=int, default=10_000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--folder", type=Path, default=Path("build/mutated_files"))
    options.add_argument("--fresh", type=int, default=50)
    options.add_argument("--all", action="store_true")
    given = options.parse_args()
    if any(os.environ.get(name) != value for name, value in ONE_THREAD.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | ONE_THREAD)
    folder = given.folder.resolve()
    prepare(folder)
    os.chdir(folder)
    shutil.rmtree("artifacts", ignore_errors=True)
    shutil.copytree("right", "artifacts")
    quick = [
        asked for target in READERS if target not in FILES for asked in READERS[target] if "--overwrite" not in asked
    ]
    right = dict.fromkeys(tuple(p.format(file=f"{HERE}/certificate.h5") for p in asked) for asked in quick)
    preload(configs(), list(right))
    tally = Tally.resumed(folder / "summary.json", given.seed)
    every = max(1, given.mutants // given.fresh) if given.fresh else 0
    while tally.next < given.seed + given.mutants:
        seed = tally.next
        lines = try_one(folder, seed, every=given.all, fresh=bool(every) and (seed - given.seed) % every == 0)
        with (folder / "findings.jsonl").open("a") as out:
            out.writelines(json.dumps(line) + "\n" for line in lines if line["wrong"])
        tally.add(lines)
    print(tally.path.read_text())
    sys.exit(tally.findings > 0)


@dataclass
class Tally:
    """What was done so far, saved after every mutant: a campaign takes hours."""

    path: Path
    next: int
    mutants: int = 0
    commands: int = 0
    fresh: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    worst: dict[str, list[Any]] = field(default_factory=dict)
    processor_seconds: float = 0.0
    findings: int = 0

    @classmethod
    def resumed(cls, path: Path, seed: int) -> Tally:
        """From what was saved."""
        if not path.exists():
            return cls(path, seed)
        saved = json.loads(path.read_text()) | {"path": path}
        return cls(**saved | {"ends": Counter(saved["ends"])})

    def add(self, lines: Sequence[Mapping[str, Any]]) -> None:
        """Count a mutant and the ends of its commands, and go on to the next one."""
        self.next, self.mutants = self.next + 1, self.mutants + 1
        for line in lines:
            self.commands += 1
            self.fresh += line["fresh"]
            self.findings += bool(line["wrong"])
            self.ends[f"{line['command']} -> {line['code']}"] += 1
            self.processor_seconds += line["processor"]
            for what in ("processor", "wall", "memory_mib", "reader_mib"):
                if not line["fresh"] and line[what] > self.worst.get(what, [0])[0]:
                    self.worst[what] = [line[what], line["seed"], line["command"]]
        unfinished = self.path.with_suffix(".new")
        unfinished.write_text(json.dumps({**vars(self), "path": self.path.name}, indent=2))
        unfinished.replace(self.path)


def prepare(folder: Path) -> None:
    """Make one small experiment, and files of plans, scenes and experiments, from which all mutants are made."""
    if (folder / "right").exists():
        return
    (folder / "outside").mkdir(parents=True, exist_ok=True)
    called = [sys.executable, "-m", "sagemp_cli", "run", *EXPERIMENT]
    done = subprocess.run(
        called, cwd=folder, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    if done.returncode not in (0, 5, 10):
        sys.exit(f"the experiment could not be made: {done.stderr}")
    with h5py.File(folder / HERE / "demonstrations.h5") as file:
        states = file["data/states"][:3]
    time_of = 0.1 * np.arange(states.shape[1])
    with h5py.File(folder / "plan.h5", "w") as file:
        file["references"], file["t"] = states, time_of
    np.savez_compressed(folder / "plan.npz", references=states, px=states[..., 0], py=states[..., 1], t=time_of)
    rows = [f"{i},{t},{x[0]},{x[1]}" for i, plan in enumerate(states) for t, x in zip(time_of, plan, strict=True)]
    (folder / "plan.csv").write_text("\n".join(["trajectory,t,px,py", *rows]))
    shutil.copy(ROOT / "data/scenes/slalom.yaml", folder / "scene.yaml")
    shutil.copy(ROOT / "conf/experiment/unicycle_node.yaml", folder / "experiment.yaml")
    (folder / "outside/canary").write_text(CANARY)
    shutil.copy(folder / "plan.h5", folder / "outside/plan.h5")
    shutil.copytree(folder / "artifacts", folder / "right")


def configs() -> list[tuple[str, ...]]:
    """Overrides of the configs that have no mutant in them."""
    names = [f"mutant{Path(name).suffix}" for name in FILES["plan"]]
    asked = [a for target in READERS if target not in YAML for a in READERS[target]]
    found = [tuple(part.format(file=name) for part in a if "=" in part) for a in asked for name in names]
    return list(dict.fromkeys(overrides for overrides in found if overrides))


def try_one(folder: Path, seed: int, *, every: bool, fresh: bool) -> list[dict[str, Any]]:
    """One mutant and one or every command that reads it: a line for each."""
    draw = random.Random(f"target {seed}")
    target = draw.choices(list(READERS), [WEIGHTS[t] for t in READERS])[0]
    weights = [1 if "--overwrite" in asked else 5 for asked in READERS[target]]
    asked_for = READERS[target] if every else draw.choices(READERS[target], weights)
    lines = []
    for started in (False, True) if fresh else (False,):
        path, how = made(folder, target, seed)
        for asked in asked_for:
            arguments = [part.format(file=path) for part in asked]
            about = {"seed": seed, "target": target, "how": how, "command": asked[0], "fresh": started}
            lines.append(about | tried(folder, arguments, fresh=started))
    forks, others = lines[: len(asked_for)], lines[len(asked_for) :]
    for fork, other in zip(forks, others, strict=bool(others)):
        if (fork["code"], comparable(fork["output"])) != (other["code"], comparable(other["output"])):
            other["wrong"] += " not as in the fork"
            other["fork"] = fork["output"][-600:]
    for line in lines:
        line["output"] = line["output"][-600:]
    return lines


def comparable(output: str) -> str:
    """What a command says, without times and the lines about progress, which a slow run has more of."""
    kept = "".join(line for line in output.splitlines(True) if not re.fullmatch(r"[a-z ]+: \d+/\d+, .* left\n", line))
    return re.sub(r"\d+(\.\d+)?(e-?\d+)? ?s\b", "s", kept)


def made(folder: Path, target: str, seed: int) -> tuple[str, str]:
    """Make a mutant, in a process of its own: the HDF5 library meets damaged files there too. Its path, and how."""

    def work(report: int) -> None:
        path, how = mutant(Path(), target, random.Random(seed))
        os.write(report, json.dumps({"path": str(path), "how": how}).encode())

    for leftover in (folder / "artifacts/mine-toy", *folder.glob("mutant.*")):
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink(missing_ok=True)
    ended = forked(work, folder, seconds=20, wall=200)
    return ended.said.get("path", FILES.get(target, [f"{HERE}/{target}.h5"])[0]), ended.said.get("how", "broken off")


def tried(folder: Path, arguments: list[str], *, fresh: bool) -> dict[str, Any]:
    """Run one command and look at what it did."""
    for name in ("canary", "plan.h5"):
        os.utime(folder / "outside" / name, (0, time.time()))  # whoever reads it moves the first
    before = state_of(folder)
    ended = command(arguments, folder, seconds=SECONDS + 30, wall=PATIENCE * SECONDS, fresh=fresh)
    lines = ended.output.splitlines()
    wrong = [
        *(["exit code"] if ended.code not in CODES else []),
        *(["internal error"] if "internal error" in ended.output or "Traceback" in ended.output else []),
        *(["more than one line"] if ended.code == 2 and len(lines) > 1 and arguments[0] != "config" else []),
        *(["time"] if ended.processor > SECONDS or ended.late else []),
        *(["memory"] if max(ended.memory, ended.reader) > MEMORY else []),
        *(["followed"] if CANARY in ended.output or followed(folder) else []),
        *left(folder, before, arguments[0], ended),
    ]
    return {
        "code": ended.code,
        "processor": round(ended.processor, 2),
        "wall": round(ended.wall, 2),
        "memory_mib": ended.memory >> 20,
        "reader_mib": ended.reader >> 20,
        "wrong": ", ".join(wrong),
        "output": ended.output,
    }


def followed(folder: Path) -> bool:
    """Whether a file outside was read (file systems with relatime note the first time)."""
    return any(path.stat().st_atime > 0 for path in (folder / "outside").iterdir())


def state_of(folder: Path) -> dict[Path, tuple[int, int, int]]:
    """What files there are, and which."""
    files = (p for p in folder.rglob("*") if p.is_file() and p.parent != folder)
    return {p: (s.st_ino, s.st_size, s.st_mtime_ns) for p in files for s in [p.stat()]}


def left(folder: Path, before: Mapping[Path, Any], name: str, ended: Ended) -> list[str]:
    """What is wrong with the files after a command."""
    after, wrong = state_of(folder), []
    touched = [p for p in {*before, *after} if before.get(p) != after.get(p) and p.suffix not in (".npz", ".png")]
    for path in touched:
        if path.name.endswith(".tmp"):
            wrong.append(f"{path.name} was left")
        elif path.name.startswith(".") or ".partial" in str(path):
            continue
        elif name not in OUTPUTS or not path.match(OUTPUTS[name]):
            wrong.append(f"{path.name} was changed")
        elif path not in after or not whole(folder, path):
            wrong.append(f"{path.name} is not whole")
        elif ended.code not in (0, 5, 10):
            wrong.append(f"{path.name} was written")
    return wrong


def whole(folder: Path, path: Path) -> bool:
    """Whether an artifact is what was written."""

    def work(_: int) -> None:
        from sagemp_cli.storage import read_any_artifact

        sys.exit(not read_any_artifact(path)[1].unchanged)

    return forked(work, folder, seconds=20, wall=200).code == 0


if __name__ == "__main__":
    main()
