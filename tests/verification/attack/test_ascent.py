"""Where searches begin and how unit coordinates become points: everywhere in the sets, faces and middles exactly."""

import torch

from sagemp_cli.sets import Box
from sagemp_cli.verification.attack.ascent import first_units, place

START, DISTURBANCE = Box.around([1.0, -2.0], [0.1, 0.3]), Box.around([0.0], [0.7])


def test_searches_begin_in_the_middle_at_corners_and_everywhere_between():
    x, w = first_units((2, 400), 5, START, DISTURBANCE, torch.Generator().manual_seed(0))
    assert x.shape == (2, 400, 2) and w.shape == (2, 400, 5, 1)
    for unit in (x.flatten(2), w.flatten(2)):
        assert not bool(unit[:, 0].any())
        corners, inside = unit[:, 2::2], unit[:, 1::2]
        assert bool((corners.abs() == 1).all()) and abs(float(corners.mean())) < 0.1
        assert bool((inside.abs() < 1).all()) and abs(float(inside.mean())) < 0.1
        assert float(inside.min()) < -0.98 and float(inside.max()) > 0.98 and abs(float(inside.std()) - 0.577) < 0.05


def test_unit_coordinates_are_points_of_the_box_and_its_faces_are_exact():
    unit = torch.tensor([[-1.0, 1.0], [1.0, -1.0], [0.0, 0.5]], dtype=torch.float64)
    points = place(START, unit)
    assert torch.equal(points[:2, 0], torch.stack([START.lower[0], START.upper[0]]))
    assert torch.equal(points[:2, 1], torch.stack([START.upper[1], START.lower[1]]))
    torch.testing.assert_close(points[2], torch.tensor([1.0, -1.85], dtype=torch.float64))
