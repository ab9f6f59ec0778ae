import numpy as np
import pytest

from sagemp_cli.checker.cover import covered
from sagemp_cli.sets import Box

LOW, HIGH = np.array([0.0, -1.0, 2.0]), np.array([1.0, 3.0, 2.0])  # flat in the last dimension


def cells_of(*boxes):
    return np.array([b[0] for b in boxes], dtype=float), np.array([b[1] for b in boxes], dtype=float)


def random_cells(rng, depth=5):
    """Cells of any shape from random cuts."""
    boxes = [(LOW, HIGH)]
    for _ in range(2**depth):
        low, high = boxes.pop(int(rng.integers(len(boxes))))
        i, left, right = int(rng.integers(2)), high.copy(), low.copy()
        left[i] = right[i] = low[i] + rng.uniform(0.1, 0.9) * (high[i] - low[i])
        boxes += [(low, left), (right, high)]
    return boxes


@pytest.mark.parametrize("seed", range(10))
def test_random_cuts_cover_and_do_not_if_any_one_cell_is_missing_or_a_hair_smaller(seed):
    rng = np.random.default_rng(seed)
    boxes = random_cells(rng)
    rng.shuffle(boxes)
    lower, upper = cells_of(*boxes)
    assert covered(LOW, HIGH, lower, upper)
    c, i = int(rng.integers(len(boxes))), int(rng.integers(2))
    assert not covered(LOW, HIGH, np.delete(lower, c, 0), np.delete(upper, c, 0))
    upper[c, i] = np.nextafter(upper[c, i], -np.inf)
    assert not covered(LOW, HIGH, lower, upper)


def test_overlapping_cells_may_cover_and_larger_ones_do():
    assert covered(LOW, HIGH, *cells_of(([-1, -2, 1], [0.6, 5, 3]), ([0.5, -1, 2], [1, 3, 2])))


def test_a_cell_beside_a_flat_dimension_does_not_help():
    assert not covered(LOW, HIGH, *cells_of(([0, -1, 2.1], [1, 3, 2.2])))
    assert not covered(LOW, HIGH, np.zeros((0, 3)), np.zeros((0, 3)))


def test_the_uniform_partition_of_a_box_covers_it():
    box = Box(LOW, HIGH)
    cells = box.split([7, 5, 1])
    assert covered(LOW, HIGH, cells.lower.numpy(), cells.upper.numpy())


def test_corners_alone_do_not_cover_what_lies_between_them():
    square = np.zeros(2), np.ones(2)
    assert not covered(*square, *cells_of(([0, 0], [0.5, 0.5]), ([0.5, 0.5], [1, 1]), ([0, 0.5], [0.5, 1])))
