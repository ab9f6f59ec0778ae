import dataclasses
import math
import shutil

import numpy as np
import pytest

from sagemp_cli.errors import ResourceError
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.report.canvas import blank_figure, shown_steps, unit_text
from sagemp_cli.report.certificate import draw_certificate
from sagemp_cli.report.figure import save_figure
from sagemp_cli.report.library import draw_library
from sagemp_cli.report.reproduce import FIGURES, draw_experiment, main
from sagemp_cli.report.rollouts import NAMED, draw_rollouts
from sagemp_cli.report.safety import draw_safety
from sagemp_cli.storage import KINDS, Certificate, Counterexample, Library, Rollouts, SafetyRates, read_artifact

TUBE = ("tube_lower", "tube_upper")


def texts(figure):
    """Every text that the figure itself carries: headline and subtitle."""
    return [t.get_text() for t in figure.texts]


def labels(figure):
    """What all legends of a figure say."""
    return [t.get_text() for axes in figure.axes if axes.get_legend() for t in axes.get_legend().get_texts()]


@pytest.fixture
def certificate(toy_folder):
    return read_artifact(toy_folder / "certificate.h5", Certificate)


def test_every_kind_of_artifact_has_a_figure():
    assert {sources[0][1] for _, sources in FIGURES} == {kind.record for kind in KINDS}


def test_all_figures_of_an_experiment_are_made_from_its_artifacts_alone(toy_root, toy_folder, tmp_path, capsys):
    root = tmp_path / "artifacts"
    shutil.copytree(toy_folder, root / "toy", ignore=shutil.ignore_patterns("*.png", "planner.h5"))
    before = {p.name: p.read_bytes() for p in (root / "toy").iterdir()}
    assert main([str(root)]) == 0
    names = ["demonstrations", "tracker", "certificate", "library", "rollouts", "safety"]  # no planner was run
    paths = [root / "figures" / f"toy_{name}.png" for name in names]
    assert capsys.readouterr().out.split() == [str(p) for p in paths]
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in paths)
    assert {p.name: p.read_bytes() for p in (root / "toy").iterdir()} == before


def test_no_artifacts_is_one_line_and_a_usage_error(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert (
        capsys.readouterr().err == f"error: {tmp_path}: holds no experiment's artifacts; make some with 'sagemp run'\n"
    )


def test_an_empty_folder_gives_no_figure(tmp_path):
    assert draw_experiment(tmp_path, tmp_path) == []


def test_a_damaged_artifact_is_an_error_not_a_figure(tmp_path, capsys):
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "certificate.h5").write_bytes(b"no HDF5")
    assert main([str(tmp_path)]) == 2
    assert "certificate.h5: not a readable HDF5 file" in capsys.readouterr().err


def test_the_title_states_verdict_cells_horizon_and_time(certificate):
    title, subtitle = texts(draw_certificate(certificate))
    assert title.startswith("Certified")
    for part in (
        "SAFE over the whole of every step, passes disc at",
        "4 cells",
        "K = 25 (2.5 s)",
        "affine in",
        "rounding included",
    ):
        assert part in subtitle


def changed(certificate, **tubes):
    record = certificate.record
    return dataclasses.replace(
        certificate, record=dataclasses.replace(record, tubes=dataclasses.replace(record.tubes, **tubes))
    )


def test_every_figure_of_a_claim_says_that_it_holds_at_the_samples(toy_folder, certificate):
    library = read_artifact(toy_folder / "library.h5", Library)
    shown = [
        draw_certificate(certificate),
        draw_library(library),
        draw_rollouts(read_artifact(toy_folder / "rollouts.h5", Rollouts), library),
        draw_safety(read_artifact(toy_folder / "safety.h5", SafetyRates)),
    ]
    for verdict in ("FALSIFIED", "UNKNOWN"):
        record = dataclasses.replace(certificate.record, verdict=verdict)
        shown.append(draw_certificate(dataclasses.replace(certificate, record=record)))
    for figure in shown:
        assert "over the whole of every step" in " ".join(" ".join(texts(figure)).split())


def test_a_tube_that_overflows_is_drawn_up_to_there(certificate, tmp_path):
    tubes = certificate.record.tubes
    lower, upper = tubes.tube_lower.copy(), tubes.tube_upper.copy()
    lower[:, 10:], upper[:, 10:] = -1e200, 1e200
    lower[:, 12:], upper[:, 12:] = -math.inf, math.inf
    lower[0, 20:] = upper[0, 20:] = math.nan
    odd = changed(
        certificate,
        tube_lower=lower,
        tube_upper=upper,
        verdict=("UNBOUNDED",),
        step=np.array([12]),
        constraint=("px",),
        clearance=np.full_like(tubes.clearance, -math.inf),
    )
    assert shown_steps(problem_of(certificate.header.config), lower, upper) == 10
    odd = dataclasses.replace(odd, record=dataclasses.replace(odd.record, verdict="UNKNOWN"))
    figure = draw_certificate(odd)
    save_figure(figure, tmp_path / "odd.png")
    title, subtitle = texts(figure)
    assert title.startswith("Unknown")
    assert "UNBOUNDED at step 12, 1.2 s (px)" in subtitle


def test_a_counterexample_is_drawn(certificate, tmp_path):
    example = Counterexample(
        reference=0,
        kind="collision",
        step=9,
        fraction=0.5,
        constraint="disc",
        depth=0.1,
        states=certificate.record.tubes.references[0],
        disturbances=np.zeros((25, 4)),
    )
    bad = changed(certificate, verdict=("UNSAFE",), step=np.array([9]), constraint=("disc",))
    bad = dataclasses.replace(
        bad, record=dataclasses.replace(bad.record, verdict="FALSIFIED", counterexamples=(example,))
    )
    figure = draw_certificate(bad)
    save_figure(figure, tmp_path / "bad.png")
    assert texts(figure)[0].startswith("Falsified")
    assert "counterexample" in labels(figure)


def test_everything_in_the_figure_of_a_certificate_is_named(certificate):
    named = labels(draw_certificate(certificate))
    assert named[:4] == ["reference", "start cells", "tube of each cell", "goal at the end"]
    assert named[4:] == ["contact", *certificate.record.tubes.constraint_names]


def test_a_figure_has_no_more_to_draw_the_more_cells_there_are(certificate):
    tubes = certificate.record.tubes
    cells = {f: np.repeat(getattr(tubes, f), 100, axis=0) for f in ("cell_reference", "cell_lower", "cell_upper")}
    many = changed(certificate, **cells, **{f: np.repeat(getattr(tubes, f), 100, axis=0) for f in TUBE})
    parts = [len(axes.get_children()) for axes in draw_certificate(certificate).axes]
    assert [len(axes.get_children()) for axes in draw_certificate(many).axes] == parts


def test_the_account_of_a_library_adds_up_to_what_was_sampled(toy_folder):
    library = read_artifact(toy_folder / "library.h5", Library)
    record = dataclasses.replace(library.record, sampled=library.record.sampled + 3)
    bars = draw_library(dataclasses.replace(library, record=record)).axes[1].patches
    assert sum(bar.get_width() for bar in bars) == record.sampled
    assert bars[-1].get_width() >= 3


@pytest.mark.parametrize("count", [NAMED, NAMED + 1])
def test_the_legend_of_rollouts_names_references_one_by_one_only_if_they_are_few(toy_folder, count):
    library = read_artifact(toy_folder / "library.h5", Library)
    rollouts = read_artifact(toy_folder / "rollouts.h5", Rollouts)
    tubes, record = library.record.tubes, rollouts.record
    one = tubes.cell_reference == 0
    cells = {"cell_reference": np.repeat(np.arange(count), one.sum())}
    cells |= {f: np.concatenate([getattr(tubes, f)[one]] * count) for f in TUBE}
    library = dataclasses.replace(
        library, record=dataclasses.replace(library.record, tubes=dataclasses.replace(tubes, **cells))
    )
    query = np.arange(len(record.query)) % count
    record = dataclasses.replace(record, chosen=np.arange(count), query=query)
    named = labels(draw_rollouts(dataclasses.replace(rollouts, record=record), library))
    each = [f"tracks {i}" for i in range(count)] if count <= NAMED else ["rollout, coloured by reference"]
    assert named == [*each, "tube", "planner's proposal"]


@pytest.mark.parametrize(
    ("unit", "per_second", "text"),
    [("m/s^2", False, "m/s²"), ("m", True, "m/s"), ("rad/s", True, "rad/s²"), ("N m", False, "N m")],
)
def test_units_are_set_as_in_print(unit, per_second, text):
    assert unit_text(unit, per_second=per_second) == text


def test_a_figure_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ResourceError, match="file/figure.png: cannot be written"):
        save_figure(blank_figure(2, 2), tmp_path / "file" / "figure.png")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
