import numpy as np
import pytest

from sagemp_cli.errors import ArtifactError, ResourceError
from sagemp_cli.pipeline.partial import PartialResults
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.storage import Demonstrations, PlannerModel, TrackerModel, read_artifact

from .conftest import Interrupt, assert_same


def test_gen_data_goes_on_where_it_was_interrupted(work, toy_folder):
    stage = stage_named("gen-data")
    with pytest.raises(KeyboardInterrupt):
        stage.run(work(progress=Interrupt(after=5)))
    context = work(progress=Interrupt())
    assert not context.output_path("gen-data").exists()
    with context.resources:
        kept = PartialResults.of(context, "gen-data", without=("expert.count",)).finished
    assert kept == {0, 1, 2, 3, 4}
    again = read_artifact(stage.run(context), Demonstrations).record
    assert context.progress.resumed == {"demonstrations": 5}
    assert context.progress.advanced == 7
    assert_same(again, read_artifact(toy_folder / "demonstrations.h5", Demonstrations).record)
    assert not context.partial_folder("gen-data").exists()


def test_more_demonstrations_keep_the_finished_ones_and_another_expert_does_not(work):
    stage = stage_named("gen-data")
    with pytest.raises(KeyboardInterrupt):
        stage.run(work(progress=Interrupt(after=3)))
    with pytest.raises(KeyboardInterrupt):
        stage.run(work(progress=(more := Interrupt(after=1)), overrides=("expert.count=40",)))
    assert more.resumed == {"demonstrations": 3}
    with pytest.raises(KeyboardInterrupt):
        stage.run(work(progress=(other := Interrupt(after=1)), overrides=("expert.margin=0.31",)))
    assert other.resumed == {"demonstrations": 0}
    with pytest.raises(KeyboardInterrupt):
        stage.run(work(progress=(back := Interrupt(after=1))))
    assert back.resumed == {"demonstrations": 0}


SHORT = ("tracker_training.steps=25", "tracker_training.tube_steps=2")


@pytest.mark.parametrize(
    ("name", "record", "needs", "overrides"),
    [
        ("train-planner", PlannerModel, ("gen-data",), ("planner_training.steps=120",)),
        (
            "train-tracker",
            TrackerModel,
            ("gen-data", "train-planner"),
            SHORT,
        ),
    ],
)
def test_training_goes_on_where_it_was_interrupted_and_ends_in_the_same_bits(work, name, record, needs, overrides):
    stage = stage_named(name)
    whole = read_artifact(stage.run(work(*needs, overrides=overrides)), record).record
    interrupted = work(*needs, overrides=overrides, overwrite=True, progress=Interrupt(after=5))
    with pytest.raises(KeyboardInterrupt):
        stage.run(interrupted)
    assert len(list(interrupted.partial_folder(name).rglob("*.h5"))) == 1
    context = work(*needs, overrides=overrides, overwrite=True, progress=Interrupt())
    resumed = read_artifact(stage.run(context), record).record
    assert max(context.progress.resumed.values()) >= 5
    assert_same(resumed, whole)
    assert not context.partial_folder(name).exists()


def test_a_damaged_piece_is_deleted_and_made_again(work):
    context = work()
    partial = PartialResults.of(context, "gen-data")
    partial.save(3, {"a": np.arange(4)})
    np.testing.assert_array_equal(partial.load(3)["a"], np.arange(4))
    (partial.folder / "000003.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(ResourceError, match="000003.npz: damaged piece, deleted; run the stage again"):
        partial.load(3)
    assert partial.finished == set()


def test_pieces_never_hold_pickles(work):
    partial = PartialResults.of(work(), "gen-data")
    np.savez(partial.folder / "000001.npz", a=np.array([{"any": "object"}], dtype=object))
    with pytest.raises(ResourceError, match="damaged piece"):
        partial.load(1)


def test_a_changed_parent_is_refused(work):
    context = work("gen-data", "train-planner")
    demonstrations = context.output_path("gen-data")
    demonstrations.write_bytes(demonstrations.read_bytes() + b"\0")
    with pytest.raises(ArtifactError, match="was made from an earlier .*demonstrations.h5, which has changed since"):
        stage_named("train-tracker").run(context)


def test_two_runs_at_once_of_the_same_work_both_end_well(work):
    stage, inner = stage_named("gen-data"), []

    class Meanwhile(Interrupt):
        def advance(self, steps=1, note=""):
            super().advance(steps, note)
            if self.advanced == 3:
                inner.append(stage.run(work(overwrite=True)))

    outer = stage.run(work(overwrite=True, progress=Meanwhile()))
    assert [outer] == inner
    assert read_artifact(outer, Demonstrations).unchanged
    assert not work().partial_folder("gen-data").exists()


@pytest.mark.slow
@pytest.mark.parametrize("inner_ends", [True, False])
def test_two_trainings_at_once_share_their_checkpoint_and_both_end_well(work, inner_ends):
    """One ends, or is interrupted, while the other trains: what it leaves, or takes away, is of no harm to that."""
    stage, needs, seen = stage_named("train-tracker"), ("gen-data", "train-planner"), []

    def started(progress):
        return stage.run(work(*needs, overrides=SHORT, overwrite=True, progress=progress))

    class Meanwhile(Interrupt):
        def advance(self, steps=1, note=""):
            super().advance(steps, note)
            if not seen and self.advanced >= 5:
                seen.append("inner")
                if inner_ends:
                    seen.append(read_artifact(started(Interrupt()), TrackerModel).record)
                else:
                    with pytest.raises(KeyboardInterrupt):
                        started(Interrupt(after=7))
                    assert list(work(*needs).partial_folder("train-tracker").rglob("*.h5"))

    path = started(Meanwhile())
    assert path.with_suffix(".png").exists() and not work().partial_folder("train-tracker").exists()
    if inner_ends:
        assert_same(read_artifact(path, TrackerModel).record, seen[1])


def test_a_run_of_another_config_leaves_the_pieces_of_one_that_is_running(work):
    stage = stage_named("gen-data")

    class Meanwhile(Interrupt):
        def advance(self, steps=1, note=""):
            super().advance(steps, note)
            if self.advanced == 3:
                with pytest.raises(KeyboardInterrupt):
                    stage.run(work(progress=Interrupt(after=1), overrides=("expert.margin=0.31",)))
                assert len(list(context.partial_folder("gen-data").iterdir())) == 2

    context = work(progress=Meanwhile())
    stage.run(context)
    assert not list(context.partial_folder("gen-data").rglob("000003.npz"))


def test_a_figure_that_is_missing_is_drawn_and_one_of_an_earlier_file_is_not_kept(work, monkeypatch):
    stage, context = stage_named("gen-data"), work(overwrite=True)
    figure = stage.run(context).with_suffix(".png")
    assert figure.exists()
    monkeypatch.setattr(type(stage), "draw", lambda *_: None)  # interrupted before it is drawn
    stage.run(work(overwrite=True))
    assert not figure.exists()
    monkeypatch.undo()
    assert stage.draw(context) == figure
    assert figure.exists()
