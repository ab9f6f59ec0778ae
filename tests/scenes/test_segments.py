"""Where straight lines come nearest to obstacles: against a dense search, and against what is known exactly."""

from __future__ import annotations

import pytest
import torch

from sagemp_cli.scenes import Ball, Block, Scene
from sagemp_cli.scenes.segments import along
from sagemp_cli.sets import Box

OBSTACLES = [
    Ball((0.2, -0.1), 0.5),
    Block((-0.5, -0.3), (0.4, 0.6)),
    Block((0.1, -2.0), (0.101, 2.0)),
    Ball((0.2, -0.1, 0.3), 0.5),
    Block((-0.5, -0.3, -0.2), (0.4, 0.6, 0.8)),
]


@pytest.mark.parametrize("obstacle", OBSTACLES, ids=repr)
def test_no_place_of_a_line_is_nearer_than_the_nearest(obstacle):
    d = len(obstacle.center if isinstance(obstacle, Ball) else obstacle.lower)
    generator = torch.Generator().manual_seed(0)
    path = 3 * torch.rand(400, 2, d, dtype=torch.float64, generator=generator) - 1.5
    path[:40, 1] = path[:40, 0]  # standing still
    path[40:80, 1, 0] = path[40:80, 0, 0]  # along a face
    s = obstacle.nearest(path)
    assert s.shape == (400, 1) and bool(((s >= 0) & (s <= 1)).all())
    found = obstacle.signed_distance(along(path, s))[:, 0]
    places = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None, None]
    sampled = obstacle.signed_distance((1 - places) * path[:, 0] + places * path[:, 1]).amin(0)
    length = (path[:, 1] - path[:, 0]).norm(dim=-1)
    assert bool((found <= sampled + 1e-9).all()) and bool((found >= sampled - length / 2000).all())
    assert bool((found < 0).any() & (found > 0).any())


def test_the_gradient_of_the_distance_goes_through_the_line():
    for obstacle in OBSTACLES[:2]:
        path = torch.tensor([[-2.0, 1.3], [2.0, 0.9]], dtype=torch.float64)

        def distance(p, obstacle=obstacle):
            return obstacle.signed_distance(along(p, obstacle.nearest(p)))

        assert torch.autograd.gradcheck(distance, path.requires_grad_(), atol=1e-5)


def test_a_path_through_a_thin_wall_and_out_of_the_workspace_is_seen_between_its_points():
    endless = Box(torch.full((2,), -torch.inf), torch.full((2,), torch.inf))
    scene = Scene(Box([-1.0, -1.0], [1.0, 1.0]), (Block((0.5, -0.5), (0.501, 0.5)),), endless)
    path = torch.tensor([[0.0, 0.0], [0.4, 0.0], [0.6, 0.0], [0.6, 1.2], [0.0, 0.0]], dtype=torch.float64)
    assert bool((scene.signed_distance(path)[:3] > 0).all())
    least = scene.signed_distance_along(path)
    assert least.shape == (4,) and (least > 0).tolist() == [True, False, False, False]
    assert float(least[0]) == pytest.approx(0.1) and float(least[1]) == pytest.approx(-0.0005)
