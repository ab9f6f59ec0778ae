"""Reading a certificate or a library: the file is untrusted input, and everything in it is checked."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sagemp_cli.checker.cell import Policy
from sagemp_cli.errors import ArtifactError
from sagemp_cli.reading.plain_yaml import plain_yaml
from sagemp_cli.reading.reader import read_tree
from sagemp_cli.reading.tree import Dataset, Group
from sagemp_cli.storage.content import ContentError, content_hash

KINDS = {"sagemp/certificate": 1, "sagemp/library": 1}
"""Schemas that can be checked, with the newest version of their format that is known here."""


@dataclass(frozen=True)
class Document:
    """A file's content; shapes as in ``docs/certificates.md``.

    Attributes:
        kind: ``certificate`` or ``library``.
        config: the resolved config.
        tubes: datasets of ``/data/tubes`` by name, texts as lists of str.
        propagator, rigorous: what made the tubes.
        operations: names and numbers of entries of the recorded relaxations; empty if none are recorded.
        relaxations: ``slope, offset, radius (cells, K, E)`` and perhaps ``kept``.
        policy: the tracker.
        robot: weights of a learned robot by name; empty for one of formulas.
        verdict: of a certificate; empty for a library.
        counterexamples: attributes and datasets of each.
        deviation: of a learned robot from its analytical model, ``(R, K, n)``, if the claim is about that model.
        true_model: a learned robot's claim about its analytical model; the same file, other tubes.
    """

    kind: str
    config: Mapping[str, Any]
    tubes: Mapping[str, Any]
    propagator: str
    rigorous: bool
    operations: tuple[tuple[str, int], ...]
    relaxations: Mapping[str, np.ndarray]
    policy: Policy
    robot: Mapping[str, np.ndarray]
    verdict: str
    counterexamples: tuple[Mapping[str, Any], ...]
    deviation: np.ndarray | None = None
    true_model: Document | None = None


def read_document(path: Path) -> Document:
    """Read and check a file.

    Raises:
        ArtifactError: missing, not HDF5, of another kind, of a newer format, changed since it was written, or with
            anything missing or of the wrong type or shape.
    """
    try:
        tree, _ = read_tree(path, what="a file", damaged="not a certificate, or a damaged one")
        return _read(tree, path)
    except ArtifactError:
        raise
    except ContentError as e:
        raise ArtifactError(f"{path}: {e}") from None
    except (
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        MemoryError,
        RecursionError,
        yaml.YAMLError,
    ) as e:
        raise ArtifactError(f"{path}: not a certificate, or a damaged one ({' '.join(str(e).split())})") from None


def _read(file: Group, path: Path) -> Document:
    schema = str(file.attrs.get("schema", ""))
    if schema not in KINDS:
        raise ArtifactError(f"{path}: is '{schema or 'no artifact'}'; only {' and '.join(KINDS)} can be checked")
    version = int(file.attrs["schema_version"])
    if version > KINDS[schema]:
        raise ArtifactError(
            f"{path}: format {version} of '{schema}' is newer than this checker knows (up to {KINDS[schema]})"
        )
    stored = str(file.attrs.get("content_sha256", ""))
    if not stored:
        raise ArtifactError(f"{path}: has no content hash; make it again with this version of sagemp")
    if content_hash(file) != stored:
        raise ArtifactError(f"{path}: the content was changed after it was written (its hash differs)")
    config = _config(file["config"][()])
    data = file["data"]
    weights = {name: _dataset(d) for name, d in data["tracker"].items()}
    examples = data.get("counterexamples", {})
    document = Document(
        kind=schema.removeprefix("sagemp/"),
        config=config,
        **_tubes(data["tubes"], path),
        policy=_policy(weights, _arguments(data.attrs["tracker_arguments"])),
        robot={name: _dataset(d) for name, d in data.get("dynamics", {}).items()},
        verdict=str(data.attrs.get("verdict", "")),
        counterexamples=tuple(
            {**examples[name].attrs, **{key: _dataset(d) for key, d in examples[name].items()}} for name in examples
        ),
    )
    if "true_model" not in data:
        return document
    true = dataclasses.replace(document, **_tubes(data["true_model/tubes"], path))
    deviation, shape = _dataset(data["true_model/deviation"]), true.tubes["references"].shape
    wanted = (shape[0], shape[1] - 1, shape[2])
    if not document.robot or deviation.shape != wanted or deviation.dtype != np.float64:
        raise ArtifactError(f"{path}: /data/true_model needs a learned robot and a float64 deviation of shape {wanted}")
    return dataclasses.replace(document, true_model=dataclasses.replace(true, deviation=deviation))


def _config(text: str) -> Any:
    """What the config says, if that can be read in one way only: no key twice, no number such as ``010`` (8)."""
    config = plain_yaml(text)
    if yaml.safe_dump(config, sort_keys=True) != text:
        raise ValueError("its config is not written as sagemp writes it, and could be misread")
    return config


def _arguments(text: str) -> Any:
    """The tracker's arguments, likewise."""
    arguments = json.loads(text)
    if json.dumps(arguments) != text:
        raise ValueError("its tracker's arguments are not written as sagemp writes them, and could be misread")
    return arguments


def _tubes(tubes: Group, path: Path) -> dict[str, Any]:
    """What a group of tubes holds, as fields of a :class:`Document`."""
    read = {name: _dataset(tubes[name]) for name in tubes if isinstance(tubes[name], Dataset)}
    _require_shapes(read, path)
    relaxations, operations = {}, ()
    if "relaxations" in tubes:
        group = tubes["relaxations"]
        relaxations = {name: _dataset(group[name]) for name in group}
        operations = tuple(zip(relaxations["operations"], map(int, relaxations["widths"]), strict=True))
        _require_relaxations(relaxations, operations, read, path)
    return {
        "tubes": read,
        "propagator": str(tubes.attrs["propagator"]),
        "rigorous": bool(tubes.attrs["rigorous"]),
        "operations": operations,
        "relaxations": relaxations,
    }


def _dataset(dataset: Dataset) -> Any:
    return list(dataset[()]) if dataset.dtype.kind == "O" else np.asarray(dataset[()])


_SHAPES = {
    "references": "R K+1 n",
    "start_lower": "R n",
    "start_upper": "R n",
    "disturbance_lower": "n",
    "disturbance_upper": "n",
    "cell_reference": "C",
    "cell_lower": "C n",
    "cell_upper": "C n",
    "tube_lower": "C K+1 n",
    "tube_upper": "C K+1 n",
    "control_lower": "R K m",
    "control_upper": "R K m",
    "clearance": "R constraints",
    "goal_margin": "R n",
    "step": "R",
    "seconds": "R",
}
_MERGED = {"cell_begin": "C", "cell_end": "C", "cell_heir": "C"}
"""There together or not at all."""
_TEXTS = {"verdict": "R", "constraint": "R", "constraint_names": "constraints"}


def _require_shapes(tubes: dict[str, Any], path: Path) -> None:
    count, rows, n = tubes["references"].shape
    sizes = {"R": count, "K+1": rows, "K": rows - 1, "n": n, "C": len(tubes["cell_reference"])}
    sizes |= {"m": tubes["control_lower"].shape[-1], "constraints": len(tubes["constraint_names"])}
    if not any(name in tubes for name in _MERGED):
        cells = len(tubes["cell_reference"])
        tubes |= {"cell_begin": np.zeros(cells, np.int64), "cell_end": np.full(cells, rows - 1)}
        tubes["cell_heir"] = np.full(cells, -1)
    for name, dims in {**_SHAPES, **_TEXTS, **_MERGED}.items():
        value, wanted = tubes[name], tuple(sizes[d] for d in dims.split())
        shape = (len(value),) if name in _TEXTS else value.shape
        integer = name in ("cell_reference", "step", *_MERGED)
        kind = str if name in _TEXTS else np.int64 if integer else np.float64
        right = all(isinstance(v, str) for v in value) if name in _TEXTS else value.dtype == kind
        if shape != wanted or not right:
            raise ArtifactError(f"{path}: /data/tubes/{name} must be {kind.__name__} of shape {wanted}")
    if rows < 2 or not np.isin(tubes["cell_reference"], np.arange(count)).all():
        raise ArtifactError(f"{path}: /data/tubes needs at least one step, and cells of its own references")


def _require_relaxations(
    found: Mapping[str, Any], operations: tuple[tuple[str, int], ...], tubes: Mapping[str, Any], path: Path
) -> None:
    cells, rows, _ = tubes["tube_lower"].shape
    wanted = (cells, rows - 1, sum(width for _, width in operations))
    for name in ("slope", "offset", "radius"):
        if found[name].shape != wanted or found[name].dtype != np.float64 or any(w < 1 for _, w in operations):
            raise ArtifactError(f"{path}: /data/tubes/relaxations/{name} must be float64 of shape {wanted}")
    kept = found.get("kept")
    if kept is not None and (kept.shape[:2] != wanted[:2] or kept.ndim != 3 or kept.dtype != np.uint8):
        raise ArtifactError(f"{path}: /data/tubes/relaxations/kept must be uint8 of shape {(*wanted[:2], 'bytes')}")


_ARGUMENTS = {"state_dim", "control_dim", "lookahead", "hidden", "negative_slope"}
_ARGUMENTS |= {"error_scale", "control_scale", "control_offset", "saturate"}


def _policy(weights: Mapping[str, np.ndarray], arguments: Mapping[str, Any]) -> Policy:
    """The tracker; of its constructor's arguments ``negative_slope``, ``lookahead`` and ``saturate`` are taken."""
    unknown = set(arguments) - _ARGUMENTS
    if unknown:
        raise ValueError(f"tracker argument '{min(unknown)}' is not understood")
    depth = sum(name.endswith(".weight") for name in weights)
    layers = [(weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"]) for i in range(depth)]
    scales = [weights[name] for name in ("error_scale", "control_scale", "control_offset")]
    for array in [a for pair in layers for a in pair] + scales:
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise ValueError("tracker weights must be finite float64 numbers")
    if not isinstance(arguments.get("saturate", False), bool):
        raise ValueError("tracker argument 'saturate' must be true or false")
    lookahead, n, m = int(arguments["lookahead"]), len(scales[0]), len(scales[1])
    widths = [lookahead * n, *(len(b) for _, b in layers)]
    fits = all(w.shape == (b, a) for (w, _), a, b in zip(layers, widths[:-1], widths[1:], strict=True))
    fits &= widths[-1] == m == len(scales[2]) and len(weights) == 2 * depth + 3
    fits &= all(a.ndim == 1 for a in (*(b for _, b in layers), *scales))
    if depth < 2 or lookahead < 1 or not fits:
        raise ValueError("tracker weights do not fit each other")
    return Policy(
        weights=tuple(w for w, _ in layers),
        biases=tuple(b for _, b in layers),
        error_scale=scales[0],
        control_scale=scales[1],
        control_offset=scales[2],
        negative_slope=float(arguments["negative_slope"]),
        lookahead=lookahead,
        saturate=arguments.get("saturate", False),
    )
