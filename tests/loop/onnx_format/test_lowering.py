"""Networks of ONNX files: what is read is what onnx's own evaluator computes, and all else is refused by name."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
import torch

from sagemp_cli.errors import ArtifactError
from sagemp_cli.loop.onnx_format.lowering import read_network

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
node = onnx.helper.make_node


def f32(rng, *shape):
    return rng.normal(size=shape).astype(np.float32)


def one_layer(op, rng):
    """Nodes and constants of a network around one operator, with its input's and output's shape."""
    w, b = f32(rng, 5, 3), f32(rng, 5)
    plain = {"shape": ["batch", 3], "outputs": ["batch", 5]}
    middle = [node("Gemm", ["x", "w", "b"], ["h"], transB=1)]
    match op:
        case "Gemm":
            return [node("Gemm", ["x", "w", "b"], ["y"], transB=1, alpha=0.7, beta=-1.5)], {"w": w, "b": b}, plain
        case "Gemm without transB, nor offsets":
            return [node("Gemm", ["x", "w"], ["y"])], {"w": w.T.copy()}, plain
        case "MatMul and Add":
            nodes = [node("MatMul", ["x", "w"], ["h"]), node("Add", ["b", "h"], ["y"])]
            return nodes, {"w": w.T.copy(), "b": b}, plain
        case "MatMul of rows":
            return [node("MatMul", ["x", "w"], ["y"])], {"w": w.T.copy()}, {"shape": [2, 3], "outputs": [2, 5]}
        case "Conv of all":
            shapes = {"shape": [1, 2, 1, 3], "outputs": [1, 5, 1, 1]}
            return [node("Conv", ["x", "w", "b"], ["y"])], {"w": f32(rng, 5, 2, 1, 3), "b": b}, shapes
        case "Conv of one":
            shapes = {"shape": [1, 2, 2, 3], "outputs": [1, 5, 2, 3]}
            nodes = [node("Conv", ["x", "w", "b"], ["y"], kernel_shape=[1, 1], pads=[0] * 4)]
            return nodes, {"w": f32(rng, 5, 2, 1, 1), "b": b}, shapes
        case "Sub, Conv, Flatten":
            nodes = [
                node("Sub", ["x", "mean"], ["c"]),
                node("Conv", ["c", "w", "b"], ["d"]),
                node("Relu", ["d"], ["e"]),
                node("Flatten", ["e"], ["y"]),
            ]
            constants = {"mean": f32(rng, 1, 1, 1, 3), "w": f32(rng, 5, 1, 1, 3), "b": b}
            return nodes, constants, {"shape": [1, 1, 1, 3], "outputs": [1, 5]}
        case "Flatten at the front":
            nodes = [
                node("Flatten", ["x"], ["f"], axis=-1),
                node("Reshape", ["f", "s"], ["r"]),
                node("Relu", ["r"], ["y"]),
            ]
            return nodes, {"s": np.array([0, -1])}, {"shape": [1, 2, 3], "outputs": [2, 3]}
        case "Reshape":
            nodes = [node("Reshape", ["x", "s"], ["r"]), node("MatMul", ["r", "w"], ["y"])]
            constants = {"s": np.array([-1, 3]), "w": w.T.copy()}
            return nodes, constants, {"shape": [1, 6], "outputs": [2, 5]}
        case "Reshape to more dimensions":
            nodes = [node("Reshape", ["x", "s"], ["r"]), node("Transpose", ["r"], ["t"]), node("Relu", ["t"], ["y"])]
            return nodes, {"s": np.array([0, 2, 3])}, {"shape": [1, 6], "outputs": [3, 2, 1]}
        case "Transpose":
            nodes = [node("Transpose", ["x"], ["t"], perm=[1, 0]), node("MatMul", ["t", "w"], ["y"])]
            return nodes, {"w": f32(rng, 2, 5)}, {"shape": [2, 3], "outputs": [3, 5]}
        case "Transpose of weights":
            nodes = [node("Transpose", ["w"], ["t"]), node("MatMul", ["x", "t"], ["y"])]
            return nodes, {"w": w}, plain
        case "Cast and Identity":
            nodes = [
                node("Cast", ["x"], ["c"], to=11),
                node("Identity", ["c"], ["i"]),
                node("Cast", ["i"], ["d"], to=1),
                node("MatMul", ["d", "w"], ["y"]),
            ]
            return nodes, {"w": w.T.copy()}, plain
        case "Constant":
            value = onnx.numpy_helper.from_array(b, "value")
            return (
                [*middle, node("Constant", [], ["k"], value=value), node("Mul", ["h", "k"], ["y"])],
                {
                    "w": w,
                    "b": b,
                },
                plain,
            )
        case "Clip by attributes":
            nodes = [*middle, node("Clip", ["h"], ["y"], min=-0.4, max=0.3)]
            return nodes, {"w": w, "b": b}, plain | {"opset": 10}
        case "Clip":
            constants = {"w": w, "b": b, "lo": np.float32(-0.4), "hi": np.float32(0.3)}
            return [*middle, node("Clip", ["h", "lo", "hi"], ["y"])], constants, plain
        case "Clip above only":
            nodes = [*middle, node("Clip", ["h", "", "hi"], ["y"])]
            return nodes, {"w": w, "b": b, "hi": np.float32(0.3)}, plain
        case "Gelu" | "Mish" | "HardSwish":
            return [*middle, node(op, ["h"], ["y"])], {"w": w, "b": b}, plain | {"opset": 20}
        case "Gelu in its tanh form":
            nodes = [*middle, node("Gelu", ["h"], ["y"], approximate="tanh")]
            return nodes, {"w": w, "b": b}, plain | {"opset": 20}
        case "Elu of another alpha":
            return [*middle, node("Elu", ["h"], ["y"], alpha=0.5)], {"w": w, "b": b}, plain
        case "Sqrt":
            return [*middle, node("Exp", ["h"], ["e"]), node("Sqrt", ["e"], ["y"])], {"w": w, "b": b}, plain
        case "LeakyRelu":
            return [*middle, node("LeakyRelu", ["h"], ["y"], alpha=0.3)], {"w": w, "b": b}, plain
        case "LeakyRelu by default":
            return [*middle, node("LeakyRelu", ["h"], ["y"])], {"w": w, "b": b}, plain
        case "PRelu":
            return [*middle, node("PRelu", ["h", "s"], ["y"])], {"w": w, "b": b, "s": np.float32([0.2])}, plain
        case "Add" | "Sub" | "Mul" | "Div":
            constants = {"w": w, "b": b, "k": f32(rng, 5)}
            return [*middle, node(op, ["h", "k"], ["y"])], constants, plain
        case "Sub from a constant" | "Add a column":
            read = ["k", "h"] if op.startswith("Sub") else ["h", "k"]
            constants = {"w": w, "b": b, "k": f32(rng, 1) if op.startswith("Sub") else f32(rng, 1, 1)}
            return [*middle, node(op.split()[0], read, ["y"])], constants, plain
        case "Add two values" | "Mul two values" | "Sub two values":
            nodes = [*middle, node("Tanh", ["h"], ["t"]), node(op.split()[0], ["h", "t"], ["y"])]
            return nodes, {"w": w, "b": b}, plain
        case "Div two values":
            nodes = [*middle, node("Sigmoid", ["h"], ["t"]), node("Div", ["h", "t"], ["y"])]
            return nodes, {"w": w, "b": b}, plain
        case "Mul by one of its entries":
            nodes = [*middle, node("MatMul", ["h", "v"], ["one"]), node("Mul", ["h", "one"], ["y"])]
            return nodes, {"w": w, "b": b, "v": f32(rng, 5, 1)}, plain
    return [*middle, node(op, ["h"], ["y"])], {"w": w, "b": b}, plain


LAYERS = """Gemm|Gemm without transB, nor offsets|MatMul and Add|MatMul of rows|Conv of all|Conv of one
Sub, Conv, Flatten|Flatten at the front|Reshape|Reshape to more dimensions|Transpose|Transpose of weights
Cast and Identity|Constant
Clip by attributes|Clip|Clip above only|LeakyRelu|LeakyRelu by default|PRelu|Add|Sub|Mul|Div|Sub from a constant
Add a column|Add two values|Mul two values|Sub two values|Div two values|Mul by one of its entries
Relu|Tanh|Sigmoid|Softplus|Elu|Gelu|Mish|HardSwish|Softsign|Erf|Exp|Abs|Neg|Sin|Cos|Floor|Ceil|Round|Sign|Softmax
Elu of another alpha|Gelu in its tanh form|Sqrt""".replace("\n", "|").split("|")


@pytest.mark.parametrize("op", LAYERS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_network_of_every_supported_layer_is_what_onnx_itself_computes(op, seed, saved, evaluated):
    rng = np.random.default_rng(seed)
    path = saved(*one_layer(op, rng)[:2], **one_layer(op, np.random.default_rng(seed))[2])
    network = read_network(path)
    x = torch.from_numpy(f32(rng, 20, network.inputs).astype(np.float64))
    expected = evaluated(path, x)
    assert expected.std() > 1e-3  # a network of zeros would prove nothing
    torch.testing.assert_close(network(x), expected, rtol=2e-5, atol=2e-6)  # the evaluator computes in float32


@pytest.mark.parametrize("seed", range(8))
def test_random_deep_networks_are_what_onnx_itself_computes_in_float64(seed, saved, evaluated):
    rng = np.random.default_rng(seed)
    activations = ["Relu", "LeakyRelu", "Tanh", "Sigmoid", "Elu", "Softplus"]
    widths = [int(n) for n in rng.integers(2, 9, size=5)]
    nodes, constants, last = [], {}, "x"
    for i, (a, b) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
        constants |= {f"w{i}": rng.normal(size=(a, b)) / np.sqrt(a), f"b{i}": rng.normal(size=b)}
        if rng.random() < 0.5:
            nodes.append(node("Gemm", [last, f"w{i}", f"b{i}"], [f"h{i}"]))
        else:
            nodes += [node("MatMul", [last, f"w{i}"], [f"m{i}"]), node("Add", [f"m{i}", f"b{i}"], [f"h{i}"])]
        last = f"h{i}"
        if i < 3:
            nodes.append(node(str(rng.choice(activations)), [last], [f"a{i}"]))
            last = f"a{i}"
    nodes[-1].output[0] = "y"
    double = onnx.TensorProto.DOUBLE
    path = saved(nodes, constants, shape=["N", widths[0]], outputs=["N", widths[-1]], kind=double)
    x = torch.from_numpy(rng.normal(size=(50, widths[0])))
    torch.testing.assert_close(read_network(path)(x), evaluated(path, x), rtol=1e-12, atol=1e-12)


def test_weights_are_the_stored_float32_numbers_and_sums_are_not_rounded_to_float32(saved):
    tenth, most = np.float32(0.1), np.float32(3e38)
    nodes = [node("MatMul", ["x", "w"], ["y"])]
    path = saved(nodes, {"w": np.array([[tenth], [most], [most]])}, shape=[1, 3], outputs=[1, 1])
    found = read_network(path)(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert found.item() in (float(tenth), 0.0)  # 3e38 swallows 0.1, which float64 may do; float32 would overflow above
    alone = read_network(path)(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert alone.item() == float(tenth) != 0.1
    twice = read_network(path)(torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64))
    assert twice.item() == 2 * float(most)


@pytest.mark.parametrize(("to", "number"), [(1, 0.25), (1, np.float32(0.1)), (11, 0.1), (11, np.float32(0.1))])
def test_a_cast_of_weights_that_rounds_nothing_leaves_them_as_they_are(to, number, saved):
    nodes = [node("Cast", ["w"], ["c"], to=to), node("MatMul", ["x", "c"], ["y"])]
    path = saved(nodes, {"w": np.array([[number]])}, shape=[1, 1], outputs=[1, 1])
    assert read_network(path)(torch.ones(1, dtype=torch.float64)).item() == float(number)


@pytest.mark.parametrize("factor", [-4.0, 0.125])
def test_a_power_of_two_is_a_factor_of_any_weights(factor, saved):
    path = saved(
        [node("Gemm", ["x", "w"], ["y"], alpha=factor)], {"w": np.array([[0.1]])}, shape=[1, 1], outputs=[1, 1]
    )
    assert read_network(path)(torch.ones(1, dtype=torch.float64)).item() == factor * 0.1


W = np.eye(3, dtype=np.float32)
GEMM = node("Gemm", ["x", "w"], ["y"])
REFUSED = {
    "another operator": (
        [node("Asin", ["x"], ["y"])],
        {},
        {},
        "uses 'Asin', which is not supported; supported are Gemm",
    ),
    "recurrent": ([node("LSTM", ["x", "w", "w"], ["y"])], {"w": W}, {}, "uses 'LSTM'"),
    "another domain": (
        [onnx.helper.make_node("Relu", ["x"], ["y"], domain="com.microsoft")],
        {},
        {},
        "'Relu' of 'com.microsoft'",
    ),
    "wrong sizes": ([GEMM], {"w": np.eye(4, dtype=np.float32)}, {}, r"'Gemm' of shape \[1, 3\] with weights for 4"),
    "sizes that do not broadcast": (
        [node("Add", ["x", "w"], ["y"])],
        {"w": np.ones(2, np.float32)},
        {},
        "do not fit",
    ),
    "NaN weights": ([GEMM], {"w": W * np.nan}, {}, "NaN or infinity among the weights 'w'"),
    "infinite weights": ([GEMM], {"w": W + np.inf}, {}, "NaN or infinity among the weights 'w'"),
    "whole numbers": ([GEMM], {"w": np.eye(3, dtype=np.int64)}, {}, "'Gemm' of whole numbers"),
    "float16": ([GEMM], {"w": W.astype(np.float16)}, {}, "'w' of type FLOAT16; supported are FLOAT and DOUBLE"),
    "an open size that is no batch": ([GEMM], {"w": W}, {"shape": [1, "n"]}, "only the batch, which comes first"),
    "weights that change": ([node("Gemm", ["w", "x"], ["y"])], {"w": W}, {}, "multiply a value by constant weights"),
    "transA": ([node("Gemm", ["x", "w"], ["y"], transA=1)], {"w": W}, {}, "transA"),
    "an attribute": ([node("Relu", ["x"], ["y"], spin=2)], {}, {}, "'Relu' with 'spin'"),
    "a value before it is there": ([node("Relu", ["z"], ["y"])], {}, {}, "reads 'z' before"),
    "a name that is given twice": ([node("Relu", ["x"], ["y"]), node("Relu", ["x"], ["y"])], {}, {}, "'y' twice"),
    "an output of constants": ([node("Relu", ["x"], ["z"]), node("Identity", ["w"], ["y"])], {"w": W}, {}, "depend"),
    "an old version": ([GEMM], {"w": W}, {"opset": 5}, "version 5, supported are 6 to 25"),
    "a window of its own": (
        [node("Conv", ["x", "w"], ["y"])],
        {"w": np.ones((1, 1, 2), np.float32)},
        {"shape": [1, 1, 3]},
        r"window \[2\] over \[3\]",
    ),
    "a moving window": (
        [node("Conv", ["x", "w"], ["y"], strides=[2])],
        {"w": np.ones((1, 1, 1), np.float32)},
        {"shape": [1, 1, 3]},
        r"strides \[2\]",
    ),
    "padding": (
        [node("Conv", ["x", "w"], ["y"], pads=[1, 1])],
        {"w": np.ones((1, 1, 1), np.float32)},
        {"shape": [1, 1, 3]},
        r"pads \[1, 1\]",
    ),
    "division by zero": ([node("Div", ["x", "w"], ["y"])], {"w": np.zeros(3, np.float32)}, {}, "'Div' by zero"),
    "a steep LeakyRelu": ([node("LeakyRelu", ["x"], ["y"], alpha=2.0)], {}, {}, "slope 2.0"),
    "Elu below 0": ([node("Elu", ["x"], ["y"], alpha=-2.0)], {}, {}, "alpha -2.0, supported is a positive one"),
    "Softmax of rows": (
        [node("Softmax", ["x"], ["y"], axis=0)],
        {},
        {},
        "along axis 0 of shape .* must be over all entries",
    ),
    "slopes that differ": ([node("PRelu", ["x", "w"], ["y"])], {"w": np.float32([0.1, 0.2, 0.3])}, {}, "slope"),
    "NaN as a limit": ([node("Clip", ["x"], ["y"], min=float("nan"))], {}, {"opset": 10}, "clamp cannot have"),
    "arithmetic on constants": ([node("Add", ["w", "w"], ["y"])], {"w": W}, {}, "two constants"),
    "a factor that rounds": (
        [node("Gemm", ["x", "w"], ["y"], alpha=0.7)],
        {"w": np.eye(3)},
        {},
        "'Gemm' with a factor 0.69.* on float64 weights; fold it into them first",
    ),
    "weights that a cast rounds": (
        [node("Cast", ["w"], ["c"], to=1), node("MatMul", ["x", "c"], ["y"])],
        {"w": 0.1 * np.eye(3)},
        {},
        "'Cast' that rounds a constant",
    ),
    "another type": ([node("Cast", ["x"], ["y"], to=10)], {}, {}, "'Cast' to another type"),
    "a shape that is computed": ([node("Reshape", ["x", "x"], ["y"])], {}, {}, "whose shape is no constant"),
    "a size that is not there": (
        [node("Reshape", ["x", "s"], ["y"])],
        {"s": np.array([1, 3, 0])},
        {},
        r"from \[1, 3\] to \[1, 3, 0\]",
    ),
    "another size": ([node("Reshape", ["x", "s"], ["y"])], {"s": np.array([7])}, {}, r"from shape \[1, 3\] to \[7\]"),
    "far too many weights": (
        [node("Flatten", ["x"], ["h"]), node("Add", ["h", "w"], ["y"])],
        {"w": np.zeros((30000, 1, 1), np.float32)},
        {"shape": [1, 30000]},
        "far more than can be bounded",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_all_else_is_refused_by_name(what, saved):
    nodes, constants, options, said = REFUSED[what]
    path = saved(nodes, constants, **{"shape": ["N", 3], "outputs": None} | options)
    with pytest.raises(ArtifactError, match=said) as refusal:
        read_network(path)
    assert "\n" not in str(refusal.value) and str(path) in str(refusal.value)


def test_weights_in_another_file_are_refused_and_not_looked_at(saved, tmp_path):
    path = saved([GEMM], {"w": W}, shape=[1, 3], outputs=[1, 3])
    model = onnx.load(path)
    secret = tmp_path / "weights.bin"
    secret.write_bytes(np.zeros(9, np.float32).tobytes())
    tensor = model.graph.initializer[0]
    onnx.external_data_helper.set_external_data(tensor, location=secret.name)
    tensor.ClearField("raw_data")
    path.write_bytes(model.SerializeToString())
    before = secret.stat().st_atime_ns
    with pytest.raises(ArtifactError, match="keeps the weights 'w' in another file"):
        read_network(path)
    assert secret.stat().st_atime_ns == before


def test_several_inputs_are_refused(saved):
    path = saved([node("Add", ["x", "x"], ["y"])], {}, shape=[1, 3], outputs=[1, 3])
    model = onnx.load(path)
    model.graph.input.append(onnx.helper.make_tensor_value_info("z", 1, [1, 3]))
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ArtifactError, match="must have one input and one output, found 2 and 1"):
        read_network(path)


def test_a_small_file_that_asks_for_giant_numbers_is_refused_at_once(saved):
    """Shapes are only said: a tensor of 10^12 entries without data, a Conv whose matrix would have 10^12."""
    path = saved([GEMM], {"w": W}, shape=[1, 3], outputs=[1, 3])
    model = onnx.load(path)
    del model.graph.initializer[0].dims[:]
    model.graph.initializer[0].dims.extend([10**6, 10**6])
    path.write_bytes(model.SerializeToString())
    began = time.monotonic()
    with pytest.raises(ArtifactError, match="unpacks into far more"):
        read_network(path)
    both = [node("Conv", ["x", "w"], ["h"]), node("Conv", ["h", "w"], ["y"])]
    path = saved(both, {"w": np.ones((1, 1, 1), np.float32)}, shape=[1, 1, 3000], outputs=None)
    with pytest.raises(ArtifactError, match="net.onnx: has more than 16777216 numbers, far more than can be bounded"):
        read_network(path)
    conv = [node("Conv", ["x", "w"], ["y"])]
    path = saved(conv, {"w": np.ones((1, 1, 1), np.float32)}, shape=[1, 1, 10**6], outputs=None)
    with pytest.raises(ArtifactError, match="far more than can be bounded"):
        read_network(path)
    assert time.monotonic() - began < 5


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"ONNX?", os.urandom(3000)])
def test_files_that_are_no_onnx_are_refused_in_one_line(content, tmp_path):
    path = tmp_path / "net.onnx"
    path.write_bytes(content)
    with pytest.raises(ArtifactError, match=r"no ONNX network|not a readable ONNX file") as refusal:
        read_network(path)
    assert "\n" not in str(refusal.value)


def test_damaged_bytes_are_refused_or_give_a_network(saved):
    rng = np.random.default_rng(0)
    nodes, constants, options = one_layer("Sub, Conv, Flatten", rng)
    path = saved(nodes, constants, **options)
    whole = bytearray(path.read_bytes())
    for place in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert read_network(path).outputs > 0
        except ArtifactError as e:
            assert "\n" not in str(e)
