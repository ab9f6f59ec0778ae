"""Tampered certificates: each mutant claims something false, or less than its own proof shows, and none is accepted.

The hash of a mutant is made anew, so that the mathematics has to reject it. Where a change might leave the claim
true, simulated rollouts decide first: only a change that they contradict counts as a mutant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

import h5py
import numpy as np
import pytest
import torch
import yaml

from sagemp_cli.checker.check import check
from sagemp_cli.errors import ArtifactError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.pipeline.loop_record import loop_record
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.sets import Box

from .conftest import STEP, constants_of, slots_of

WANTED = {
    "tube": 50, "relaxation": 80, "product": 30, "weight": 50, "reference": 25, "cell": 30, "start": 25,
    "disturbance": 25, "goal": 25, "obstacle": 30, "workspace": 15, "figure": 40, "control": 20, "model": 15,
    "verdict": 20, "structure": 35, "kept": 15, "segment": 40, "between": 30,
}  # fmt: skip
CLEARLY = 1e-7
Change = Callable[[h5py.File], None]


class Truth:
    """What rollouts of the certified loop do: extreme starts under extreme disturbances, and some of all others."""

    def __init__(self, case, rng):
        self.case, self.rng, self.tubes = case, rng, case.tubes
        corners = (torch.from_numpy(v) for v in (self.tubes.cell_lower, self.tubes.cell_upper))
        self.start = [Box(low, high) for low, high in zip(*corners, strict=True)]
        self.reference = torch.from_numpy(self.tubes.references[0])
        self.states, self.controls, self.w = zip(*(self.rollouts(c) for c in range(len(self.start))), strict=True)

    def rollouts(self, c, *, tracker=None, reference=None, disturbance=None, dynamics=None, count=96):
        case, box, n = self.case, self.start[c], self.case.problem.dynamics.state_dim
        loop = ClosedLoop(
            dynamics or case.problem.dynamics,
            tracker or case.tracker,
            self.reference if reference is None else reference,
        )
        w_box = disturbance or case.problem.disturbance
        x = torch.from_numpy(self.rng.uniform(size=(count, n)))
        x[: count // 2] = x[: count // 2].round()
        held = torch.from_numpy(self.rng.integers(0, 2, size=(count, 1, n))).double()
        w = held.expand(count, loop.horizon, n).clone()
        w[::3] = torch.from_numpy(self.rng.uniform(size=w[::3].shape))
        states, controls = loop.rollout(
            box.lower + x * (box.upper - box.lower), w_box.lower + w * (w_box.upper - w_box.lower)
        )
        return states.detach().numpy(), controls.detach().numpy(), w.numpy()

    def escape(self, **changed) -> bool:
        """Whether a rollout of a changed loop clearly leaves the stored tube."""
        for c in range(len(self.start)):
            states, _, _ = self.rollouts(c, **changed)
            lower, upper = self.tubes.tube_lower[c], self.tubes.tube_upper[c]
            if (states < lower - CLEARLY).any() or (states > upper + CLEARLY).any():
                return True
        return False

    def operands(self, c, k) -> tuple[np.ndarray, np.ndarray]:
        """What goes into and comes out of each relaxation (not of the products) at step k, ``(count, 10)``."""
        x = torch.from_numpy(self.states[c][:, k])
        tracker, loop = self.case.tracker, ClosedLoop(
            self.case.problem.dynamics, self.case.tracker, self.reference
        )  # fmt: skip
        errors = loop.window(k) - x[..., None, :]
        first = tracker.layers[0]((errors * tracker.error_scale).flatten(-2))
        second = tracker.layers[1](torch.nn.functional.leaky_relu(first, 0.1))
        theta = x[:, 2:3]
        values = torch.cat([first, second, theta, theta], 1).detach()
        leaky = torch.nn.functional.leaky_relu(values[:, :8], 0.1)
        return values.numpy(), torch.cat([leaky, torch.cos(theta), torch.sin(theta)], 1).numpy()


def change_config(edit: Callable[[dict], None]) -> Change:
    def change(file):
        config = yaml.load(file["config"].asstr()[()], Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        edit(config)
        del file["config"]
        file.create_dataset("config", data=yaml.safe_dump(config, sort_keys=True), dtype=h5py.string_dtype())

    return change


def put(name: str, index, value) -> Change:
    def change(file):
        dataset = file["data/tubes"][name]
        data = dataset[()]
        data[index] = value(data[index]) if callable(value) else value
        dataset[()] = data

    return change


ENTRIES = [*range(8), 8, 9]
"""Entries of the record that are not products: two layers of four, cosine, sine; 10 and 11 are products."""


def tube(rng, truth) -> Iterator[Change]:
    while True:
        c, k, i = rng.integers(2), rng.integers(9), rng.integers(4)
        states = truth.states[c][:, k, i]
        name, bound = ("tube_upper", states.max() - CLEARLY) if rng.random() < 0.5 else (
            "tube_lower", states.min() + CLEARLY)  # fmt: skip
        yield put(name, (c, k, i), bound)


def relaxation(rng, truth) -> Iterator[Change]:
    record = truth.tubes.relaxations
    known = {(c, k): truth.operands(c, k) for c in range(2) for k in range(8)}
    while True:
        c, k, e = int(rng.integers(2)), int(rng.integers(8)), int(rng.integers(10))
        values, results = known[c, k]
        s, o, r = (float(getattr(record, name)[c, k, ENTRIES[e]]) for name in ("slope", "offset", "radius"))
        name = ("slope", "offset", "radius")[rng.integers(3)]
        step = float(rng.choice([-1, 1]) * 10.0 ** rng.uniform(-4, 0))
        new = {"slope": (s + step, o, r), "offset": (s, o + step, r), "radius": (s, o, r * rng.uniform(-1, 0.99))}[name]
        if (np.abs(results[:, e] - new[0] * values[:, e] - new[1]) > new[2] + CLEARLY**2).any():
            yield put(f"relaxations/{name}", (c, k, ENTRIES[e]), new[("slope", "offset", "radius").index(name)])


def product(rng, truth) -> Iterator[Change]:
    record = truth.tubes.relaxations
    while True:
        c, k, e = int(rng.integers(2)), int(rng.integers(8)), int(rng.choice([10, 11]))
        radius = float(record.radius[c, k, e])
        if radius < CLEARLY:
            continue
        yield [
            put("relaxations/radius", (c, k, e), lambda v: v * rng.uniform(-1, 0.9)),
            put("relaxations/offset", (c, k, e), lambda v: v + rng.choice([-1, 1]) * radius * rng.uniform(0.2, 5)),
            put("relaxations/slope", (c, k, e), lambda v: v * rng.choice([-1.0, 0.0, 0.2, 5.0, np.inf])),
        ][rng.integers(3)]


def weight(rng, truth) -> Iterator[Change]:
    names = list(truth.case.tracker.state_dict())
    while True:
        name = names[rng.integers(len(names))]
        state = {key: v.clone() for key, v in truth.case.tracker.state_dict().items()}
        flat = state[name].view(-1)
        place = int(rng.integers(flat.numel()))
        flat[place] += float(rng.choice([-1, 1]) * rng.uniform(0.2, 3))
        tracker = Tracker(**truth.case.arguments)
        tracker.load_state_dict(state)
        if truth.escape(tracker=tracker):
            numbers = loop_record(truth.case.problem, tracker).programs[0].numbers

            def change(file, numbers=numbers):
                file[f"{STEP}/numbers"][()] = numbers

            yield change


def reference(rng, truth) -> Iterator[Change]:
    while True:
        k, i = int(rng.integers(9)), int(rng.integers(4))
        new = truth.reference.clone()
        new[k, i] += float(rng.choice([-1, 1]) * rng.uniform(0.1, 3))
        if truth.escape(reference=new):
            yield put("references", (0, k, i), float(new[k, i]))


def cell(rng, truth) -> Iterator[Change]:
    widths = truth.tubes.cell_upper - truth.tubes.cell_lower
    while True:
        c, i = int(rng.integers(2)), int(rng.integers(2))
        width = float(widths[c, i])
        share = float(10.0 ** rng.uniform(-9, -0.1))
        yield [
            put("cell_upper", (c, i), lambda v: v - share * width),
            put("cell_lower", (c, i), lambda v: v + share * width),
            put("cell_reference", (c,), int(rng.integers(1, 9))),
        ][min(int(rng.integers(5)) // 2, 2)]


def start(rng, truth) -> Iterator[Change]:
    while True:
        i, grow = int(rng.integers(4)), float(10.0 ** rng.uniform(-9, 0))
        yield [
            put("start_upper", (0, i), lambda v: v + grow),
            put("start_lower", (0, i), lambda v: v - grow),
            change_config(lambda c: c["start"]["radius"].__setitem__(i, c["start"]["radius"][i] + grow)),
            change_config(lambda c: c["start"]["center"].__setitem__(i, c["start"]["center"][i] + grow)),
            put("start_upper", (0, i), lambda v: v - 1.0),
        ][rng.integers(5)]


def disturbance(rng, truth) -> Iterator[Change]:
    w = truth.case.problem.disturbance
    while True:
        i, grow = int(rng.integers(4)), float(rng.uniform(0.02, 1))
        upper = w.upper.clone()
        upper[i] += grow
        if rng.random() < 0.5:
            yield change_config(lambda c: c["disturbance"]["radius"].__setitem__(i, w.upper[i].item() + grow))
        elif truth.escape(disturbance=Box(w.lower, upper)):
            yield put("disturbance_upper", (i,), float(upper[i]))


def goal(rng, truth) -> Iterator[Change]:
    last = np.concatenate([s[:, -1] for s in truth.states])
    while True:
        i = int(rng.integers(4))
        if rng.random() < 0.5:
            value = float(last[:, i].max() - CLEARLY)
            yield change_config(lambda c: c["scene"]["goal"]["upper"].__setitem__(i, value))
        else:
            value = float(last[:, i].min() + CLEARLY)
            yield change_config(lambda c: c["scene"]["goal"]["lower"].__setitem__(i, value))


def obstacle(rng, truth) -> Iterator[Change]:
    points = np.concatenate([s[..., :2].reshape(-1, 2) for s in truth.states])
    while True:
        p = points[rng.integers(len(points))]
        nearest = float(np.hypot(*(points - [0.4, 1.0]).T).min())
        low, high = (p - rng.uniform(1e-6, 0.3)).tolist(), (p + rng.uniform(1e-6, 0.3)).tolist()
        yield [
            change_config(lambda c: c["scene"]["obstacles"][0].update(radius=nearest + 1e-6)),
            change_config(lambda c: c["scene"]["obstacles"][0].update(center=p.tolist(), radius=1e-6)),
            change_config(lambda c: c["scene"]["obstacles"][1].update(lower=low, upper=high)),
            change_config(lambda c: c["scene"]["obstacles"].append({"kind": "block", "lower": low, "upper": high})),
        ][rng.integers(4)]


def workspace(rng, truth) -> Iterator[Change]:
    points = np.concatenate([s[..., :2].reshape(-1, 2) for s in truth.states])
    while True:
        i = int(rng.integers(2))
        if rng.random() < 0.5:
            value = float(points[:, i].max() - CLEARLY)
            yield change_config(lambda c: c["scene"]["workspace"]["upper"].__setitem__(i, value))
        else:
            value = float(points[:, i].min() + CLEARLY)
            yield change_config(lambda c: c["scene"]["workspace"]["lower"].__setitem__(i, value))


def figure(rng, truth) -> Iterator[Change]:
    faces = np.isfinite(truth.tubes.goal_margin[0]).nonzero()[0]
    while True:
        more = float(10.0 ** rng.uniform(-9, 1))
        if rng.random() < 0.5:
            yield put("clearance", (0, int(rng.integers(3))), lambda v: v + more)
        else:
            yield put("goal_margin", (0, int(rng.choice(faces))), lambda v: v + more)


def control(rng, truth) -> Iterator[Change]:
    controls = np.concatenate(truth.controls)
    while True:
        k, i = int(rng.integers(8)), int(rng.integers(2))
        if rng.random() < 0.5:
            yield put("control_upper", (0, k, i), float(controls[:, k, i].max() - CLEARLY))
        else:
            yield put("control_lower", (0, k, i), float(controls[:, k, i].min() + CLEARLY))


def model(rng, truth) -> Iterator[Change]:
    def constant(kind, values):
        def change(file):
            slot = slots_of(file, kind)[-1 if kind == "constant" else 0]  # the last one is dt
            file[f"{STEP}/numbers"][constants_of(file, slot)] = values

        return change

    def read_as_state(file):
        """w is no rate: it is added after the product with dt."""
        group, last = file[STEP], len(file[f"{STEP}/kinds"]) - 1
        operands, begin = group["operands"][()], group["operand_begin"][()]
        with_w = next(i for i in slots_of(file, "add") if 1 in operands[begin[i] : begin[i + 1]])
        rate = operands[begin[with_w]]
        operands[operands == with_w] = rate
        operands[begin[with_w] : begin[with_w + 1]] = [rate, rate]
        assert operands[begin[last]] == 0
        operands[begin[last]] = 1
        group["operands"][()] = operands

    while True:
        dt = float(rng.choice([0.05, 0.09, 0.11, 0.2]))
        yield [
            constant("constant", dt),
            read_as_state,
            change_config(lambda c: c.update(horizon=int(rng.integers(9, 20)))),
            constant("leaky_relu", float(rng.uniform(0.2, 0.9))),
            lambda file: file["data/loop"].attrs.__setitem__("lookahead", int(rng.choice([1, 2, 4, 5]))),
        ][rng.integers(5)]


def structure(rng, truth) -> Iterator[Change]:
    numeric = ["references", "start_lower", "cell_upper", "tube_lower", "tube_upper", "disturbance_upper", "clearance",
               "goal_margin", "control_lower", "relaxations/slope", "relaxations/offset",
               "relaxations/radius"]  # fmt: skip

    def nothing_finite(file, name, value):
        data = file["data/tubes"][name][()]
        data.flat[rng.integers(data.size)] = value
        if name == "goal_margin":
            data[0, 0] = value
        file["data/tubes"][name][()] = data

    def rename(file, name):
        slots = slots_of(file, "leaky_relu") + slots_of(file, "cos") + slots_of(file, "sin")
        file[f"{STEP}/kinds"][int(rng.choice(slots))] = name

    def move_size(file):
        file[f"{STEP}/sizes"][int(rng.integers(len(file[f"{STEP}/sizes"])))] += int(rng.choice([-1, 1]))

    def drop(file, name):
        del file["data/tubes"][name]

    def cut(file):
        steps = file["data/tubes/relaxations/slope"][()][:, :-1]
        del file["data/tubes/relaxations/slope"]
        file["data/tubes/relaxations"]["slope"] = steps

    while True:
        name = numeric[rng.integers(len(numeric))]
        value = float("nan") if name.startswith("control") else float(rng.choice([np.nan, np.inf]))
        yield [
            lambda f: nothing_finite(f, name, value),
            lambda f: nothing_finite(f, name, value),
            lambda f: rename(f, str(rng.choice(["relu", "tanh", "abs", "exp", "", "square"]))),
            move_size,
            lambda f: drop(f, name),
            cut,
        ][rng.integers(6)]


def segment(rng, truth) -> Iterator[Change]:
    """An obstacle that a rollout meets between two samples; the file claims no more clearance of it than there is."""
    paths = np.concatenate([s[..., :2] for s in truth.states])
    while True:
        path, k, s = paths[rng.integers(len(paths))], int(rng.integers(8)), float(rng.uniform(0.1, 0.9))
        p = (1 - s) * path[k] + s * path[k + 1]
        half, tall = float(10.0 ** rng.uniform(-6, -2.5)), float(rng.uniform(1e-4, 1))
        number, shape = [
            (0, {"center": p.tolist(), "radius": half}),
            (1, {"lower": [p[0] - half, p[1] - tall], "upper": [p[0] + half, p[1] + tall]}),
        ][rng.integers(2)]
        shape = {key: np.asarray(v).tolist() for key, v in shape.items()}

        def change(file, number=number, shape=shape):
            change_config(lambda c: c["scene"]["obstacles"][number].update(shape))(file)
            put("clearance", (0, 1 + number), -99.0)(file)

        yield change


def between(rng, truth) -> Iterator[Change]:
    """What is claimed of the time between samples, in words and numbers that say nothing, or too much."""

    def said(name, value):
        return lambda file: file["data/tubes"].attrs.__setitem__(name, value)

    while True:
        yield [
            said("between", str(rng.choice(["", "continuous", "Segments", "segment", "always", "samples"]))),
            said("parts", int(rng.choice([0, -1, -8, 65, 2**40]))),
            said("parts", 1),  # in one part a step the clearances of the file are not proved
            lambda file: file["data/tubes"].attrs.__delitem__(str(rng.choice(["between", "parts"]))),
            put("fraction", (0,), float(rng.choice([0.5, -0.125, 1.0, np.nan, np.inf, 1e-300]))),
            lambda file: file["data/tubes"].__delitem__("fraction"),
        ][rng.integers(6)]


CLASSES = {
    f.__name__: f
    for f in (tube, relaxation, product, weight, reference, cell, start, disturbance, goal, obstacle, workspace,
              figure, control, model, structure, segment, between)
}  # fmt: skip


def accepted(path) -> bool:
    try:
        return check(path).answer == "VERIFIED"
    except ArtifactError:
        return False


def test_every_kind_of_tampering_is_covered_by_five_hundred_mutants():
    assert set(CLASSES) | {"verdict", "kept"} == set(WANTED) and sum(WANTED.values()) >= 500


def test_the_certificate_that_the_mutants_come_from_is_accepted(certificate):
    assert accepted(certificate)


@pytest.mark.parametrize("kind", CLASSES)
def test_no_mutant_is_accepted(kind, case, certificate, mutate, tmp_path):
    rng = np.random.default_rng(len(kind))
    mutants = CLASSES[kind](rng, Truth(case, rng))
    outcomes = Counter(
        accepted(mutate(certificate, tmp_path / "mutant.h5", next(mutants))) for _ in range(WANTED[kind])
    )
    assert outcomes == {False: WANTED[kind]}


def test_no_mutant_that_calls_an_uncertified_reference_safe_is_accepted(make, mutate, tmp_path):
    rng = np.random.default_rng(7)
    source = make(disc=[0.4, 0.3]).write(tmp_path / "source.h5")  # in the way
    with h5py.File(source) as file:
        assert file["data/tubes/verdict"].asstr()[()].tolist() == ["MAY_COLLIDE"]
    for _ in range(WANTED["verdict"]):
        lies = rng.random(4) < 0.8

        def change(file, lies=lies):
            tubes = file["data/tubes"]
            tubes["verdict"][0] = "SAFE"
            file["data"].attrs["verdict"] = "VERIFIED"
            if lies[0]:
                tubes["step"][0] = -1
                tubes["constraint"][0] = ""
            if lies[1]:
                tubes["clearance"][0] = 1e-3
            if lies[2]:
                tubes["goal_margin"][0] = 1e-3
            if lies[3]:
                data = tubes["tube_upper"][()]
                data[..., 1] = np.minimum(data[..., 1], -0.25)
                tubes["tube_lower"][..., 1] = np.minimum(tubes["tube_lower"][..., 1], -0.3)
                tubes["tube_upper"][()] = data

        assert not accepted(mutate(source, tmp_path / "mutant.h5", change))


def test_no_mutant_that_keeps_other_generators_is_accepted(make, mutate, tmp_path):
    rng = np.random.default_rng(3)
    source = make(propagator=Affine(symbols=40)).write(tmp_path / "source.h5")
    assert accepted(source)
    for _ in range(WANTED["kept"]):
        c, k, other = int(rng.integers(2)), int(rng.integers(4, 7)), rng.random() < 0.5

        def change(file, c=c, k=k, other=other):
            kept = file["data/tubes/relaxations/kept"][()]
            bits = np.unpackbits(kept[c, k], bitorder="little")
            if other:  # of as many generators, the least important ones
                bits[:] = np.roll(bits, rng.integers(8, 24))
            else:  # all of them boxed: what the states have in common is lost
                bits[:] = 0
            kept[c, k] = np.packbits(bits, bitorder="little")
            file["data/tubes/relaxations/kept"][()] = kept

        assert not accepted(mutate(source, tmp_path / "mutant.h5", change))
