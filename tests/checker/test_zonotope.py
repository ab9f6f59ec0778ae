import numpy as np
import pytest
from flint import arb, arb_mat, ctx

from sagemp_cli.checker.balls import Unproved
from sagemp_cli.checker.zonotope import Zonotope


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(128):
        yield


def exact_radius(zonotope, row):
    """The same in ball arithmetic alone."""
    n = len(zonotope.center)
    mapped = arb_mat(1, n, row[:n]) * arb_mat(*zonotope.generators.shape, zonotope.generators.flatten().tolist())
    return sum((abs(a) for a in mapped.entries()), start=arb(0)) + sum((abs(b) for b in row[n:]), start=arb(0))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [1e-200, 1e-12, 1.0, 1e12])
def test_radii_are_upper_bounds_that_exceed_the_exact_ones_by_rounding_only(seed, scale):
    rng = np.random.default_rng(seed)
    n, q, columns = 5, 3, 400
    generators = rng.normal(size=(n, columns)) * np.exp(rng.normal(size=(n, 1)) * 6) * scale
    zonotope = Zonotope([arb(float(c)) for c in rng.normal(size=n)], generators)
    rows = [[arb(float(v)) / 3 for v in rng.normal(size=n + q)] for _ in range(6)]
    found = zonotope.radii(arb_mat(6, 1 + n + q, [a for row in rows for a in [arb(7), *row]]))
    for row, radius in zip(rows, found, strict=True):
        exact = exact_radius(zonotope, row)
        assert exact <= radius
        assert radius <= exact + (exact + 1e-250) * 1e-11


def test_the_radius_of_a_row_of_wide_balls_contains_that_of_every_row_in_it():
    zonotope = Zonotope([arb(0)], np.array([[2.0, -1.0]]))
    (radius,) = zonotope.radii(arb_mat(1, 3, [arb(0), arb(1, 0.5), arb(0, 0.25)]))
    assert 3 * 1.5 + 0.25 <= float(radius) < 3 * 1.5 + 0.2501


@pytest.mark.parametrize("seed", range(5))
def test_an_image_contains_the_images_of_points(seed):
    rng = np.random.default_rng(seed)
    n, q = 4, 3
    zonotope = Zonotope([arb(float(c)) for c in rng.normal(size=n)], rng.normal(size=(n, 7)))
    rows = rng.normal(size=(n, 1 + n + q)) / 3
    image = zonotope.image(arb_mat(n, 1 + n + q, rows.flatten().tolist()))
    bounds = [(float(a), float(b)) for a, b in image.bounds()]
    for _ in range(200):
        eps, own = np.sign(rng.normal(size=7)), np.sign(rng.normal(size=q))
        y = rows[:, 0] + rows[:, 1 : n + 1] @ (zonotope.generators @ eps) + rows[:, n + 1 :] @ own
        assert all(a - 1e-12 <= v <= b + 1e-12 for v, (a, b) in zip(y, bounds, strict=True))
    assert image.generators.shape == (n, 7 + q + n)


def test_dropping_columns_boxes_them():
    zonotope = Zonotope([arb(0), arb(0)], np.array([[1.0, 2.0, 0.0], [1.0, -2.0, 3.0]]))
    reduced = zonotope.reduced(np.array([True, False, False]))
    np.testing.assert_allclose(reduced.generators, [[1, 2, 0], [1, 0, 5]])
    assert (reduced.generators[0, 1] >= 2) and (reduced.generators[1, 2] >= 5)
    assert zonotope.reduced(np.ones(3, dtype=bool)) is zonotope


def test_a_set_that_overflows_proves_nothing():
    with np.errstate(over="ignore"), pytest.raises(Unproved, match="overflowed"):
        Zonotope([arb(0)], np.full((1, 3), 1e308))


def test_a_float_of_a_ball_is_near_its_midpoint():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        x = arb(int(rng.integers(2**62))) ** 2 * arb(2) ** int(rng.integers(-1150, 800)) / 3
        number = float(x)
        assert abs(x - number) <= arb(abs(number)) * arb(2) ** -52 + arb(2) ** -1074 + 2 * x.rad()
