"""What a proof in continuous time costs beside that of the same robot's map: ``python benchmarks/continuous.py``.

    python benchmarks/continuous.py [--rounds 5] [--substeps N] [--artifacts artifacts] [--only NAME]

Takes every ``certificate.h5`` below the artifacts folder that is in continuous time, and proves its first reference
with the same tracker and as many cells twice: as an ODE, its periods cut as the experiment says, and as a forward-Euler
map. Both are what ``sagemp verify`` does, the recording of the step and the verdict included. They take turns, so that
a machine whose speed drifts drifts for both; printed are the least processor times, the median of the ratios of the
pairs, and the width of the tube of the ODE over that of the certificate.
"""

from __future__ import annotations

import argparse
import copy
import gc
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from sagemp_cli.pipeline.models import tracker_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.storage import Certificate, TrackerModel, read_artifact
from sagemp_cli.verification.verification import Verification


def proofs(path: Path, substeps: int | None) -> tuple[Callable[[], Verification], Callable[[], Verification], Any]:
    """Of a certificate's first reference: its proof as a map, that as an ODE, and what the certificate says."""
    artifact = read_artifact(path, Certificate)
    parents = {parent.role: path.parent / parent.path for parent in artifact.header.parents}
    tracker = tracker_from(read_artifact(parents["tracker"], TrackerModel)).requires_grad_(False)
    reference = torch.from_numpy(artifact.record.tubes.references[:1])

    def of(kind: str) -> Callable[[], Verification]:
        config = copy.deepcopy(dict(artifact.header.config))
        config["dynamics"]["time"] = kind
        if substeps is not None:
            config["proof"]["substeps"] = substeps
        proof = Proof.of(config, problem_of(config))
        return lambda: proof.verify(reference, tracker)

    return of("discrete"), of("continuous"), artifact.record.tubes


def timed(prove: Callable[[], Verification]) -> tuple[float, Verification]:
    """Processor time of one proof, and what it gave."""
    gc.collect()
    began = time.process_time()
    found = prove()
    return time.process_time() - began, found


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="turns of each")
    parser.add_argument("--substeps", type=int, help="parts of a period; as the experiment says by default")
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    parser.add_argument("--only", metavar="NAME", help="certificates whose folder's name contains this")
    options = parser.parse_args()
    torch.set_num_threads(1)
    every = [p for p in sorted(options.artifacts.rglob("certificate.h5")) if (options.only or "") in p.parent.name]
    asked = [p for p in every if "continuous" in p.parent.name]
    if not asked:
        print(f"{options.artifacts}: no certificate in continuous time", file=sys.stderr)
        return 2
    print("| experiment | parts | map, s | ODE, s | ratio | width over the certificate's | verdicts |")
    print("|---|---|---|---|---|---|---|")
    for path in asked:
        discrete, continuous, stored = proofs(path, options.substeps)
        discrete(), continuous()
        pairs = [(timed(discrete)[0], timed(continuous)) for _ in range(options.rounds)]
        found = pairs[-1][1][1]
        assert found.flow is not None
        width = found.tube.upper - found.tube.lower
        theirs = torch.from_numpy(stored.tube_upper - stored.tube_lower)[: len(width)]
        wider = float((width[:, 1:] / theirs[:, 1:]).nanmean()) if width.shape == theirs.shape else float("nan")
        ratio = statistics.median(ode / of_map for of_map, (ode, _) in pairs)
        print(
            f"| {path.parent.name} | {found.flow.division.substeps} | {min(p[0] for p in pairs):.3f} | "
            f"{min(p[1][0] for p in pairs):.3f} | {ratio:.2f} | {wider:.6f} | {found.verdicts[0].outcome.value} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
