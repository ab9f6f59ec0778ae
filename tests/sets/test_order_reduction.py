"""Dropped generators are enclosed, and which were dropped is told."""

import numpy as np
import pytest
import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets.order_reduction import NEGLIGIBLE, reduced

from ..reachability.propagator_cases import DISTURBANCE, START, line, unicycle_loop


def drawn(cells=3, n=4, count=40, small=()):
    g = torch.randn(cells, n, count, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    g[..., list(small)] *= 1e-13
    return g


@pytest.mark.parametrize("limit", [None, 30, 12, 1])
def test_the_result_contains_every_vertex_that_the_generators_reach(limit):
    g = drawn(small=range(5, 25))
    found, mask = reduced(g, limit)
    assert limit is None or found.shape[-1] <= max(limit, 5)
    signs = torch.sign(torch.randn(200, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    mask = torch.from_numpy(mask).expand(3, -1)
    for c in range(3):
        kept, box = found[c, :, : int(mask[c].sum())], found[c, :, int(mask[c].sum()) :]
        torch.testing.assert_close(kept, g[c][:, mask[c]], rtol=0, atol=0)
        rest = signs[:, ~mask[c]] @ g[c][:, ~mask[c]].T
        assert bool((rest.abs() <= box.sum(-1)).all()) and bool((box - torch.diag_embed(box.diagonal()) == 0).all())


def test_only_what_is_negligible_in_every_cell_and_state_is_dropped():
    g = drawn(small=range(30))
    g[1, 2, 7] = 10 * NEGLIGIBLE * float(g[1, 2].abs().sum())
    found, mask = reduced(g)
    assert mask.tolist() == [j == 7 or j >= 30 for j in range(40)] and found.shape == (3, 4, 11 + 4)
    widened = found.abs().sum(-1) / g.abs().sum(-1)
    assert bool((widened >= 1 - 1e-14).all()) and float(widened.max()) < 1 + 1e-11


@pytest.mark.parametrize("limit", [None, 30, 12, 1])
def test_arrays_are_reduced_as_tensors_are(limit):
    g = drawn(small=range(5, 25))
    for some in (g, g[..., 25:]):
        tensor, mask = reduced(some, limit)
        array, kept = reduced(some.numpy(), limit)
        np.testing.assert_allclose(array, tensor.numpy(), rtol=1e-14, atol=0)
        assert (mask is None and kept is None) or np.array_equal(kept, mask)


def test_few_negligible_generators_stay_because_a_box_is_not_smaller():
    g = drawn(small=range(4))
    found, mask = reduced(g)
    assert found is g and mask is None


def test_a_long_tube_keeps_few_generators_and_its_width():
    loop = unicycle_loop(line(0.1))
    with torch.no_grad():
        run = Affine().run(loop, START, DISTURBANCE)
    assert len(run.kept) == loop.horizon and not all(bool(mask.all()) for mask in run.kept)


def test_recordings_of_chunks_that_keep_different_generators_are_joined():
    loop = unicycle_loop(line(0.1))
    parts = []
    for scale in (1.0, 1e-3):
        cell = (START.center[None], START.radius[None] * scale)
        box = type(START)(cell[0] - cell[1], cell[0] + cell[1])
        parts.append(Affine().reach(loop, box, DISTURBANCE, watch=True).recording)
    joined = Recording.join(parts)
    size = joined.kept.shape[-1]
    assert size == max(p.kept.shape[-1] for p in parts)
    for i, part in enumerate(parts):
        own = part.kept.shape[-1]
        assert torch.equal(joined.kept[i, :, :own], part.kept[0]) and not joined.kept[i, :, own:].any()
