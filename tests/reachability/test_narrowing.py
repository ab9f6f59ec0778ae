"""Cells for the tube alone: those are halved that its hull hangs on."""

import torch

from sagemp_cli.reachability.halves import Halves
from sagemp_cli.reachability.narrowing import narrowing_cells
from sagemp_cli.sets import Box, Tube


class Model:
    """Tubes whose width beyond the cell falls to a quarter where a state's cell is halved, as far as that state has
    any; unbounded while the first state's cell is too wide."""

    def __init__(self, excess, widest=torch.inf):
        self.excess, self.widest, self.calls = excess, widest, []

    def __call__(self, cells):
        self.calls.append(len(cells.lower))
        n = cells.dim
        extra = torch.tensor(self.excess, dtype=torch.float64) * cells.width**2
        reach = extra.sum(-1, keepdim=True).expand(-1, n)
        reach = torch.where(cells.width[:, :1] > self.widest, torch.inf, reach)
        tube = Tube(
            torch.stack([cells.lower, cells.lower - reach], 1), torch.stack([cells.upper, cells.upper + reach], 1)
        )
        shift = torch.zeros(len(cells.lower), n, 2, n, dtype=torch.float64)
        narrowing = torch.zeros_like(shift)
        for i in range(n):
            shift[:, i, :, i] = cells.width[:, i, None] / 4
            narrowing[:, i] = shift[:, i]
            narrowing[:, i, 1] += 0.75 * extra[:, i, None]
        return tube, Halves(shift, narrowing)


def test_only_the_state_that_narrows_the_tube_is_cut():
    found = narrowing_cells(Model([2.0, 0.0]), Box([0.0, 0.0], [1.0, 1.0]))
    assert 4 <= len(found.lower) <= 64
    assert bool((found.width[:, 0, 1] == 1.0).all()) and bool((found.width[:, 0, 0] < 0.3).all())


def test_cells_inside_that_the_hull_does_not_hang_on_stay_whole():
    model = Model([0.5])
    found = narrowing_cells(model, Box([0.0], [8.0]))
    widths = found.width[:, 0, 0]
    outer = (found.lower[:, 0, 0] == 0.0) | (found.upper[:, 0, 0] == 8.0)
    assert float(widths[outer].max()) < float(widths[~outer].max())
    assert sum(model.calls) <= 3 * len(found.lower) and len(model.calls) <= 5


def test_where_halving_gains_nothing_one_cell_is_left():
    model = Model([0.0, 0.0])
    assert len(narrowing_cells(model, Box([0.0, 0.0], [1.0, 1.0])).lower) == 1
    assert len(narrowing_cells(model, Box([0.0, 0.0], [0.0, 0.0])).lower) == 1


def test_a_tube_that_is_unbounded_is_cut_until_it_is_not():
    found = narrowing_cells(Model([0.001, 0.0], widest=0.3), Box([0.0, 0.0], [1.0, 0.1]))
    assert bool(found.bounded.all())


def test_a_cell_is_cut_several_times_in_one_round_and_never_beyond_the_most():
    model = Model([3.0, 2.0])
    found = narrowing_cells(model, Box([0.0, 0.0], [4.0, 4.0]))
    assert model.calls[0] == 1 and model.calls[1] > 2 and len(found.lower) <= 64
    area = (found.width[:, 0, 0] * found.width[:, 0, 1]).sum()
    assert float(area) == 16.0
