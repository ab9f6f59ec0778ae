import pytest
import torch

from sagemp_cli.errors import ConfigError
from sagemp_cli.sets import Box
from sagemp_cli.sets.partition import parse_partitions, partition, uncertain_dimensions


@pytest.mark.parametrize(
    ("value", "dims", "counts"),
    [
        (4, 2, [2, 2]),
        (6, 2, [3, 2]),
        (5, 2, [5, 1]),
        (25, 2, [5, 5]),
        (8, 3, [2, 2, 2]),
        (12, 3, [3, 2, 2]),
        (1, 2, [1, 1]),
        (7, 1, [7]),
        ("4", 2, [2, 2]),
        ("3x1", 2, [3, 1]),
        ([1, 3], 2, [1, 3]),
        ((4,), 1, [4]),
    ],
)
def test_partitions_are_parsed(value, dims, counts):
    assert parse_partitions(value, dims) == counts


WRONG = [0, -1, "4x", "x4", "", "0x2", "2.5", 2.5, True, None, [], [2, 0], ["2", "2"], "four"]


@pytest.mark.parametrize("value", WRONG)
def test_wrong_partitions_are_refused_with_what_is_allowed(value):
    with pytest.raises(ConfigError, match="must be a positive number of cells in all, or 2 counts such as 2x2; found"):
        parse_partitions(value, 2)


def test_auto_is_allowed_where_asked_for_only():
    assert parse_partitions("auto", 2, auto=True) is None
    assert parse_partitions("2x1", 2, auto=True) == [2, 1]
    with pytest.raises(ConfigError, match="cells in all, 2 counts such as 2x2, or auto; found 'Auto'"):
        parse_partitions("Auto", 2, auto=True)
    with pytest.raises(ConfigError, match="cells in all, or 2 counts such as 2x2; found 'auto'"):
        parse_partitions("auto", 2)


def test_counts_for_the_wrong_number_of_dimensions_are_refused():
    with pytest.raises(ConfigError, match="found 3 counts in '2x2x2'"):
        parse_partitions("2x2x2", 2)


def test_cells_cover_every_start_box_and_leave_certain_dimensions_alone():
    start = Box(torch.tensor([[0.0, 1.0, 2.0], [1.0, 1.0, -2.0]]), torch.tensor([[1.0, 1.0, 4.0], [4.0, 1.0, 0.5]]))
    cells = partition(start, [2, 3])
    assert uncertain_dimensions(start) == [0, 2]
    assert cells.lower.shape == (2, 6, 3)
    points = torch.rand(2, 500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = start.lower[:, None] + points * start.width[:, None]
    for r in range(2):
        inside = (cells.lower[r] <= points[r][:, None]) & (points[r][:, None] <= cells.upper[r])
        assert bool(inside.all(-1).any(-1).all())
        assert torch.equal(cells.lower[r].amin(0), start.lower[r].double())
        assert torch.equal(cells.upper[r].amax(0), start.upper[r].double())


def test_a_count_for_each_uncertain_dimension_is_needed():
    with pytest.raises(ConfigError, match="one count for each of 1 uncertain dimensions"):
        partition(Box.around([0.0, 0.0], [1.0, 0.0]), [2, 2])


def test_a_point_cannot_be_partitioned():
    with pytest.raises(ConfigError, match="single point"):
        parse_partitions(4, 0)
