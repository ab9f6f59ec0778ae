"""Reading a certificate or a library: the file is untrusted input, and everything in it is checked.

One file for all of it, longer than others: what is believed of a file is to be read in one place.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sagemp_cli.checker.between import CONTINUOUS, MOST_PARTS, SAMPLES, SEGMENTS
from sagemp_cli.checker.lag import Lag
from sagemp_cli.checker.ode import Flow, flow_of
from sagemp_cli.checker.program import Instruction, Program
from sagemp_cli.checker.requirement import MOST_REQUIREMENTS, Required
from sagemp_cli.checker.scene import SafeSet, SetOfConfig
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.errors import ArtifactError
from sagemp_cli.reading.plain_yaml import plain_yaml
from sagemp_cli.reading.reader import read_tree
from sagemp_cli.reading.tree import Dataset, Group
from sagemp_cli.storage.content import ContentError, content_hash

KINDS = {"sagemp/certificate": 4, "sagemp/library": 5}
"""Schemas that can be checked, with the version of their format."""
_COMMANDS = {"sagemp/certificate": "verify", "sagemp/library": "build-library"}


@dataclass(frozen=True)
class Document:
    """A file's content; shapes as in ``docs/certificates.md``.

    Attributes:
        kind: ``certificate`` or ``library``.
        config: the resolved config.
        said: what the file says of itself beside its claim: experiment, stage, version, propagator and the like.
        between: ``segments`` if the safe set is claimed to be kept over the whole of every step, ``continuous`` if at
            all times by the solutions of an ODE, or ``samples``.
        parts: of a step, or of a part of a period, which are checked one by one.
        tubes: datasets of ``/data/tubes`` by name, texts as lists of str; ``references`` is None if there are none.
        relaxations: ``slope, offset, radius (cells, K, E)`` and perhaps ``kept``; empty if none are recorded.
        programs: the step, one program or several; in continuous time the control.
        step_program: which of them each step is, ``(K,)``.
        lookahead: N; 0 if the step has no numbers of its own.
        state_names, state_units, control_names, control_units: n and m texts each.
        position: entries of the state that are the position in the scene.
        safe: the scene of the config.
        sets: X_I and W of the config.
        dt: seconds between samples, as the file says; None if it does not. In continuous time it is part of the claim.
        verdict: of a certificate; empty for a library.
        counterexamples: attributes and datasets of each.
        deviation: of a learned robot from its analytical model, ``(R, K, n)``, if the claim is about that model.
        true_model: a learned robot's claim about its analytical model; the same file, other tubes and another program.
        odes: in continuous time the loop's period as programs, for each way in which the period of a cell is divided.
        cell_ode: which of them each cell takes, ``(C,)``.
        flow: in continuous time, datasets of ``/data/tubes/flow`` by name, padded to the most parts of a cell.
        requirements: what has to hold beside the scene.
    """

    kind: str
    config: Mapping[str, Any]
    said: Mapping[str, Any]
    between: str
    parts: int
    tubes: Mapping[str, Any]
    relaxations: dict[str, np.ndarray]
    programs: tuple[Program, ...]
    step_program: np.ndarray
    lookahead: int
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    control_names: tuple[str, ...]
    control_units: tuple[str, ...]
    position: tuple[int, ...]
    safe: SafeSet
    sets: tuple[SetOfConfig, SetOfConfig]
    dt: float | None
    verdict: str
    counterexamples: tuple[Mapping[str, Any], ...]
    deviation: np.ndarray | None = None
    true_model: Document | None = None
    odes: tuple[Flow, ...] = ()
    cell_ode: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    flow: Mapping[str, np.ndarray] = field(default_factory=dict)
    requirements: tuple[Required, ...] = ()

    @property
    def ode(self) -> Flow | None:
        """In continuous time, of which all speak alike: right-hand side and control. None in discrete time."""
        return self.odes[0] if self.odes else None

    @property
    def steps(self) -> tuple[Program, ...]:
        """The programs of a step: of a period, in continuous time."""
        return tuple(ode.step for ode in self.odes) if self.odes else self.programs

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of all that is kept: the scene's constraints, then the requirements."""
        return (*self.safe.names, *(one.name for one in self.requirements))

    def flow_of(self, c: int) -> dict[str, np.ndarray]:
        """The datasets between the samples of a cell, of its own parts."""
        parts = self.odes[self.cell_ode[c]].substeps
        return {
            name: side[c] if side.ndim < 4 else side[c][:, : parts - name.startswith("inner")]
            for name, side in self.flow.items()
        }

    @property
    def horizon(self) -> int:
        """Number of steps K."""
        return len(self.step_program)

    def windows(self, r: int) -> np.ndarray:
        """The numbers of each step on a reference: ``p_{k+1}, ..., p_{k+N}``, padded with ``p_K``; ``(K, N n)``."""
        if not self.lookahead:
            return np.zeros((self.horizon, 0))
        index = np.arange(self.horizon)[:, None] + np.arange(1, self.lookahead + 1)
        return self.tubes["references"][r][np.minimum(index, self.horizon)].reshape(self.horizon, -1)


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
    if version < KINDS[schema]:
        command = "prove" if file.attrs.get("stage") == "prove" else _COMMANDS[schema]
        raise ArtifactError(
            f"{path}: format {version} of '{schema}' is an old one, {KINDS[schema]} can be checked; make it again with "
            f"'sagemp {command} --overwrite'"
        )
    stored = str(file.attrs.get("content_sha256", ""))
    if not stored:
        raise ArtifactError(f"{path}: has no content hash; make it again with this version of sagemp")
    if content_hash(file) != stored:
        raise ArtifactError(f"{path}: the content was changed after it was written (its hash differs)")
    config = _config(file.dataset("config")[()])
    data = file.group("data")
    _require_known(data, "tubes", "loop", "counterexamples", "true_model", "samples", "requirements", *_REJECTED)
    examples = data.group("counterexamples") if "counterexamples" in data else Group("/data/counterexamples", {})
    tubes = _tubes(data.group("tubes"), path)
    _, rows, n = tubes["tubes"]["tube_lower"].shape
    d = len(tubes["tubes"]["disturbance_lower"])
    loop = _loop(data.group("loop"), n, d, rows - 1)
    odes, cell_ode = _odes(loop, loop.pop("rate"), loop.pop("lag"), tubes)
    asked = _requirements(data.group("requirements"), n, rows - 1) if "requirements" in data else ()
    if asked and odes and odes[0].lag is not None:
        raise ArtifactError(f"{path}: /data/requirements are of loops whose control does not lag, this one's does")
    if asked and not odes:
        raise ArtifactError(f"{path}: /data/requirements are of loops in continuous time, this one is not")
    document = Document(
        kind=schema.removeprefix("sagemp/"),
        config=config,
        said={name: _plain(file.attrs[name]) for name in _SAID if name in file.attrs}
        | tubes.pop("said")
        | {
            f"further plans {name}": _plain(data.group("samples").attrs[name]) for name in _SAMPLES if "samples" in data
        },
        **tubes,
        **loop,
        **_problem(config, n, d, loop, path),
        odes=odes,
        cell_ode=cell_ode,
        requirements=asked,
        verdict=str(data.attrs.get("verdict", "")),
        counterexamples=tuple(
            {**example.attrs, **{key: _dataset(example.dataset(key)) for key in example}}
            for example in map(examples.group, examples)
        ),
    )
    _require_fitting(document, path)
    if "true_model" not in data:
        return document
    if odes:
        raise ArtifactError(f"{path}: a claim in continuous time has no /data/true_model")
    true = _tubes(data.group("true_model/tubes"), path)
    true.pop("said")
    if (true["between"], true["parts"]) != (document.between, document.parts):
        raise ArtifactError(f"{path}: /data/true_model is about other times than the robot's own claim")
    program = _program(data.group("true_model/program"), n, d, document.lookahead * n)
    deviation = _dataset(data.dataset("true_model/deviation"))
    true = dataclasses.replace(
        document, **true, programs=(program,), step_program=np.zeros(document.horizon, np.int64), deviation=deviation
    )
    _require_fitting(true, path)
    wanted = (len(true.tubes["verdict"]), true.horizon, n)
    if deviation.shape != wanted or deviation.dtype != np.float64 or program.deviation < 0:
        raise ArtifactError(
            f"{path}: /data/true_model needs a program with a deviation, and float64 bounds of shape {wanted}"
        )
    return dataclasses.replace(document, true_model=true)


_REJECTED = (
    *("rejected_references", "rejected_reason", "reason_names", "reason_counts"),
    *("mode", "mode_names", "mode_drawn"),
)
"""Of a library: what was sampled and not certified, and on which sides references pass."""
_SAMPLES = ("drawn", "certified")
_SAID = ("experiment", "stage", "status", "version", "created_utc", "seconds")


def _odes(
    loop: Mapping[str, Any], rate: Program | None, lag: np.ndarray | None, tubes: Mapping[str, Any]
) -> tuple[tuple[Flow, ...], np.ndarray]:  # fmt: skip
    """The periods of a loop in continuous time, if it is one, and which a cell takes: then all of the file says so."""
    flow, continuous = tubes["flow"], tubes["between"] == CONTINUOUS
    if not continuous and rate is None and not flow and lag is None:
        return (), np.zeros(0, np.int64)
    if not continuous or rate is None or not flow:
        raise ValueError(
            "a claim in continuous time needs 'between: continuous', its right-hand side /data/loop/rate, and "
            "/data/tubes/flow"
        )
    n = flow["lower"].shape[-1]
    if loop["dt"] is None or len(loop["programs"]) != 1 or len(tubes["tubes"]["disturbance_lower"]) != n:
        raise ValueError("a claim in continuous time needs dt, one control, and a disturbance for every state")
    divisions, which = np.unique(np.stack([flow.pop("substeps"), flow.pop("order")], 1), axis=0, return_inverse=True)
    if not 1 <= len(divisions) <= _MOST_DIVISIONS:
        raise ValueError(f"its periods are divided in {len(divisions)} ways; 1 to {_MOST_DIVISIONS} can be checked")
    late = None
    if lag is not None:
        if lag.shape != (2, 2) or lag.dtype != np.float64:
            raise ValueError("/data/loop/lag must be two pairs of float64: of the delay, and of the jitter")
        late = Lag.of(lag.tolist(), loop["dt"])
    made = [
        flow_of(loop["programs"][0], rate, period=loop["dt"], substeps=substeps, order=order, lag=late)
        for substeps, order in divisions.tolist()
    ]
    return tuple(made), which.reshape(-1)


def _requirements(group: Group, n: int, periods: int) -> tuple[Required, ...]:
    """What a group asks for."""
    if len(group) > MOST_REQUIREMENTS:
        raise ValueError(f"{group.name} holds {len(group)} requirements; {MOST_REQUIREMENTS} can be checked")
    found = []
    for one in map(group.group, sorted(group)):
        _require_known(one, "margins")
        name, every, strict, first, last = (one.attrs[key] for key in ("name", "every", "strict", "first", "last"))
        if not isinstance(name, str) or not 0 < len(name) <= _LONGEST_NAME:
            raise ValueError(f"{one.name} needs a short name")
        if not all(isinstance(v, bool | np.bool_) for v in (every, strict)):
            raise ValueError(f"{one.name}: every and strict are truth values")
        if not all(isinstance(v, float | np.floating) for v in (first, last)):
            raise ValueError(f"{one.name}: first and last are float64 numbers")
        margins = _program(one.group("margins"), n, n, 0)
        found.append(Required(name, margins, bool(every), bool(strict), float(first), float(last)))
        found[-1].require_sense(n, periods)
    if len({one.name for one in found}) < len(found):
        raise ValueError(f"{group.name} has a name twice")
    return tuple(found)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else str(value)


def _loop(group: Group, n: int, d: int, steps: int) -> dict[str, Any]:
    """What a group says of the loop, as fields of a :class:`Document`."""
    _require_known(group, "programs", "step_program", "position", "rate", "lag", *_NAMES)
    lookahead = int(group.attrs["lookahead"])
    if not 0 <= lookahead <= _MOST_LOOKAHEAD:
        raise ValueError(f"/data/loop: lookahead is {lookahead}")
    programs = group.group("programs")
    made = tuple(_program(programs.group(name), n, d, lookahead * n) for name in sorted(programs))
    if not made:
        raise ValueError("/data/loop needs a program")
    which, position = _dataset(group.dataset("step_program")), _dataset(group.dataset("position"))
    if which.shape != (steps,) or not np.isin(which, np.arange(len(made))).all() or which.dtype != np.int64:
        raise ValueError(f"/data/loop/step_program must be {steps} numbers of its {len(made)} programs")
    if position.ndim != 1 or position.dtype != np.int64 or not np.isin(position, np.arange(n)).all():
        raise ValueError(f"/data/loop/position must be entries of {n} states")
    if len(set(position.tolist())) != len(position):
        raise ValueError("/data/loop/position names a state twice")
    m = made[0].controls
    rate = _program(group.group("rate"), n, d, m) if "rate" in group else None
    if any(program.controls != m for program in made):
        raise ValueError("/data/loop: its programs have different numbers of controls")
    names = {name: tuple(_dataset(group.dataset(name))) for name in _NAMES}
    longest = max((len(text) for texts in names.values() for text in texts), default=0)
    if [len(v) for v in names.values()] != [n, n, m, m] or longest > _LONGEST_NAME:
        raise ValueError(f"/data/loop must name {n} states and {m} controls and their units, in short words")
    for name in ("state_names", "control_names"):
        if len(set(names[name])) != len(names[name]):
            raise ValueError(f"/data/loop/{name} has a name twice")
    return {
        "programs": made,
        "step_program": which,
        "lookahead": lookahead,
        **names,
        "position": tuple(position.tolist()),
        "dt": float(group.attrs["dt"]) if "dt" in group.attrs else None,
        "rate": rate,
        "lag": _dataset(group.dataset("lag")) if "lag" in group else None,
    }


def _problem(config: Any, n: int, d: int, loop: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Scene, X_I and W of a config, if they can be read in one way only and fit the loop."""
    steps = len(loop["step_program"])
    try:
        safe = SafeSet.of(config.get("scene"))
        safe.require_sizes(len(loop["position"]), n)
        sets = SetOfConfig.of("start", config["start"], n), SetOfConfig.of("disturbance", config["disturbance"], d)
        if config["horizon"] != steps or isinstance(config["horizon"], bool):
            raise Unproved(f"the horizon is {config['horizon']}, the tubes have {steps} steps")
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as e:
        raise ArtifactError(f"{path}: /config does not describe a problem ({' '.join(str(e).split())})") from None
    except Unproved as e:
        raise ArtifactError(f"{path}: /config: {e}") from None
    return {"safe": safe, "sets": sets}


def _program(group: Group, n: int, d: int, g: int) -> Program:
    """A program as stored; instruction i has the parts ``begin[i]..begin[i+1]`` of each list."""
    lists = (("operands", "operand_begin"), ("numbers", "number_begin"), ("indices", "index_begin"))
    _require_known(group, "kinds", "sizes", "outputs", *(name for pair in lists for name in pair))
    kinds = _dataset(group.dataset("kinds"))
    parts = [
        _parts(group, name, begin, np.float64 if name == "numbers" else np.int64, len(kinds)) for name, begin in lists
    ]
    instructions = [
        Instruction(kind, tuple(reads.tolist()), constants, entries)
        for kind, reads, constants, entries in zip(kinds, *parts, strict=True)
    ]
    outputs = _dataset(group.dataset("outputs"))
    if outputs.shape != (3,) or outputs.dtype != np.int64:
        raise ValueError(f"{group.name}/outputs must be three slots")
    named = zip(("next", "control", "deviation"), outputs.tolist(), strict=True)
    numbers = len(kinds) > 2 and kinds[2] == "numbers"
    if bool(g) != numbers:
        raise ValueError(
            f"{group.name}: the step needs {'' if g else 'no '}numbers in slot 2, as it looks ahead or not"
        )
    program = Program.of(
        instructions, {name: slot for name, slot in named if slot != -1 or name == "next"},
        states=n, disturbances=d, numbers=g,
    )  # fmt: skip
    if _dataset(group.dataset("sizes")).tolist() != list(program.widths):
        raise ValueError(f"{group.name}/sizes are not those of its instructions' results")
    return program


def _parts(group: Group, name: str, begin: str, kind: type, count: int) -> list[np.ndarray]:
    values, ends = _dataset(group.dataset(name)), _dataset(group.dataset(begin))
    if values.ndim != 1 or values.dtype != kind or ends.shape != (count + 1,) or ends.dtype != np.int64:
        raise ValueError(f"{group.name}/{name} must be a list of {kind.__name__} with {count + 1} places in {begin}")
    if ends[0] != 0 or ends[-1] != len(values) or (np.diff(ends) < 0).any():
        raise ValueError(f"{group.name}/{begin} does not take {name} apart")
    return [values[a:b] for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]


_NAMES = ("state_names", "state_units", "control_names", "control_units")
_MOST_LOOKAHEAD = 10_000
_LONGEST_NAME = 60
_MOST_DIVISIONS = 16


def _config(text: str) -> Any:
    """What the config says, if that can be read in one way only: no key twice, no number such as ``010`` (8)."""
    config = plain_yaml(text)
    if yaml.safe_dump(config, sort_keys=True) != text:
        raise ValueError("its config is not written as sagemp writes it, and could be misread")
    return config


def _tubes(tubes: Group, path: Path) -> dict[str, Any]:
    """What a group of tubes holds, as fields of a :class:`Document`."""
    _require_known(tubes, "references", "relaxations", "flow", *_SHAPES, *_TEXTS)
    read = {name: _dataset(tubes.dataset(name)) for name in tubes if isinstance(tubes[name], Dataset)}
    read.setdefault("references", None)
    _require_shapes(read, path)
    relaxations = {}
    if "relaxations" in tubes:
        recorded = tubes.group("relaxations")
        _require_known(recorded, "slope", "offset", "radius", "kept")
        relaxations = {name: _dataset(recorded.dataset(name)) for name in recorded}
    between, parts = str(tubes.attrs["between"]), int(tubes.attrs["parts"])
    if between not in (SEGMENTS, SAMPLES, CONTINUOUS):
        raise ValueError(f"{tubes.name}: between is '{between[:40]}'; known are {SEGMENTS}, {SAMPLES} and {CONTINUOUS}")
    if not 1 <= parts <= MOST_PARTS or (between == SAMPLES and parts != 1):
        raise ValueError(f"{tubes.name}: a step is checked in {parts} parts; 1 to {MOST_PARTS} can be")
    return {
        "between": between,
        "parts": parts,
        "tubes": read,
        "said": {name: _plain(tubes.attrs[name]) for name in ("propagator", "rigorous")},
        "relaxations": relaxations,
        "flow": _flow(tubes.group("flow"), read["tube_lower"].shape) if "flow" in tubes else {},
    }


_FLOW = ("lower", "upper", "remainder_lower", "remainder_upper", "curve", "drift")


def _flow(group: Group, tube: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """What a group says of the time between the samples."""
    late = ("jump", "measured_lower", "measured_upper")
    _require_known(group, "substeps", "order", "inner_lower", "inner_upper", *_FLOW, *late)
    cells, rows, n = tube
    substeps, order = (_dataset(group.dataset(name)) for name in ("substeps", "order"))
    for name, given in (("substeps", substeps), ("order", order)):
        if given.shape != (cells,) or given.dtype != np.int64:
            raise ValueError(f"{group.name}/{name} must be int64 of shape {(cells,)}")
    most = int(substeps.max(initial=1))
    shapes = dict.fromkeys(_FLOW, (cells, rows - 1, most, n))
    shapes |= dict.fromkeys(("inner_lower", "inner_upper"), (cells, rows - 1, most - 1, n))
    shapes |= {"jump": (cells, rows - 1, most, n)} | dict.fromkeys(late[1:], (cells, rows - 1, n))
    found = {
        name: _dataset(group.dataset(name)) if name in group or name not in late else np.zeros(shapes[name])
        for name in shapes
    }
    for name, shape in shapes.items():
        if found[name].shape != shape or found[name].dtype != np.float64:
            raise ValueError(f"{group.name}/{name} must be float64 of shape {shape}")
        own = substeps - name.startswith("inner")
        if len(shape) == 4 and (found[name] != 0).any(where=(np.arange(shape[2]) >= own[:, None])[:, None, :, None]):
            raise ValueError(f"{group.name}/{name} says something of parts that a cell does not have")
    return found | {"substeps": substeps, "order": order}


def _require_known(group: Group, *names: str) -> None:
    """Refuse what would be there and neither be proved nor understood."""
    if not set(group) <= set(names):
        raise ValueError(f"{group.name} holds '{min(set(group) - set(names))[:40]}', which no certificate does")


def _dataset(dataset: Dataset) -> Any:
    return list(dataset[()]) if dataset.dtype.kind == "O" else np.asarray(dataset[()])


_SHAPES = {
    "start_lower": "R n",
    "start_upper": "R n",
    "disturbance_lower": "d",
    "disturbance_upper": "d",
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
    "fraction": "R",
    "seconds": "R",
}
_TEXTS = {"verdict": "R", "constraint": "R", "constraint_names": "constraints"}


def _require_shapes(tubes: Mapping[str, Any], path: Path) -> None:
    cells, rows, n = tubes["tube_lower"].shape
    sizes = {"R": len(tubes["verdict"]), "K+1": rows, "K": rows - 1, "n": n, "C": cells}
    sizes |= {"m": tubes["control_lower"].shape[-1], "constraints": len(tubes["constraint_names"])}
    sizes |= {"d": tubes["disturbance_lower"].size}
    references = {} if tubes["references"] is None else {"references": "R K+1 n"}
    for name, dims in {**_SHAPES, **_TEXTS, **references}.items():
        value, wanted = tubes[name], tuple(sizes[d] for d in dims.split())
        shape = (len(value),) if name in _TEXTS else value.shape
        kind = str if name in _TEXTS else np.int64 if name in ("cell_reference", "step") else np.float64
        right = all(isinstance(v, str) for v in value) if name in _TEXTS else value.dtype == kind
        if shape != wanted or not right:
            raise ArtifactError(f"{path}: /data/tubes/{name} must be {kind.__name__} of shape {wanted}")
    if rows < 2 or not np.isin(tubes["cell_reference"], np.arange(sizes["R"])).all():
        raise ArtifactError(f"{path}: /data/tubes needs at least one step, and cells of its own references")


def _require_fitting(document: Document, path: Path) -> None:
    """Refuse tubes that are not those of the loop: other controls, other relaxations, no reference to look ahead on."""
    tubes, found = document.tubes, document.relaxations
    cells, rows, _ = tubes["tube_lower"].shape
    if tubes["control_lower"].shape[-1] != document.programs[0].controls:
        raise ArtifactError(
            f"{path}: /data/tubes/control_lower is not of the program's {document.programs[0].controls}"
        )
    if document.lookahead and tubes["references"] is None:
        raise ArtifactError(f"{path}: /data/loop looks {document.lookahead} steps ahead, but there are no references")
    if not found:
        return
    most = max(program.relaxations for program in document.steps)
    wanted = (cells, rows - 1, most)
    for name in ("slope", "offset", "radius"):
        if found[name].shape != wanted or found[name].dtype != np.float64:
            raise ArtifactError(
                f"{path}: /data/tubes/relaxations/{name} must be float64 of shape {wanted}, the steps' own"
            )
    kept = found.get("kept")
    if kept is not None and (kept.shape[:2] != wanted[:2] or kept.ndim != 3 or kept.dtype != np.uint8):
        raise ArtifactError(f"{path}: /data/tubes/relaxations/kept must be uint8 of shape {(*wanted[:2], 'bytes')}")
