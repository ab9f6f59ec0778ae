"""Controllers that other people published (ARCH-COMP AINNCS), where a folder of them is beside the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from sagemp_cli.loop.onnx_format.lowering import read_network

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
FOLDER = Path(os.environ.get("SAGEMP_SHARED_DATA", Path(__file__).parents[4] / "shared" / "data")) / "archcomp"
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(),
    reason=f"no ONNX controllers of ARCH-COMP in {FOLDER}; SAGEMP_SHARED_DATA names the one above",
)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.onnx")), ids=lambda p: p.stem)
def test_a_published_controller_is_what_onnx_itself_computes(path, evaluated):
    network = read_network(path)
    x = torch.randn(20, network.inputs, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(network(x), evaluated(path, x), rtol=1e-5, atol=1e-5)
