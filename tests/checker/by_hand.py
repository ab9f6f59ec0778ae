"""Programs written by hand, and what they do to numbers according to torch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from sagemp_cli.checker.program import Instruction, Program


def line(kind: str, *reads: int, constants=(), entries=()) -> Instruction:
    """An instruction."""
    return Instruction(kind, reads, np.array(constants, float).reshape(-1), np.array(entries, np.int64))


def program(*lines: Instruction, n=2, d=1, g=0, **outputs: int) -> Program:
    """A program whose first slots are the state, the disturbance and, if there are any, the numbers."""
    inputs = ["state", "disturbance", *(["numbers"] if g else [])]
    return Program.of([*map(line, inputs), *lines], outputs, states=n, disturbances=d, numbers=g)


OF_ONE: dict[str, Callable] = {
    "neg": torch.neg, "sin": torch.sin, "cos": torch.cos, "tan": torch.tan, "atan": torch.atan, "tanh": torch.tanh,
    "sigmoid": torch.sigmoid, "silu": torch.nn.functional.silu, "exp": torch.exp, "log": torch.log, "sqrt": torch.sqrt,
    "abs": torch.abs, "reciprocal": torch.reciprocal, "relu": torch.relu, "identity": lambda a: a,
    "gelu": torch.nn.functional.gelu, "gelu_tanh": lambda a: torch.nn.functional.gelu(a, approximate="tanh"),
    "mish": torch.nn.functional.mish, "softsign": torch.nn.functional.softsign, "erf": torch.erf,
    "hardswish": torch.nn.functional.hardswish, "floor": torch.floor, "ceil": torch.ceil, "round": torch.round,
    "trunc": torch.trunc, "sign": torch.sign, "positive": lambda a: (a > 0).double(),
    "wrap": lambda a: torch.atan2(a.sin(), a.cos()),
    "float32": lambda a: a.float().double(), "float32_near": lambda a: a.float().double(),
}  # fmt: skip
OF_TWO: dict[str, Callable] = {
    "add": torch.add, "sub": torch.sub, "mul": torch.mul, "div": torch.div, "maximum": torch.maximum,
    "minimum": torch.minimum, "atan2": torch.atan2, "logaddexp": torch.logaddexp,
}  # fmt: skip


def run(made: Program, x: np.ndarray, w: np.ndarray, numbers: np.ndarray | None = None) -> np.ndarray:
    """The next states of points ``(count, n)`` under disturbances ``(count, d)``."""
    given = {"state": x, "disturbance": w, "numbers": numbers}
    values: list[torch.Tensor] = []
    for instruction in made.instructions:
        kind, constants = instruction.kind, torch.from_numpy(instruction.constants)
        read = [values[r] for r in instruction.reads]
        numbers_of = constants.tolist()
        if kind in given:
            value = torch.from_numpy(np.asarray(given[kind], float))
        elif kind == "constant":
            value = constants.expand(len(x), -1)
        elif kind == "pick":
            value = read[0][:, torch.from_numpy(instruction.entries)]
        elif kind == "join":
            value = torch.cat([r.expand(len(x), -1) for r in read], -1)
        elif kind in ("linear", "float32_linear"):
            columns = read[0].shape[1]
            rows = len(constants) // (columns + 1)
            matrix, bias = constants[: rows * columns].reshape(rows, columns), constants[rows * columns :]
            value = read[0] @ matrix.T + bias
            value = value if kind == "linear" else value.float().double()
        elif kind in OF_TWO:
            value = OF_TWO[kind](*read)
        elif kind in OF_ONE:
            value = OF_ONE[kind](read[0])
        elif kind == "where":
            value = torch.where(read[0] > 0, read[1], read[2])
        elif kind == "clamp":
            value = torch.minimum(
                torch.maximum(read[0], constants[: len(constants) // 2]), constants[len(constants) // 2 :]
            )
        elif kind in ("pow", "remainder", "fmod"):
            value = {"pow": torch.pow, "remainder": torch.remainder, "fmod": torch.fmod}[kind](read[0], numbers_of[0])
        elif kind == "leaky_relu":
            value = torch.nn.functional.leaky_relu(read[0], numbers_of[0])
        elif kind == "elu":
            value = torch.nn.functional.elu(read[0], numbers_of[0])
        else:
            value = torch.nn.functional.softplus(read[0], *numbers_of)
        values.append(value)
    return values[made.next].expand(len(x), -1).numpy()
