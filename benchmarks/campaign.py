"""Soundness campaign: millions of adversarial and random rollouts against the tubes of every certificate that exists.

    python benchmarks/campaign.py [--rollouts 10000000] [--artifacts artifacts] [--processes 2]

Takes every certificate and library below the artifacts folder (run the experiments first), shares the
rollouts out among the references (of a learned robot, also among those of its analytical model), and compares each
with the hull of its cells' tubes, in worker processes with one thread each; in continuous time solutions under
switching signals with all that is certified between the samples too (:mod:`solutions`). Writes
``<artifacts>/benchmarks/campaign.json``, adding to what is there: a campaign can be interrupted and gone on with, and
each round draws new rollouts. Ends with exit code 1 if a single rollout ever left its tube.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import multiprocessing
import os
import sys
import time
from pathlib import Path

import numpy as np
import torch
from inner import SIMULATION_MARGIN, attack_tube
from solutions import compared

from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.pipeline.models import robot_from, tracker_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.sets import Box, Tube
from sagemp_cli.storage import Certificate, DynamicsModel, Library, TrackerModel, open_header, read_artifact

BATCH = 50_000
SLOWER = 25
"""Times that a solution of an ODE takes longer than a rollout."""


def attack(path: Path, index: int, analytical: bool, count: int, seed: int) -> dict:
    """Attack one reference of one file with ``count`` rollouts.

    Args:
        path: a certificate or a library.
        index: of the reference.
        analytical: of a learned robot, whether to attack what is claimed of its analytical model.
        count: rollouts.
        seed: of their random numbers.
    """
    torch.set_num_threads(1)
    kind, _ = open_header(path)
    artifact = read_artifact(path, Certificate if kind.name == "certificate" else Library)
    if artifact.record.tubes.flow is not None:
        with torch.no_grad():
            found = compared(path, index, count // SLOWER, torch.Generator().manual_seed(seed))
        return {
            "rollouts": found.rollouts, "outside": found.outside, "escapes": found.outside, "excess": found.worst
        }  # fmt: skip
    tubes, problem = artifact.record.tubes, problem_of(artifact.header.config)
    robot = problem.dynamics
    parents = {parent.role: path.parent / parent.path for parent in artifact.header.parents}
    if "dynamics" in parents:
        robot_from(read_artifact(parents["dynamics"], DynamicsModel), robot).requires_grad_(False)
    if analytical:
        tubes, robot = artifact.record.true_model.tubes, robot.analytical
    tracker = tracker_from(read_artifact(parents["tracker"], TrackerModel)).requires_grad_(False)
    own = torch.as_tensor(tubes.cell_reference) == index
    hull = Tube(torch.as_tensor(tubes.tube_lower)[own], torch.as_tensor(tubes.tube_upper)[own]).hull()
    found = attack_tube(
        ClosedLoop(robot, tracker, torch.as_tensor(tubes.references[index])),
        Box(torch.as_tensor(tubes.start_lower[index]), torch.as_tensor(tubes.start_upper[index])),
        problem.disturbance,
        hull,
        count=count,
        generator=torch.Generator().manual_seed(seed),
    )
    return {"rollouts": found.rollouts, "outside": found.outside, "escapes": found.escapes, "excess": found.excess}


def jobs(artifacts: Path) -> list[tuple[Path, int, bool]]:
    """All references with finite tubes of all certificates and libraries, as (file, index, analytical)."""
    found = []
    for path in sorted(artifacts.rglob("*.h5")):
        kind, _ = open_header(path)
        if kind.name not in ("certificate", "library"):
            continue
        content = read_artifact(path, Certificate if kind.name == "certificate" else Library).record
        if content.tubes.references is None and content.tubes.flow is None:  # a step of somebody's: only its program
            continue
        claims = [(content.tubes, False)]
        if getattr(content, "true_model", None) is not None:
            claims.append((content.true_model.tubes, True))
        for tubes, analytical in claims:
            bounded = np.isfinite(tubes.tube_lower).all((1, 2)) & np.isfinite(tubes.tube_upper).all((1, 2))
            found += [
                (path, i, analytical) for i in range(len(tubes.verdict)) if bounded[tubes.cell_reference == i].all()
            ]
    return found


def main() -> int:
    """Run the campaign; see the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rollouts", type=int, default=10_000_000)
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    references = jobs(given.artifacts)
    if not references:
        print(f"{given.artifacts}: no certificates or libraries; run an experiment first")
        return 2
    out = given.artifacts / "benchmarks" / "campaign.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    state = json.loads(out.read_text()) if out.exists() else {"rollouts": 0, "outside": 0, "escapes": 0, "rounds": 0}
    state.setdefault("files", {})
    began = time.monotonic()
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(given.processes, mp_context=context) as pool:
        while state["rollouts"] < given.rollouts:
            todo = [references[(state["rounds"] + i) % len(references)] for i in range(given.processes)]
            futures = [pool.submit(attack, *job, BATCH, state["rounds"] + i) for i, job in enumerate(todo)]
            for (path, index, analytical), future in zip(todo, futures, strict=True):
                found = future.result()
                entry = state["files"].setdefault(
                    f"{path.parent.name}/{path.name}#{index}{' analytical' * analytical}",
                    {"rollouts": 0, "worst": None},
                )
                entry["rollouts"] += found["rollouts"]
                entry["worst"] = max(found["excess"], entry["worst"] if entry["worst"] is not None else -float("inf"))
                for key in ("rollouts", "outside", "escapes"):
                    state[key] += found[key]
                state["rounds"] += 1
                if found["escapes"]:
                    print(f"ESCAPE: {path} reference {index}: {found}", file=sys.stderr)
            state |= {"margin": SIMULATION_MARGIN, "seconds": state.get("seconds", 0.0) + time.monotonic() - began}
            began = time.monotonic()
            temporary = out.with_suffix(".tmp")
            temporary.write_text(json.dumps(state, indent=1))
            os.replace(temporary, out)
            print(f"{state['rollouts']:,} rollouts, {state['outside']} outside, {state['escapes']} escapes", flush=True)
    return 1 if state["escapes"] else 0


if __name__ == "__main__":
    sys.exit(main())
