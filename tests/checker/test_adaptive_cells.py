"""Cells of unequal size, as adaptive partitions have them, are proved like others; a gap between them is found."""

import copy
import dataclasses

import h5py
import torch

from sagemp_cli.checker.check import check
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes.scene import scene_from_mapping
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verification import verify_references


def test_an_adaptive_partition_is_proved_and_one_with_a_gap_is_not(make, mutate, tmp_path):
    case = make(start={"center": [0.0, 0.0, 0.0, 1.0], "radius": [0.3, 0.3, 0.0, 0.0]})
    config = copy.deepcopy(case.config)
    goal = config["scene"]["goal"] = {"lower": [-9.0] * 4, "upper": [9.0] * 4}

    def verify(counts):
        scene = scene_from_mapping(config["scene"], state_dim=4, position_dim=2)
        prover = CellProver(Affine(), dataclasses.replace(case.problem, scene=scene), case.tracker)
        return verify_references(prover, torch.from_numpy(case.tubes.references), counts=counts, budget=40)

    coarse, fine = (float(verify(c).tube.upper[:, -1, 2].max()) for c in ([1, 1], [4, 4]))
    goal["upper"][2] = 0.1 * coarse + 0.9 * fine  # what one cell misses and small ones reach
    config["scene"]["obstacles"] = []
    found = verify(None)
    assert len(found.cells.lower) > 1 and len({tuple(w) for w in found.cells.width.tolist()}) > 1
    path = dataclasses.replace(case, config=config, tubes=tubes_record(found)).write(tmp_path / "auto.h5")
    report = check(path)
    assert report.answer == "VERIFIED" and report.cells == len(found.cells.lower)

    def shrink(file: h5py.File) -> None:
        upper = file["data/tubes/cell_upper"]
        upper[0, 0] -= 1e-9

    holed = check(mutate(path, tmp_path / "holed.h5", shrink))
    assert holed.answer == "UNKNOWN" and "do not cover X_I" in holed.findings[0].reason
