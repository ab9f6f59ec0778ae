"""Small networks as ONNX files, and onnx's own evaluator of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")


def model_of(nodes, constants, *, shape, outputs, opset=17, kind=None):
    """A model with one input ``x`` and one output ``y``; constants are arrays by name, float32 unless they say more."""
    kind = onnx.TensorProto.FLOAT if kind is None else kind
    graph = onnx.helper.make_graph(
        nodes,
        "network",
        [onnx.helper.make_tensor_value_info("x", kind, shape)],
        [onnx.helper.make_tensor_value_info("y", kind, outputs)],
        [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    return onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", opset)], ir_version=8, producer_name="tests"
    )


@pytest.fixture
def saved(tmp_path):
    """``saved(nodes, constants, shape=..., outputs=...)``: the path of such a model's file."""

    def save(nodes, constants, **options):
        path = tmp_path / "net.onnx"
        path.write_bytes(model_of(nodes, constants, **options).SerializeToString())
        return path

    return save


@pytest.fixture
def evaluated():
    """``evaluated(path, x)``: outputs ``(count, m)`` of a file for inputs ``(count, entries)``, by onnx itself."""
    from onnx.reference import ReferenceEvaluator

    def run(path, x, shape=None):
        model = onnx.load(path)
        given = next(i for i in model.graph.input if i.name not in {t.name for t in model.graph.initializer})
        double = given.type.tensor_type.elem_type == onnx.TensorProto.DOUBLE
        shape = [d.dim_value or 1 for d in given.type.tensor_type.shape.dim]
        runner = ReferenceEvaluator(model)
        rows = np.asarray(x, dtype=np.float64 if double else np.float32)
        found = [runner.run(None, {given.name: row.reshape(shape)})[0].reshape(-1) for row in rows]
        return torch.from_numpy(np.stack(found).astype(np.float64))

    return run
