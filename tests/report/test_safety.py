"""The figure of safety rates says what the table says."""

import dataclasses

import numpy as np
import pytest

from sagemp_cli.report.figure import save_figure
from sagemp_cli.report.safety import draw_safety
from sagemp_cli.report.safety_table import percentage, safety_rows
from sagemp_cli.storage import SafetyRates, read_artifact


@pytest.fixture
def artifact(toy_folder):
    return read_artifact(toy_folder / "safety.h5", SafetyRates)


def test_title_and_panels_state_the_counts_and_the_papers_where_there_are_some(artifact):
    rows = safety_rows(artifact)
    figure = draw_safety(artifact)
    assert figure.texts[0].get_text() == (
        f"Safe from all of X$_I$: {rows[0].safe} of 6 plans open loop, {rows[1].safe} tracked, {rows[2].safe} proved"
    )
    for axes, row in zip(figure.axes, rows, strict=True):
        assert axes.get_title(loc="left") == f"{row.way.capitalize()}: {percentage(row.safe / 6)}"
    said = [t.get_text() for axes in figure.axes for t in axes.texts]
    assert not any("paper" in text for text in said)
    header = dataclasses.replace(artifact.header, experiment="planar_cfm")
    toy = draw_safety(dataclasses.replace(artifact, header=header))
    assert not any("paper" in t.get_text() for axes in toy.axes for t in axes.texts)  # its scene is not the paper's
    header = dataclasses.replace(header, config={**header.config, "effort": {"name": "full", "suffix": ""}})
    said = [t.get_text() for axes in draw_safety(dataclasses.replace(artifact, header=header)).axes for t in axes.texts]
    for share in ("68.5", "81.5", "100"):
        assert any(f"paper: {share} % of 108" in text for text in said)


def test_rollouts_and_tubes_that_overflow_are_drawn_as_far_as_they_go(artifact, tmp_path):
    record = artifact.record
    nearest, clearance = record.open_loop.nearest.copy(), record.open_loop.clearance.copy()
    nearest[0, 1, 10:], clearance[0, 1] = np.nan, -np.inf
    upper = record.tube_upper.copy()
    upper[:, 20:] = np.inf
    odd = dataclasses.replace(
        record,
        open_loop=dataclasses.replace(record.open_loop, nearest=nearest, clearance=clearance),
        tube_upper=upper,
        verdict=("SAFE",) + ("UNBOUNDED",) * 5,
    )
    figure = draw_safety(dataclasses.replace(artifact, record=odd))
    assert save_figure(figure, tmp_path / "odd.png").read_bytes().startswith(b"\x89PNG")
    assert figure.texts[0].get_text().endswith("1 proved")


@pytest.mark.parametrize(
    ("share", "text"),
    [(1.0, "100 %"), (0.9999, "99.9 %"), (0.785, "78.5 %"), (0.0001, "0.1 %"), (0.0, "0 %"), (None, "-")],
)
def test_only_all_is_called_100_percent_and_only_none_is_called_0(share, text):
    assert percentage(share) == text
