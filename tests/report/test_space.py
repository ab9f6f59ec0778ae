"""Scenes of three dimensions: boxes have their faces, what is behind an obstacle is drawn before it."""

from types import SimpleNamespace

import numpy as np
import pytest
from mpl_toolkits.mplot3d import Axes3D

from sagemp_cli.config.composition import compose
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.canvas import blank_figure, state_label
from sagemp_cli.report.figure import save_figure
from sagemp_cli.report.space import box_faces, space_axes, space_tube


@pytest.fixture
def problem():
    return problem_of(compose(["experiment=quadrotor_diffusion"]))


@pytest.fixture
def axes(problem):
    figure = blank_figure(6, 5)
    return space_axes(figure, figure.add_gridspec(1, 1)[0], problem)


def straight_tubes(problem):
    """One tube around a straight flight through the room, two cells."""
    start, goal = problem.start.center.numpy(), problem.scene.goal.center.numpy()
    path = start + np.linspace(0, 1, 21)[:, None] * (goal - start)
    reach = np.full(12, 0.1)
    cells = np.stack([path - reach, path - reach]), np.stack([path + reach, path + reach])
    return SimpleNamespace(
        references=path[None],
        cell_reference=np.array([0, 0]),
        cell_lower=cells[0][:, 0],
        cell_upper=cells[1][:, 0],
        tube_lower=cells[0],
        tube_upper=cells[1],
    )


def test_a_box_has_six_faces_on_its_sides():
    lower, upper = np.array([[0.0, 1.0, 2.0]]), np.array([[1.0, 3.0, 5.0]])
    faces = box_faces(lower, upper)
    assert faces.shape == (6, 4, 3)
    areas = sorted(np.linalg.norm(np.cross(f[1] - f[0], f[3] - f[0])) for f in faces)
    assert areas == [2, 2, 3, 3, 6, 6]
    assert (faces.reshape(-1, 3).min(0) == lower[0]).all() and (faces.reshape(-1, 3).max(0) == upper[0]).all()


def test_the_room_is_drawn_to_scale(axes, problem):
    assert isinstance(axes, Axes3D)
    assert (axes.get_xlim(), axes.get_zlim()) == ((0, 5), (0, 5))
    assert axes.get_xlabel() == state_label(problem, 0) and axes.get_zlabel() == state_label(problem, 2)


def test_a_tube_is_drawn_partly_behind_and_partly_before_the_obstacle(axes, problem, tmp_path):
    before = len(axes.collections)
    space_tube(axes, problem, straight_tubes(problem), 0)
    drawn = axes.collections[before:]
    orders = [c.get_zorder() for c in drawn]
    assert min(orders) < 2 < max(orders), "the sphere has zorder 2"
    assert save_figure(axes.figure, tmp_path / "space.png").stat().st_size > 10_000


@pytest.mark.parametrize("far", [1e9, 1e100, 1e300])
def test_a_reference_of_any_size_is_drawn(axes, problem, tmp_path, far):
    tubes = straight_tubes(problem)
    tubes.references[0, 1::2, :3] = far
    with np.errstate(all="ignore"):
        space_tube(axes, problem, tubes, 0)
    assert save_figure(axes.figure, tmp_path / "space.png").stat().st_size > 10_000
