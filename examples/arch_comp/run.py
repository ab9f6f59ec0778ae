"""All loops of ARCH-COMP AINNCS that are here: ``results.csv`` in the competition's format, a certificate and a figure
of each, and ``checks.csv``: what ``sagemp check`` makes of the certificates, from these files alone."""

import argparse
import csv
import sys
import time
from pathlib import Path

import torch
from acc import Acc
from attitude import Attitude
from docking import Docking
from double_pendulum import LessRobust, MoreRobust
from nav import Nav
from quad import Quad
from single_pendulum import SinglePendulum
from tora import Tora
from unicycle import Unicycle

from sagemp_cli.checker.check import check
from sagemp_cli.errors import SagempError
from sagemp_cli.stages.prove_ode import plant_of, prove_ode

LOOPS = {
    ("ACC", "safe-distance"): Acc,
    ("Attitude-Control", "avoid"): Attitude,
    ("Docking", "constraint"): Docking,
    ("Double_Pendulum", "less-robust"): LessRobust,
    ("Double_Pendulum", "more-robust"): MoreRobust,
    ("NAV", "robust"): Nav,
    ("QUAD", "reach"): Quad,
    ("Single_Pendulum", "reach"): SinglePendulum,
    ("TORA", "remain"): Tora,
    ("Unicycle", "reach"): Unicycle,
}
RESULTS = {"VERIFIED": "verified", "FALSIFIED": "falsified", "UNKNOWN": "unknown"}


def main() -> int:
    """Run what is asked for; 0 if all networks were there and every certificate was proved again."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--networks", type=Path, required=True, help="folder with the ONNX files")
    parser.add_argument("--only", nargs="+", help="benchmarks, for instance TORA NAV", default=None)
    parser.add_argument("--output", type=Path, default=Path("arch_comp_results"), help="folder for what is written")
    parser.add_argument("--budget", type=int, default=64, help="cells at most")
    options = parser.parse_args()
    known = {benchmark for benchmark, _ in LOOPS}
    unknown = sorted(set(options.only or ()) - known)
    if unknown:
        parser.error(f"no benchmark '{unknown[0]}'; known: {', '.join(sorted(known))}")
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    rows, checks, missing = [], [], False
    for (benchmark, instance), loop in LOOPS.items():
        if options.only and benchmark not in options.only:
            continue
        network = options.networks / loop.network
        if not network.is_file():
            print(f"{benchmark} {instance}: {network} is not there", file=sys.stderr)
            missing = True
            continue
        certificate = options.output / f"{benchmark}_{instance}.h5"
        called, began = f"{benchmark} {instance}", time.process_time()
        try:
            proof = prove_ode(
                plant_of(loop, network),
                budget=options.budget,
                certificate=certificate,
                overwrite=True,
                figure=certificate.with_suffix(".png"),
                name=called,
            )
        except SagempError as error:
            print(f"{benchmark} {instance}: {error}", file=sys.stderr)
            rows.append((benchmark, instance, "error", f"{time.process_time() - began:.2f}"))
            continue
        rows.append((benchmark, instance, RESULTS[str(proof.answer)], f"{proof.seconds:.2f}"))
        margins = ", ".join(f"{v.name} {v.margin:.4g} at {v.time:.4g} s" for v in proof.verdicts)
        cut = ", ".join(f"{d.substeps}x order {d.order}" for d in proof.divisions)
        print(f"{', '.join(rows[-1])}; {proof.cells} cells; {cut}; {margins}", flush=True)
        began = time.process_time()
        found = RESULTS[check(certificate).answer]
        checks.append((benchmark, instance, rows[-1][2], found, f"{time.process_time() - began:.2f}", certificate.name))
        print(f"  checked: {found}, {checks[-1][4]}", flush=True)
    for name, head, lines in (
        ("results", ("benchmark", "instance", "result", "time"), rows),
        ("checks", ("benchmark", "instance", "result", "checked", "time", "certificate"), checks),
    ):
        with (options.output / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([head, *lines])
    return int(missing or any(claimed != found for _, _, claimed, found, _, _ in checks))


if __name__ == "__main__":
    raise SystemExit(main())
