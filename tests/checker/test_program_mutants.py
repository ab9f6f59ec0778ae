"""Tampered steps: what a certificate's program does, looks ahead at, and is called.

Each mutant changes one thing of the loop and renews the hash. It is rejected; or it is a true certificate of another
loop: then no simulated rollout of *that* loop leaves the stored tube, and what is printed as proved is not what was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import h5py
import numpy as np
import pytest

from sagemp_cli.checker.check import Report, check
from sagemp_cli.checker.claim import claim_rows, equation_lines
from sagemp_cli.checker.document import read_document
from sagemp_cli.checker.program import KINDS
from sagemp_cli.errors import ArtifactError

from .by_hand import run
from .conftest import STEP, Case, constants_of, make_case, mutant

WANTED = {
    "kind": 70, "operand": 60, "constant": 60, "entry": 40, "output": 15, "size": 15, "order": 20, "lookahead": 10,
    "position": 20, "name": 20, "instruction": 30,
}  # fmt: skip
Change = Callable[[h5py.File], None]


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> tuple[Case, Report]:
    """One cell of a unicycle whose tracker saturates, four steps."""
    case = make_case(counts=(1, 1), horizon=4, hidden=(4, 4), limit=0.05, disc=[0.2, 1.0])
    path = case.write(tmp_path_factory.mktemp("small") / "certificate.h5")
    report = check(path)
    assert report.answer == "VERIFIED"
    return case, report


def put(file, name, values):
    attributes = dict(file[f"{STEP}/{name}"].attrs)
    del file[f"{STEP}/{name}"]
    text = h5py.string_dtype() if isinstance(values, list) else None
    file.create_dataset(f"{STEP}/{name}", data=values, dtype=text).attrs.update(
        {k: v for k, v in attributes.items() if k == "doc"}
    )


def kind(rng, file):
    slot = int(rng.integers(3, len(file[f"{STEP}/kinds"])))
    file[f"{STEP}/kinds"][slot] = str(rng.choice(KINDS))


def swapped_kind(rng, file):
    """One of the same form, so that only the mathematics can tell."""
    alike = [
        ["add", "sub", "mul", "div", "maximum", "minimum", "atan2"],
        ["sin", "cos", "tanh", "neg", "atan", "identity"],
    ]
    kinds = file[f"{STEP}/kinds"].asstr()[()].tolist()
    slots = [(i, group) for i, k in enumerate(kinds) for group in alike if k in group]
    slot, group = slots[int(rng.integers(len(slots)))]
    file[f"{STEP}/kinds"][slot] = str(rng.choice([k for k in group if k != kinds[slot]]))


def operand(rng, file):
    operands = file[f"{STEP}/operands"]
    place = int(rng.integers(len(operands)))
    operands[place] = int(rng.integers(-1, len(file[f"{STEP}/kinds"]) + 1))


def constant(rng, file):
    numbers = file[f"{STEP}/numbers"]
    place = int(rng.integers(len(numbers)))
    size = 10.0 ** rng.uniform(-12, 1)
    numbers[place] = float(
        rng.choice([0.0, -numbers[place], numbers[place] + size, numbers[place] * (1 + size), np.nan])
    )


def entry(rng, file):
    indices = file[f"{STEP}/indices"]
    indices[int(rng.integers(len(indices)))] = int(rng.integers(-1, 5))


def output(rng, file):
    file[f"{STEP}/outputs"][int(rng.integers(3))] = int(rng.integers(-2, len(file[f"{STEP}/kinds"]) + 1))


def size(rng, file):
    sizes = file[f"{STEP}/sizes"]
    sizes[int(rng.integers(len(sizes)))] = int(rng.choice([-1, 0, 1, 3, 10**9]))


def order(rng, file):
    """Two instructions change places, without their numbers."""
    kinds = file[f"{STEP}/kinds"].asstr()[()].tolist()
    a = b = 0
    while kinds[a] == kinds[b]:
        a, b = rng.choice(np.arange(3, len(kinds)), 2).tolist()
    kinds[a], kinds[b] = kinds[b], kinds[a]
    put(file, "kinds", kinds)


def lookahead(rng, file):
    file["data/loop"].attrs["lookahead"] = int(rng.choice([-1, 0, 1, 2, 4, 6, 10**9]))


def position(rng, file):
    new = rng.integers(-1, 5, size=int(rng.integers(1, 4))) if rng.random() < 0.5 else rng.permutation(4)[:2]
    del file["data/loop/position"]
    file["data/loop/position"] = new.astype(np.int64)


def name(rng, file):
    which = str(rng.choice(["state_names", "state_units", "control_names", "control_units"]))
    file[f"data/loop/{which}"][int(rng.integers(2))] = str(rng.choice(["px", "py", "m", "km", "a" * 80, "velocity"]))


def instruction(rng, file):
    """One instruction is left out, or is there twice."""
    group = file[STEP]
    kinds, sizes = group["kinds"].asstr()[()].tolist(), group["sizes"][()].tolist()
    slot, twice = int(rng.integers(3, len(kinds))), rng.random() < 0.5
    parts = {}
    for data, begin in (("operands", "operand_begin"), ("numbers", "number_begin"), ("indices", "index_begin")):
        ends, values = group[begin][()], group[data][()]
        parts[data, begin] = [values[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]
    for some in (kinds, sizes, *parts.values()):
        some[slot : slot + 1] = [some[slot]] * 2 if twice else []
    for (data, begin), some in parts.items():
        put(file, data, np.concatenate(some))
        put(file, begin, np.cumsum([0, *map(len, some)]))
    put(file, "kinds", kinds)
    put(file, "sizes", np.array(sizes))
    outputs = group["outputs"][()]
    put(file, "outputs", np.minimum(outputs, len(kinds) - 1))


CLASSES = {
    f.__name__: f
    for f in (kind, operand, constant, entry, output, size, order, lookahead, position, name, instruction)
}  # fmt: skip


def test_there_are_three_hundred_mutants_of_the_step():
    assert set(CLASSES) == set(WANTED) and sum(WANTED.values()) >= 300


def outcome(path, report: Report, rng) -> str:
    """``rejected``, or ``other`` if what is accepted is another loop that keeps to the tube, and is printed as one."""
    try:
        found = check(path)
    except ArtifactError:
        return "rejected"
    if found.answer != "VERIFIED":
        return "rejected"
    before, after = ([*claim_rows(r.document), *equation_lines(r.document)] for r in (report, found))
    assert before != after, "a loop that is printed as another one"
    document, tubes = found.document, found.document.tubes
    x = rng.uniform(tubes["start_lower"][0], tubes["start_upper"][0], (64, 4))
    windows = document.windows(0)
    with np.errstate(all="ignore"):
        for k in range(document.horizon):
            w = rng.choice([-1.0, 1.0], (64, 4)) * tubes["disturbance_upper"]
            x = run(document.programs[0], x, w, np.tile(windows[k], (64, 1)))
            lower, upper = tubes["tube_lower"][0, k + 1], tubes["tube_upper"][0, k + 1]
            assert ((lower - 1e-12 <= x) & (x <= upper + 1e-12)).all(), "a rollout leaves the tube that was proved"
    return "other"


@pytest.mark.parametrize("name_of", CLASSES)
def test_no_mutant_of_the_step_passes_for_the_loop_that_was_certified(name_of, small, tmp_path):
    case, report = small
    rng, change = np.random.default_rng(len(name_of)), CLASSES[name_of]
    found: Counter[str] = Counter()
    while sum(found.values()) < WANTED[name_of]:
        made = swapped_kind if name_of == "kind" and rng.random() < 0.7 else change
        source, path = report.path, tmp_path / "mutant.h5"
        mutant(source, path, lambda file, made=made: made(rng, file))
        with h5py.File(source) as a, h5py.File(path) as b:
            if a.attrs["content_sha256"] == b.attrs["content_sha256"]:
                continue  # nothing was changed
        found[outcome(path, report, rng)] += 1
    print(name_of, dict(found))
    if name_of not in ("name", "position", "lookahead"):
        assert found["rejected"] >= 0.6 * WANTED[name_of]


def test_names_are_no_proof_and_are_printed(small, tmp_path):
    case, report = small

    def rename(file):
        file["data/loop/state_names"][0] = "altitude"

    found = check(mutant(report.path, tmp_path / "mutant.h5", rename))
    assert found.answer == "VERIFIED"
    assert "altitude -0.05 to 0.05 m" in dict(claim_rows(found.document))["X_I"]


def test_the_same_step_written_in_another_way_has_another_fingerprint(small, tmp_path):
    case, report = small

    def twice_negated(file):
        numbers = file[f"{STEP}/numbers"]
        last = constants_of(file, [i for i, k in enumerate(file[f"{STEP}/kinds"].asstr()) if k == "constant"][-1])
        numbers[last] = np.nextafter(numbers[last], 1)

    document = read_document(mutant(report.path, tmp_path / "mutant.h5", twice_negated))
    assert document.programs[0].fingerprint() != report.document.programs[0].fingerprint()
