"""Calls every public function of torch with values of a recorded step. Run in a process of its own: it may die.

``python fuzzed_functions.py torch.linalg`` prints one line a function before it is called, so that the last line names
the one that killed the interpreter. Arguments after the namespace are the only functions to call, or with ``-NAME``
those to leave out.
"""

from __future__ import annotations

import faulthandler
import importlib
import itertools
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch

from sagemp_cli.errors import SagempError
from sagemp_cli.reachability.program.recorder import Recorder
from sagemp_cli.reachability.program.value import Traced

NAMESPACES = (
    "torch", "torch.Tensor", "torch.nn.functional", "torch.func", "torch.linalg", "torch.special", "torch.fft",
    "torch.nested", "torch.sparse", "torch.utils.dlpack", "torch.autograd.functional", "torch.nn.utils",
    "torch.nn.init", "torch.masked", "torch._C._nn", "torch.signal.windows",
)  # fmt: skip

NOT_CALLED = frozenset(
    [
        "PyTorchFileWriter",
        "compile",
        "cond",
        "fork",
        "from_file",
        "gds",
        "hub",
        "import_ir_module",
        "init_num_threads",
        "load",
        "manual_seed",
        "save",
        "seed",
        "set_default_device",
        "set_default_dtype",
        "set_default_tensor_type",
        "set_flush_denormal",
        "set_num_interop_threads",
        "set_num_threads",
        "set_printoptions",
        "set_vital",
        "typename",
        "unify_type_list",
        "wait",
        "while_loop",
    ]
)
"""They end, stop or configure the process, wait for others, or read files: nothing to do with a value."""


def functions(namespace: str) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Name and function of all that a namespace offers; classes too, since they construct."""
    owner = torch.Tensor if namespace == "torch.Tensor" else importlib.import_module(namespace)
    for name in sorted(dir(owner)):
        if name in NOT_CALLED or (name.startswith("_") and namespace != "torch.Tensor"):
            continue
        try:
            function = getattr(owner, name)
        except Exception:
            continue
        if callable(function) and not (isinstance(function, type) and issubclass(function, BaseException)):
            yield name, function


def argument_lists(like: torch.Tensor) -> list[tuple[Any, ...]]:
    """Values, lists of values, constants and numbers in the first positions."""

    def value() -> Traced:
        recorder = Recorder(like.flatten(), like.flatten(), like.flatten()[:0])
        return Traced(recorder, recorder.state.reshape(like.shape))

    def one(kind: str, shared: Traced) -> Any:
        return {
            "value": shared,
            "list": [shared, shared],
            "entries": list(shared),
            "constant": torch.ones(like.shape, dtype=torch.float64),
            "number": 1,
            "function": torch.sin,
        }[kind]

    chosen = [("value",), ("list",), ("entries",)]
    chosen += [("value", k) for k in ("value", "number", "constant", "list")]
    chosen += [(k, "value") for k in ("constant", "number", "function")]
    chosen += [("value", "value", "value"), ("value", "number", "number"), ("constant", "constant", "value")]
    shared = [value() for _ in chosen]
    return [tuple(one(k, s) for k in kinds) for kinds, s in zip(chosen, shared, strict=True)]


def _too_long(*_: Any) -> None:
    raise TimeoutError


def main() -> None:
    """Call them; what is returned of plain numbers must not be the value's memory."""
    faulthandler.enable()
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _too_long)
    namespace, *names = sys.argv[1:]
    left_out, only = [n[1:] for n in names if n.startswith("-")], [n for n in names if not n.startswith("-")]
    for name, function in functions(namespace):
        if name in left_out or (only and name not in only):
            continue
        print(name, flush=True)
        for like in (torch.tensor([1.0, 2.0], dtype=torch.float64), torch.eye(2, dtype=torch.float64)):
            for arguments in argument_lists(like):
                signal.alarm(5)
                try:
                    with torch.no_grad():
                        result = function(*arguments)
                    read = list(itertools.islice(_numbers(result), 4))
                except (Exception, SystemExit) as error:
                    read = [] if isinstance(error, SagempError) else [str(error)]
                finally:
                    signal.alarm(0)
                del read


def _numbers(result: Any) -> Iterator[Any]:
    """What can be read from a result."""
    for part in result if isinstance(result, (list, tuple)) else [result]:
        if isinstance(part, torch.Tensor) and not isinstance(part, Traced):
            yield part.flatten()[:4].tolist()
        else:
            yield repr(part)[:40]


if __name__ == "__main__":
    main()
