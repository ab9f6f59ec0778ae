"""What an ONNX file says, in the reader process: nodes, inputs and outputs as plain data, constants as arrays.

Nothing is evaluated and no other file is followed. What the nodes mean is said in
:mod:`sagemp_cli.loop.onnx_format.lowering`.
"""

from __future__ import annotations

import math
from typing import Any, BinaryIO

from sagemp_cli.reading.budget import Budget, RefusedError

MOST_NODES = 4096
"""Nodes at most; controllers have a few dozen."""

NEEDS = "reading ONNX needs the package 'onnx': pip install 'sagemp[onnx]'"


def graph_of(file: BinaryIO, budget: Budget) -> dict[str, Any]:
    """A network as plain data.

    Returns:
        ``nodes`` (each with ``op``, ``inputs``, ``outputs``, ``attributes``), ``inputs`` (each with ``name``, ``type``
        and ``shape``, None where a size is not said), ``outputs`` (``name``), ``opset``, and ``arrays``: constants by
        name.

    Raises:
        RefusedError: no ONNX file, or one with something that a plain network does not have.
    """
    try:
        import onnx
    except ImportError:
        raise RefusedError(NEEDS) from None
    model = onnx.ModelProto()
    model.ParseFromString(file.read())
    graph = model.graph
    if not graph.node or not model.opset_import:
        raise RefusedError("is no ONNX network: it has no nodes or does not say which operators it uses")
    _require_plain_names(graph)
    if model.functions:
        raise RefusedError("defines functions of its own, which are not supported")
    if graph.sparse_initializer:
        raise RefusedError("has sparse weights, which are not supported")
    if len(graph.node) > MOST_NODES:
        raise RefusedError(f"has {len(graph.node)} nodes, at most {MOST_NODES} are read")
    arrays: dict[str, Any] = {}
    for tensor in graph.initializer:
        _keep(arrays, tensor.name, _array(tensor, budget, onnx))
    nodes = []
    for node in graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise RefusedError(f"uses '{node.op_type}' of '{node.domain}', which is not supported")
        attributes = {a.name: _attribute(a, node, budget, onnx, arrays) for a in node.attribute}
        nodes.append(
            {
                "op": node.op_type,
                "inputs": list(node.input),
                "outputs": list(node.output),
                "attributes": attributes,
            }
        )
    return {
        "nodes": nodes,
        "inputs": [_value(i, onnx) for i in graph.input if i.name not in arrays],
        "outputs": [{"name": o.name} for o in graph.output],
        "opset": max((int(o.version) for o in model.opset_import if o.domain in ("", "ai.onnx")), default=0),
        "arrays": arrays,
    }


def _require_plain_names(graph: Any) -> None:
    """Refuse names that a terminal would obey, since messages say them."""
    names = [value.name for value in (*graph.initializer, *graph.input, *graph.output)]
    for node in graph.node:
        names += [node.op_type, node.domain, *node.input, *node.output, *(a.name for a in node.attribute)]
    if not all(name.isprintable() for name in names):
        raise RefusedError("has names that are not printable")


def _keep(arrays: dict[str, Any], name: str, array: Any) -> None:
    if name in arrays:
        raise RefusedError(f"has two constants of the name '{name}'")
    arrays[name] = array


def _array(tensor: Any, budget: Budget, onnx: Any) -> Any:
    name = tensor.name if tensor.name and tensor.name.isprintable() else "a constant"
    if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
        raise RefusedError(f"keeps the weights '{name}' in another file; save it with all weights inside")
    kinds = {onnx.TensorProto.FLOAT: 4, onnx.TensorProto.DOUBLE: 8, onnx.TensorProto.INT64: 8}
    if tensor.data_type not in kinds:
        said = onnx.TensorProto.DataType.Name(tensor.data_type) if tensor.data_type in range(1, 24) else "unknown"
        raise RefusedError(f"has '{name}' of type {said}; supported are FLOAT and DOUBLE")
    if any(d < 0 for d in tensor.dims):
        raise RefusedError(f"has '{name}' of shape {list(tensor.dims)}")
    budget.take(math.prod(tensor.dims) * max(8, kinds[tensor.data_type]))
    return onnx.numpy_helper.to_array(tensor)


def _attribute(attribute: Any, node: Any, budget: Budget, onnx: Any, arrays: dict[str, Any]) -> Any:
    """The value, of a Constant's tensor the name under which it is kept."""
    kind = onnx.AttributeProto
    match attribute.type:
        case kind.FLOAT:
            return float(attribute.f)
        case kind.INT:
            return int(attribute.i)
        case kind.STRING:
            return attribute.s.decode(errors="replace")[:100]
        case kind.FLOATS:
            return [float(v) for v in attribute.floats]
        case kind.INTS:
            return [int(v) for v in attribute.ints]
        case kind.TENSOR if node.op_type == "Constant" and attribute.name == "value" and len(node.output) == 1:
            _keep(arrays, node.output[0], _array(attribute.t, budget, onnx))
            return node.output[0]
    raise RefusedError(f"has '{node.op_type}' with an attribute '{attribute.name}' that is not supported")


def _value(info: Any, onnx: Any) -> dict[str, Any]:
    tensor = info.type.tensor_type
    if info.type.WhichOneof("value") != "tensor_type" or not tensor.HasField("shape"):
        raise RefusedError(f"does not say which shape '{info.name}' has")
    shape = [int(d.dim_value) if d.HasField("dim_value") else None for d in tensor.shape.dim]
    types = {onnx.TensorProto.FLOAT: "float32", onnx.TensorProto.DOUBLE: "float64"}
    return {"name": info.name, "shape": shape, "type": types.get(tensor.elem_type, "other")}
