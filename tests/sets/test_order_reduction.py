"""Dropped generators are enclosed, and which were dropped is told."""

import numpy as np
import pytest
import torch

from sagemp_cli.reachability.affine import affine
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.recording import Recording
from sagemp_cli.sets.order_reduction import NOTHING, reduced

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


def test_only_what_costs_nothing_to_box_in_every_cell_is_dropped():
    g = drawn(small=range(30))
    g[1, 2, 7] = 10 * NOTHING * float(g[1, 2].abs().sum())
    g[1, 3, 7] = 10 * NOTHING * float(g[1, 3].abs().sum())
    found, mask = reduced(g)
    assert mask.tolist() == [j == 7 or j >= 30 for j in range(40)] and found.shape == (3, 4, 11 + 4)
    widened = found.abs().sum(-1) / g.abs().sum(-1)
    assert bool((widened >= 1 - 1e-14).all()) and float(widened.max()) < 1 + 1e-11


def test_generators_along_axes_are_one_box_whatever_their_size():
    g = drawn()
    g[..., 8:] = 0.0
    for j in range(8, 40):
        g[:, j % 4, j] = 0.5 + j
    found, mask = reduced(g.numpy(), since=4)
    assert mask.tolist() == [j < 8 for j in range(40)] and found.shape == (3, 4, 8 + 4)
    along = np.diagonal(found[..., 8:], axis1=-2, axis2=-1)
    np.testing.assert_allclose(along, g[..., 8:].sum(-1), rtol=1e-13)
    assert (along >= g[..., 8:].sum(-1).numpy()).all()


def test_what_was_there_before_is_kept_without_a_look():
    g = drawn(small=range(5, 40)).numpy()
    found, mask = reduced(g, since=10)
    assert mask.tolist() == [j < 10 for j in range(40)] and np.array_equal(found[..., :10], g[..., :10])


def test_what_boxing_may_cost_is_bounded_altogether():
    """Each of these costs half of that."""
    g = drawn()
    radius = g.abs().sum(-1)
    g[..., 30:] = 0.25 * NOTHING * radius[..., None]
    _, mask = reduced(g, radius=radius.numpy())
    assert mask is None  # for three are fewer than a box has
    g[..., 20:30] = 0.0
    _, mask = reduced(g, radius=radius.numpy())
    assert int((~mask[30:]).sum()) <= 1 and not mask[20:30].any()


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


def test_a_tube_of_which_every_step_boxes_what_it_adds_keeps_its_width(monkeypatch):
    loop, runs = unicycle_loop(line(0.1)), []
    for many in (10**9, 0):
        monkeypatch.setattr(affine, "MANY", many)
        with torch.no_grad():
            runs.append(Affine().run(loop, START, DISTURBANCE))
    all_, few = (run.tube.width[1:] for run in runs)
    assert runs[1].last.order < 0.6 * runs[0].last.order
    torch.testing.assert_close(few, all_, rtol=1e-4, atol=0)


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
