"""The ARCH-COMP example: its loops are what they claim, and its command proves them where the networks are."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parents[2] / "examples" / "arch_comp"
NETWORKS = os.environ.get("SAGEMP_ARCHCOMP_NETWORKS", "")

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")


def run(*arguments):
    command = [sys.executable, str(FOLDER / "run.py"), *map(str, arguments)]
    here = os.environ | {"PYTHONPATH": str(FOLDER.parents[1])}
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env=here)


def tiny_network(path):
    """A controller of a pendulum, which pushes too little."""
    weight = torch.tensor([[-0.1, 0.0]]).numpy()
    nodes = [onnx.helper.make_node("Gemm", ["x", "w"], ["y"], transB=1)]
    graph = onnx.helper.make_graph(
        nodes,
        "tiny",
        [onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 2])],
        [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 1])],
        [onnx.numpy_helper.from_array(weight, "w")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())


def test_the_command_writes_results_and_figures_and_says_what_is_not_there(tmp_path):
    tiny_network(tmp_path / "Single_Pendulum__controller_single_pendulum.onnx")
    found = run("--networks", tmp_path, "--only", "Single_Pendulum", "NAV", "--output", tmp_path / "out")
    assert found.returncode == 1 and "NAV__nn-nav-set.onnx is not there" in found.stderr
    with (tmp_path / "out" / "results.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert list(row) == ["benchmark", "instance", "result", "time"]
    assert (row["benchmark"], row["result"]) == ("Single_Pendulum", "falsified")
    with (tmp_path / "out" / "checks.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["result"], row["checked"], row["certificate"]) == ("falsified", "falsified", "Single_Pendulum_reach.h5")
    assert (tmp_path / "out" / "Single_Pendulum_reach.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.skipif(not NETWORKS, reason="SAGEMP_ARCHCOMP_NETWORKS does not name the folder of the networks")
def test_the_published_properties_are_decided(tmp_path):
    names = ["ACC", "NAV", "Single_Pendulum", "TORA", "Unicycle"]
    found = run("--networks", NETWORKS, "--only", *names, "--output", tmp_path)
    assert found.returncode == 0, found.stderr
    with (tmp_path / "results.csv").open() as file:
        assert {row["benchmark"]: row["result"] for row in csv.DictReader(file)} == dict.fromkeys(names, "verified")
    with (tmp_path / "checks.csv").open() as file:
        assert {row["benchmark"]: row["checked"] for row in csv.DictReader(file)} == dict.fromkeys(names, "verified")
