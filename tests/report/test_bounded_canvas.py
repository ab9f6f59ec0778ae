"""Figures of numbers that nobody expects: drawn, in bounded time."""

import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from sagemp_cli.report.bounded_canvas import FAR, BoundedCanvas
from sagemp_cli.report.figure import save_figure


def blank():
    figure = Figure(figsize=(3, 2), dpi=100)
    axes = figure.add_subplot()
    axes.set(xlim=(0, 10), ylim=(0, 10))
    return figure, axes


def pixels(canvas):
    drawn = io.BytesIO()
    canvas.print_png(drawn)
    return np.array(canvas.buffer_rgba())


def path_to(far):
    far = np.where(np.arange(26) % 2, far, 1.0)
    return np.stack([far, far * 1.1], axis=-1)


DRAW = {
    "line": lambda axes, path, style: axes.plot(*path.T, linestyle=style, scalex=False, scaley=False),
    "lines": lambda axes, path, style: axes.add_collection(
        LineCollection([path, path[::-1]], linestyles=style), autolim=False
    ),
    "areas": lambda axes, path, style: axes.add_collection(PolyCollection([path], alpha=0.5), autolim=False),
    "points": lambda axes, path, style: axes.scatter(*path.T),
}


@pytest.mark.parametrize("far", [1e9, 1e100, 1e300, 1.7e308])
@pytest.mark.parametrize("style", ["-", (0, (4, 2))], ids=["solid", "dashed"])
@pytest.mark.parametrize("kind", DRAW)
def test_numbers_of_any_size_are_drawn(kind, style, far, tmp_path):
    figure, axes = blank()
    with np.errstate(all="ignore"):
        DRAW[kind](axes, path_to(far), style)
    axes.set(xlim=(0, 10), ylim=(0, 10))
    save_figure(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000


@pytest.mark.parametrize("kind", ["line", "lines", "areas", "points"])
def test_what_is_near_is_drawn_as_ever(kind):
    found = []
    for canvas in (FigureCanvasAgg, BoundedCanvas):
        figure, axes = blank()
        DRAW[kind](axes, np.random.default_rng(0).uniform(-100, 100, (50, 2)), "-")
        found.append(pixels(canvas(figure)))
    assert np.array_equal(*found)


def test_a_line_to_a_far_point_leaves_the_picture_in_its_own_direction():
    figure, axes = blank()
    axes.set_axis_off()
    axes.plot([5.0, 1e300], [5.0, 5e299], color="black", scalex=False, scaley=False)
    far = pixels(BoundedCanvas(figure))
    figure, axes = blank()
    axes.set_axis_off()
    axes.plot([5.0, 105.0], [5.0, 55.0], color="black", scalex=False, scaley=False)
    assert np.abs(far.astype(int) - pixels(FigureCanvasAgg(figure))).max() < 16
    assert 100 * max(far.shape) < FAR
