"""Certificates of loops that compute in float32: the checker has its own account of their rounding."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from sagemp_cli.checker.balls import arb
from sagemp_cli.checker.check import check
from sagemp_cli.checker.claim import claim_rows, equation_lines
from sagemp_cli.checker.float32 import ROUNDINGS, of_sums
from sagemp_cli.checker.points import value_of
from sagemp_cli.checker.program import Instruction
from sagemp_cli.checker.unproved import Unproved
from sagemp_cli.errors import ArtifactError
from sagemp_cli.sets import Box
from sagemp_cli.stages.prove import prove

from .conftest import STEP, make_case

UNIT = Fraction(1, 2**24)
TUBES = "data/tubes"


def network():
    g = torch.Generator().manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(2, 6), torch.nn.ReLU(), torch.nn.Linear(6, 6), torch.nn.Tanh(), torch.nn.Linear(6, 1)
    )
    for p in net.parameters():
        p.data = 0.7 * torch.randn(p.shape, generator=g)
    return net


def steered(cast):
    net = network().to(torch.float64)

    def step(x, w):
        if cast:
            h = cast(x)
            for i, layer in enumerate(net):
                linear = isinstance(layer, torch.nn.Linear)
                h = torch.nn.functional.linear(h, layer.weight.float(), layer.bias.float()) if linear else net[i](h)
            u = h.double()[..., 0]
        else:
            u = net(x)[..., 0]
        a, r = x[..., 0], x[..., 1]
        return torch.stack([a + 0.1 * r, 0.9 * r - 0.3 * a + 0.1 * u + w[..., 0]], -1)

    return step


def proved(path, cast=lambda x: x.float(), **options):
    prove(
        steered(cast), Box.around([0.5, 0.0], [0.1, 0.1]), Box.around([0.0], [0.01]), 4, partitions=1, restarts=1,
        certificate=path, **options,
    )  # fmt: skip
    return path


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    return proved(tmp_path_factory.mktemp("float32") / "loop.h5")


def test_it_is_proved_and_what_is_float32_is_shown(certificate):
    report = check(certificate)
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    assert dict(claim_rows(report.document))["arithmetic"].startswith("float32 where the equations say float32")
    text = "\n".join(equation_lines(report.document))
    assert text.count("float32(") >= 6 + 2 and "float32_near(" in text


def test_a_tracker_that_saturates_is_proved_in_float32(tmp_path):
    case = make_case(limit=0.02, horizon=4, precision="float32")
    report = check(case.write(tmp_path / "certificate.h5"))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    lower, upper = case.tubes.control_lower, case.tubes.control_upper
    assert -0.02 * (1 + 1e-6) < lower.min() < -0.02 or 0.02 < upper.max() < 0.02 * (1 + 1e-6)


def test_a_sampled_tracker_in_float32_is_proved_in_continuous_time(tmp_path):
    case = make_case(horizon=4, counts=(1, 1), time="continuous", precision="float32")
    report = check(case.write(tmp_path / "certificate.h5"))
    assert report.answer == "VERIFIED", (report.problems, report.findings)
    assert any("float32(" in line for line in equation_lines(report.document))


ENTRIES = {"float32": 2, "float32_linear": 13, "float32_near": 6}


def entries_of(file, kind):
    """Where the relaxations of a kind are."""
    kinds, sizes = file[f"{STEP}/kinds"].asstr()[()], file[f"{STEP}/sizes"][()]
    relaxed = [(k, s) for k, s in zip(kinds, sizes, strict=True) if k in ("relu", "tanh", *ENTRIES)]
    ends = np.cumsum([0, *(s for _, s in relaxed)])
    return [j for (k, s), end in zip(relaxed, ends, strict=False) if k == kind for j in range(end, end + s)]


@pytest.mark.parametrize("kind", ENTRIES)
def test_a_smaller_error_is_refused(kind, certificate, mutate, tmp_path):
    rng = np.random.default_rng(0)
    for trial in range(8):

        def change(file):
            places = entries_of(file, kind)
            assert len(places) == ENTRIES[kind]
            j, k = int(rng.choice(places)), int(rng.integers(4))
            file[f"{TUBES}/relaxations/radius"][0, k, j] *= rng.choice([0.0, 0.5, 0.9])

        report = check(mutate(certificate, tmp_path / f"{kind}{trial}.h5", change))
        assert report.answer == "UNKNOWN" and f"'{kind}' is wrong" in report.findings[0].reason


def other_kind(kind, other):
    def change(file):
        kinds = file[f"{STEP}/kinds"].asstr()[()].tolist()
        file[f"{STEP}/kinds"][kinds.index(kind)] = other

    return change


def test_a_proof_of_one_rounding_is_none_of_what_functions_err_by(certificate, mutate, tmp_path):
    report = check(mutate(certificate, tmp_path / "mutant.h5", other_kind("float32", "float32_near")))
    assert report.answer == "UNKNOWN"


def test_a_proof_in_real_arithmetic_is_none_in_float32(mutate, tmp_path):
    path = mutate(proved(tmp_path / "real.h5", None), tmp_path / "mutant.h5", other_kind("linear", "float32_linear"))
    with pytest.raises(ArtifactError, match="the steps' own"):
        check(path)


def test_a_narrower_tube_is_refused(certificate, mutate, tmp_path):
    def change(file):
        lower, upper = file[f"{TUBES}/tube_lower"], file[f"{TUBES}/tube_upper"]
        middle = (lower[()] + upper[()]) / 2
        for side in (lower, upper):
            rows = middle + (side[()] - middle) * (1 - 1e-9)
            rows[:, 0] = side[:, 0]
            side[...] = rows

    assert check(mutate(certificate, tmp_path / "mutant.h5", change)).answer == "UNKNOWN"


def exactly(number):
    return Fraction(float(number.upper()))


def test_errors_of_sums_hold_the_worst_roundings_in_every_order():
    rng = np.random.default_rng(0)
    for terms in (1, 2, 5, 64):
        assert exactly(of_sums(arb(1), terms)) >= (1 + UNIT) ** (terms + 1) - 1
        for _ in range(20):
            w, a = (rng.normal(size=terms).astype(np.float32) for _ in range(2))
            b = np.float32(rng.normal())
            instruction = Instruction("float32_linear", (0,), np.concatenate([w, [b]]).astype(np.float64))
            (found,) = value_of(instruction, [[arb(float(v)) for v in a]])
            total = np.float32(0)
            for j in rng.permutation(terms + 1):
                total = total + (b if j == terms else w[j] * a[j])
            assert found.contains(arb(float(total)))


def test_a_rounding_holds_what_numpy_gives():
    rng = np.random.default_rng(1)
    for size in (1e-44, 1e-38, 1e-3, 1.0, 1e30):
        for x in rng.normal(size=50) * size:
            found = ROUNDINGS["float32"].value(arb(float(x)))
            assert found.contains(arb(float(np.float32(x)))) and found.contains(arb(0)) == (abs(x) <= 2.0**-126)
    assert not ROUNDINGS["float32"].value(arb(1.0)).contains(arb(1 + 2.0**-23))


@pytest.mark.parametrize("size", [2.0**126, math.inf, math.nan])
def test_nothing_is_known_of_what_may_overflow(size):
    for error in (lambda: of_sums(arb(size), 2), lambda: ROUNDINGS["float32"].value(arb(size))):
        with pytest.raises(Unproved, match="overflow"):
            error()
