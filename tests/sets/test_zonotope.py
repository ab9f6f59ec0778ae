"""Zonotopes enclose what they say, as arrays and as tensors."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from sagemp_cli.sets import Box
from sagemp_cli.sets.zonotope import Zonotope


def drawn(kind, cells=3, n=2, count=7):
    generator = torch.Generator().manual_seed(0)
    c = torch.randn(cells, n, dtype=torch.float64, generator=generator)
    g = torch.randn(cells, n, count, dtype=torch.float64, generator=generator)
    return Zonotope(c, g) if kind == "tensors" else Zonotope(c.numpy(), g.numpy())


KINDS = pytest.mark.parametrize("kind", ["arrays", "tensors"])


@KINDS
def test_bounds_hold_in_exact_arithmetic_and_are_narrow(kind):
    z = drawn(kind)
    for cell in range(3):
        for i in range(2):
            c, row = Fraction(float(z.center[cell, i])), [Fraction(float(v)) for v in z.generators[cell, i]]
            reach = sum(map(abs, row))
            assert reach <= Fraction(float(z.reach[cell, i])) <= reach * (1 + Fraction(1, 10**13))
            assert Fraction(float(z.low[cell, i])) <= c - reach and c + reach <= Fraction(float(z.high[cell, i]))
    box = z.enclose()
    assert isinstance(box, Box) and np.array_equal(box.lower, z.low) and np.array_equal(box.upper, z.high)


@KINDS
def test_an_affine_map_has_the_image_of_every_point(kind):
    z = drawn(kind)
    make = torch.as_tensor if kind == "tensors" else np.asarray
    matrix, fresh = make([[[1.0, -0.5], [0.25, 2.0]]]), make([[[0.5], [0.0]]])
    matrix, fresh = (v.double() if kind == "tensors" else v for v in (matrix, fresh))
    radius, rounding = (make([0.5]), make(np.full((3, 2), 0.125)))
    image = z.affine_map(matrix, z.center + 1.0, fresh=fresh, radius=radius, rounding=rounding)
    assert image.order == 7 + 1 + 2
    generator = np.random.default_rng(0)
    for _ in range(50):
        eps, v, r = (
            generator.uniform(-1, 1, 7),
            generator.uniform(-0.5, 0.5, 1),
            generator.uniform(-0.125, 0.125, (3, 2)),
        )
        moved = np.asarray(matrix) @ (np.asarray(z.generators) @ eps)[..., None]
        point = np.asarray(z.center) + 1.0 + moved[..., 0] + np.asarray(fresh)[0] @ v + r
        assert (np.asarray(image.low) <= point).all() and (point <= np.asarray(image.high)).all()
    expected = np.abs(np.asarray(matrix) @ np.asarray(z.generators)).sum(-1) + [0.25 + 0.125, 0.125]
    np.testing.assert_allclose(np.asarray(image.reach), expected, rtol=1e-12)


@KINDS
def test_a_reduced_zonotope_encloses_the_one_it_was(kind):
    z = drawn(kind, count=30)
    smaller, mask = z.reduce_order(10)
    assert smaller.order == 10 and mask.sum() == 3 * 8
    assert (np.asarray(smaller.low) <= np.asarray(z.low)).all() and (
        np.asarray(smaller.high) >= np.asarray(z.high)
    ).all()
    same, nothing = z.reduce_order()
    assert same is z and nothing is None


@KINDS
def test_what_has_overflown_is_told_and_the_rest_is_not_disturbed(kind):
    z = drawn(kind)
    assert z.settled()[0] is z and z.settled()[1] is None
    spoilt = Zonotope(z.center, z.generators * 1.0)
    spoilt.generators[1, 0, 3] = np.inf
    found, bad = spoilt.settled()
    assert np.asarray(bad).tolist() == [False, True, False]
    assert np.isnan(np.asarray(found.generators)[1]).all()
    assert np.array_equal(np.asarray(found.generators)[::2], np.asarray(z.generators)[::2])


def test_a_box_is_a_zonotope_with_a_generator_per_side():
    box = Box.around([1.0, -2.0], [0.5, 0.25])
    z = Zonotope.of(box)
    assert z.order == 2 and bool((z.low <= box.lower).all()) and bool((z.high >= box.upper).all())
