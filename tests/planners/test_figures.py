"""The figures of a model card, on plans whose figures are known."""

import math

import pytest
import torch

from sagemp_cli.planners import open_loop_figures, plan_figures, side_shares
from sagemp_cli.planners.figures import roughness
from sagemp_cli.scenes.scene import Scene

POSITION = (0, 1)


class Recorded:
    """A planner that repeats given trajectories."""

    def __init__(self, plans):
        self.plans = plans

    def sample(self, start, goal, *, scene, count, generator):
        return self.plans


class Late(Recorded):
    """One whose proposals begin away from the start."""

    def propose(self, start, goal, *, scene, count, generator):
        return self.plans + torch.tensor([0.03, 0.04, 9.0, 9.0])

    def settle(self, plans, start):
        return self.plans


def about(scene):
    return {"scene": scene, "position": POSITION, "generator": torch.Generator()}


def test_figures_of_known_plans(demonstrations, scene):
    def figures(plans):
        return plan_figures(Recorded(plans), demonstrations, **about(scene))

    perfect = figures(demonstrations)
    assert perfect["position error"] == 0 and perfect["collision-free"] == 1 and perfect["in goal"] == 1
    assert perfect["goal error"] == pytest.approx(0, abs=1e-12)
    assert perfect["start error"] == 0 and perfect["roughness"] == pytest.approx(1)
    moved = figures(demonstrations + torch.tensor([0.3, 0.4, 0.0, 0.0]))
    assert moved["position error"] == pytest.approx(0.5) and moved["median position error"] == pytest.approx(0.5)
    assert moved["goal error"] == pytest.approx(0.5) and moved["start error"] == pytest.approx(0.5)
    through = demonstrations.clone()
    through[:15, :, 1] = 0.0
    assert figures(through)["collision-free"] == 0.75
    missing = demonstrations.clone()
    missing[:6, -1, 2] = 2.0
    assert figures(missing)["in goal"] == 0.9


def test_the_start_error_is_that_before_the_plan_was_moved_to_the_start(demonstrations, scene):
    figures = plan_figures(Late(demonstrations), demonstrations, **about(scene))
    assert figures["start error"] == pytest.approx(0.05) and figures["position error"] == 0


def test_shares_are_those_of_the_demonstrated_sides(demonstrations, scene):
    above = float((demonstrations[:, 0, 1] > 0).double().mean())
    assert side_shares(demonstrations, scene=scene, position=POSITION) == {
        "L": pytest.approx(above),
        "R": pytest.approx(1 - above),
    }
    mirrored = demonstrations * torch.tensor([1.0, -1.0, -1.0, 1.0])
    figures = plan_figures(Recorded(mirrored), demonstrations, **about(scene))
    assert figures["share L"] == pytest.approx(1 - above) and figures["share R"] == pytest.approx(above)
    one_side = demonstrations[demonstrations[:, 0, 1] > 0]
    shown = plan_figures(Recorded(one_side * torch.tensor([1.0, -1.0, 1.0, 1.0])), one_side, **about(scene))
    assert shown["share L"] == 0 and "share R" not in shown  # names stay the same over a training


def test_without_obstacles_there_are_no_sides(demonstrations, scene):
    empty = Scene(scene.workspace, (), scene.goal)
    figures = open_loop_figures(Recorded(demonstrations), demonstrations[:, 0], **about(empty))
    assert not any(name.startswith("share") for name in figures) and figures["collision-free"] == 1


def test_figures_without_demonstrations_are_the_open_loop_ones(demonstrations, scene):
    figures = open_loop_figures(Recorded(demonstrations), demonstrations[:, 0], **about(scene))
    assert set(figures) == {"collision-free", "in goal", "goal error", "start error", "share L", "share R"}


def test_roughness_is_the_largest_ratio_of_second_differences_over_the_states():
    s = torch.linspace(0, 1, 201, dtype=torch.float64)
    smooth = torch.stack([torch.sin(math.pi * s), s**2, s, torch.full_like(s, 0.1)], dim=-1)[None]
    assert roughness(smooth, smooth) == pytest.approx(1)
    zigzag = smooth.clone()
    zigzag[0, ::2, 1] += 1e-3  # second differences of 2e-3 on top of 2 / 200^2
    assert roughness(zigzag, smooth) == pytest.approx(math.hypot(2e-3, 5e-5) / 5e-5, rel=0.01)
    assert roughness(smooth[..., 3:], smooth[..., 3:]) == 1.0
