"""A small verification in several chunks, for every executor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch

from sagemp_cli.dynamics import Unicycle
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.problem import Problem
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.scenes import Ball, Scene
from sagemp_cli.sets import Box
from sagemp_cli.verification.cells import CellProver
from sagemp_cli.verification.verification import Verification, verify_references

K = 10


@dataclasses.dataclass(frozen=True)
class Small:
    """Its parts, and ``verify(counts, **options)``."""

    prover: CellProver
    verify: Callable[..., Verification]


@pytest.fixture(scope="session")
def small() -> Small:
    limits = {"control_lower": [-1.5, -2.0], "control_upper": [1.5, 2.0]}
    unicycle = Unicycle(dt=0.1, state_lower=[-3.0, -4.0, -1.6, 0.0], state_upper=[9.0, 4.0, 1.6, 3.0], **limits)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        tracker = Tracker(state_dim=4, control_dim=2, lookahead=3, hidden=[8, 8])
    references = torch.zeros(6, K + 1, 4, dtype=torch.float64)
    references[..., 0] = 0.1 * torch.arange(K + 1)
    references[..., 1] = 0.05 * torch.arange(6)[:, None]
    references[..., 3] = 1.0
    w = Box.around([0.0] * 4, [0.05, 0.05, 0.0, 0.02])

    def prover_of(end):
        goal = Box([-9.0] * 4, [end, 9.0, 9.0, 9.0])
        scene = Scene(Box([-2.0, -2.0], [4.0, 2.0]), (Ball((1.0, 0.9), 0.2, "disc"),), goal)
        start = Box.around([0.0, 0.0, 0.0, 1.0], [0.1, 0.3, 0.0, 0.0])
        return CellProver(Affine(), Problem(unicycle, scene, start, w, K), tracker)

    def verify(counts, end=9.0, **options):
        """``end`` is how far along x the goal extends."""
        return verify_references(
            prover_of(end),
            references,
            counts=counts,
            cells_at_once=4,
            **options,
        )

    return Small(prover_of(9.0), verify)


def assert_same_bits(a: Verification, b: Verification) -> None:
    """All tensors but the seconds."""
    for field in dataclasses.fields(a):
        if field.name != "seconds":
            _assert_same(getattr(a, field.name), getattr(b, field.name))


def _assert_same(a, b):
    assert type(a) is type(b)
    if isinstance(a, torch.Tensor):
        assert torch.equal(a, b)
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            _assert_same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b


@pytest.fixture
def same_bits():
    return assert_same_bits
