"""A campaign against a hostile vision-language service on loopback.

    python benchmarks/hostile_campaign.py [--count 500] [--command-line 10] [--seed 0] [--threads 3]

Every answer must end as documented: exit code 0, 1 or 2 with one printable line, within its time limit and 2 GiB,
nothing asked of another address, and no trace of the key in any message or file. The first ``--command-line`` go
through ``sagemp train-planner``; these may start in their own time, which is measured as processor time (machines are
busy): what they take of it, and the time from the first question that the server heard to their end, are both limited.
Ends with exit code 1 if a single one does not.
"""

from __future__ import annotations

import argparse
import functools
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import torch
from hostile_service import KEY, QUICK, SLOW, hostile, shows_key

from sagemp_cli.config.folders import load_scene
from sagemp_cli.errors import SagempError
from sagemp_cli.planners.vlm import VLM, request, service
from sagemp_cli.planners.vlm.planner import SERVICE_PLANS
from sagemp_cli.scenes import scene_from_mapping

START = torch.tensor([-1.5, -0.2, 0.0], dtype=torch.float64)
SCENE = scene_from_mapping(load_scene("table"), state_dim=3, position_dim=2)
HERE = "here"
"""Model name of questions that are asked in this process: of answers that end, three of four, to save the start."""
START_UP = 20.0
"""Seconds of processor time that a command may take, its questions included."""
LATE = 3.0
"""Seconds beyond the time limit that are put up with: starting and ending a process on a busy machine."""


@dataclass(frozen=True)
class Trial:
    """How one answer ended: seconds, code (0 for a plan), message, and what is wrong with that, if anything.

    Of a command the seconds are those after its first question.
    """

    kind: str
    seconds: float
    code: int
    message: str
    complaints: tuple[str, ...]


def pieces_of(kind: str, seed: int) -> Iterator[bytes]:
    """What the server sends, the same every time it is asked."""
    return (SLOW | QUICK)[kind](random.Random(seed))


def ask(kind: str, seed: int, *, timeout: float, time_limit: float) -> Trial:
    """One answer of a kind, through the planner. The key must be in the environment."""
    scheme = "https" if seed % 10 == 9 else "http"  # who awaits a handshake gets this
    answer = functools.partial(pieces_of, kind, seed)
    with tempfile.TemporaryDirectory() as folder, hostile(answer) as (at, lines):
        options = {
            "base_url": f"{scheme}://{at}",
            "image_height": 32,
            "timeout": timeout,
            "time_limit": time_limit,
            "model": HERE if (here := kind in QUICK and random.Random(seed).random() < 0.75) else None,
            "retries": seed % 2,
            "backoff": 0.01,
            "cache": folder,
        }
        provider, about = ("openai", "gemini")[seed % 3 == 0], service.ServiceOptions(**options)
        planner = VLM(state_dim=3, horizon=20, dt=0.5, provider=provider, attempts=1 + seed % 3, service=about)
        code, message, complaints = 0, "", []
        began = time.monotonic()
        try:
            plan = planner.sample(
                START, SCENE.goal, scene=SCENE, count=1, generator=torch.Generator().manual_seed(seed)
            )
            if not bool(torch.isfinite(plan).all()):
                complaints.append("a plan that is not finite")
        except SagempError as e:
            code, message = e.exit_code, str(e)
        except Exception as e:
            code, message = -1, repr(e)
        seconds = time.monotonic() - began
        written = "\n".join(path.read_text("utf-8", "replace") for path in Path(folder).rglob("*") if path.is_file())
        if code not in (0, 1, 2):
            complaints.append("an internal error")
        if seconds > time_limit + LATE and not here:  # nobody ends what is asked in this process
            complaints.append("too late")
        if not message.isprintable() or len(message) > 500:
            complaints.append("not one printable line")
        if shows_key(message) or shows_key(written):
            complaints.append("the key is shown")
        if scheme == "http" and any(not line.startswith("POST /chat/completions ") for line in lines):
            complaints.append(f"asked for {lines[-1]}")
    return Trial(kind, seconds, code, message, tuple(complaints))


def command(kind: str, seed: int, *, timeout: float, time_limit: float) -> Trial:
    """The same through the command line."""
    answer = functools.partial(pieces_of, kind, seed)
    with (
        tempfile.TemporaryDirectory() as folder,
        tempfile.TemporaryFile() as printed,
        tempfile.TemporaryFile() as told,
        hostile(answer) as (at, lines),
    ):
        process = subprocess.Popen(
            [sys.executable, "-m", "sagemp_cli", "train-planner", "experiment=unicycle_vlm", "effort=toy"]
            + [f"artifacts={folder}/artifacts", f"planner.service.cache={folder}/cache", "planner.provider=openai"]
            + [f"planner.service.base_url=http://{at}", "planner.attempts=1", f"planner.service.timeout={timeout}"]
            + [f"planner.service.time_limit={time_limit}", "planner.service.image_height=32"],
            stdout=printed,
            stderr=told,
        )
        began = None
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            began = time.monotonic() if began is None and lines else began
            time.sleep(0.02)
        seconds = 0.0 if began is None else time.monotonic() - began
        code, used = os.waitstatus_to_exitcode(ended[1]), ended[2].ru_utime + ended[2].ru_stime
        process.returncode = code  # or it would be waited for once more
        out, said = (_text(stream) for stream in (printed, told))
        files = "\n".join(path.read_bytes().decode("latin-1") for path in Path(folder).rglob("*") if path.is_file())
        complaints = []
        if code not in (0, 1, 2) or "internal error" in said or "Traceback" in said:
            complaints.append("an internal error")
        if any(shows_key(text) for text in (out, said, files)):
            complaints.append("the key is shown")
        if used > START_UP:
            complaints.append(f"took {used:.1f} s of processor time")
        if code and seconds > SERVICE_PLANS * time_limit + 3 * LATE:
            complaints.append("too late")
        if "\x1b" in out + said:
            complaints.append("a terminal escape")
    return Trial(f"{kind} (command line)", seconds, code, said.strip(), tuple(complaints))


def _text(stream: IO[bytes]) -> str:
    stream.seek(0)
    return stream.read().decode("utf-8", "replace")


def main() -> int:
    """Run the campaign; see the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--command-line", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=3)
    given = parser.parse_args()
    os.environ["OPENAI_API_KEY"] = os.environ["GEMINI_API_KEY"] = KEY
    torch.set_num_threads(1)
    in_process = service.ask_in_process
    service.ask_in_process = lambda r, seconds: request.ask(r) if r["model"] == HERE else in_process(r, seconds)
    kinds = [*QUICK, *SLOW]

    def one(i: int) -> Trial:
        kind = kinds[(7 * i) % len(kinds)]
        times = {"timeout": 3.0, "time_limit": 4.0} if kind in SLOW else {"timeout": 15.0, "time_limit": 20.0}
        return (command if i < given.command_line else ask)(kind, given.seed + i, **times)

    began = time.monotonic()
    with ThreadPoolExecutor(given.threads) as pool:
        trials = list(pool.map(one, range(given.count)))
    for trial in trials:
        if trial.complaints:
            print(f"{trial.kind}: {', '.join(trial.complaints)}: {trial.message!r}")
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_CHILDREN, resource.RUSAGE_SELF)) / 2**20
    bad = sum(bool(trial.complaints) for trial in trials) + (peak > 2)
    late = Counter(trial.kind for trial in trials if "no reply within" in trial.message)
    took, slowest = time.monotonic() - began, max(trial.seconds for trial in trials)
    print(f"{len(trials)} hostile answers of {len(kinds)} kinds in {took:.0f} s, {bad} ended wrongly")
    print(f"exit codes {dict(Counter(t.code for t in trials))}, slowest {slowest:.1f} s, peak {peak:.2f} GiB a process")
    print(f"killed as late: {sum(late.values())}; of kinds that end:", {k: n for k, n in late.items() if k not in SLOW})
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
