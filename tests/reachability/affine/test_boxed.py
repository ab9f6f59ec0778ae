"""What boxing does to a tube is said where it matters, and only there."""

import warnings

import numpy as np
import pytest
import torch

from sagemp_cli.errors import TubeWarning
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.affine import boxed as boxed_module
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.boxed import Boxed
from sagemp_cli.reachability.crown.best import Best
from sagemp_cli.reachability.crown.crown import Crown
from sagemp_cli.sets import Box
from sagemp_cli.verification.cells import CellTubes

from ..propagator_cases import DISTURBANCE, START, line, unicycle_loop

K = 60
X, W = Box.around([0.1, 0.0], [0.05, 0.05]), Box.around([0.0, 0.0], [0.01, 0.01])


def turned(factor, angle=0.6):
    """A step that turns and contracts: a box of it is turned anew each time, which costs up to 1.4 of the width."""
    c, s = factor * np.cos(angle), factor * np.sin(angle)
    matrix = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    return lambda x, w: x @ matrix.T + w


def test_an_explosion_is_never_silent():
    step = turned(0.95)
    whole = reach(step, X, W, K)
    with pytest.warns(
        TubeWarning, match="symbols=4: up to .* % of the tube's width are there because generators were boxed"
    ) as said:
        wide = reach(step, X, W, K, propagator=Affine(symbols=4))
    assert float(wide.width[-1].max()) > 50 * float(whole.width[-1].max())
    share = float(str(said[0].message).split("up to ")[1].split(" %")[0])
    assert share > 90 and len(said) == 1


def test_a_tube_that_boxing_hardly_widens_is_given_without_a_word():
    step = turned(0.5)
    whole = reach(step, X, W, K)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reach(step, X, W, K)
        tube = reach(step, X, W, K, propagator=Affine(symbols=20))
    assert float(tube.width[-1].max()) < 1.01 * float(whole.width[-1].max())


def test_the_excess_of_a_box_is_followed_where_it_goes():
    boxed = Boxed(symbols=2)
    boxed.follow(np.array([[[1.0, 0.0, 3.0], [0.0, 1.0, 0.0]]]), None)
    assert boxed.share == 0.0
    # Dropped are (0, 2), which loses nothing along its axis, and (1, 2), of which 1 along the first axis is excess.
    boxed.follow(np.array([[[1.0, 0.0, 1.0, 1.0], [0.0, 2.0, 2.0, 1.0]]]), np.array([[True, False, False, True]]))
    assert boxed.share == pytest.approx(1 / 3)
    # Now the box is the last two, all of the first and nothing of the second is excess; the loop turned them.
    boxed.follow(np.array([[[1.0, 1.0, 0.0, 4.0], [0.0, 1.0, 6.0, 0.0]]]), None)
    assert boxed.share == pytest.approx(6 / 7)
    assert boxed.notes() == (
        "symbols=2: up to 85.7 % of the tube's width are there because generators were boxed; "
        "with more symbols it may be up to 7 times narrower",
    )
    assert Boxed(symbols=None).notes() == ()


@pytest.mark.parametrize("propagator", [Affine(symbols=5), Crown(symbols=5), Best(symbols=5)])
def test_arrays_and_tensors_and_what_builds_on_them_say_the_same(propagator, monkeypatch):
    monkeypatch.setattr(boxed_module, "SHARE", 1e-3)
    loop = unicycle_loop(line(0.3))
    notes = propagator.reach(loop, START, DISTURBANCE).notes
    assert len(notes) == 1 and notes[0].startswith("symbols=5: up to ")
    if isinstance(propagator, Affine):
        wanted = Box(START.lower.clone().requires_grad_(True), START.upper)
        assert propagator.run(loop, wanted, DISTURBANCE).notes == notes


def test_notes_of_cells_survive_being_sent_and_joined():
    tube = Affine().propagate(unicycle_loop(line(0.3)), Box(START.lower[None], START.upper[None]), DISTURBANCE)
    u = torch.zeros(1, tube.horizon, 2, dtype=torch.float64)
    cells = Box(START.lower[None], START.upper[None])

    def found(*notes):
        owner, seconds = torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.float64)
        return CellTubes(owner, cells, tube, u, u, seconds, None, notes)

    joined = CellTubes.join([CellTubes.of(found("one").arrays()), found("two", "one"), CellTubes.of(found().arrays())])
    assert joined.notes == ("one", "two") and joined.select(torch.tensor([2])).notes == joined.notes


def test_of_a_large_batch_some_cells_are_followed_with_their_own_masks():
    generator = np.random.default_rng(0)
    one, kept = generator.normal(size=(1, 2, 6)), np.array([[True, False, True, True, False, True]])
    alone, many = Boxed(4), Boxed(4)
    for boxed, times in ((alone, 1), (many, 40)):
        for _ in range(2):
            boxed.follow(one.repeat(times, 0), kept.repeat(times, 0))
    assert many.share == pytest.approx(alone.share, rel=1e-12) and alone.share > 0.1
