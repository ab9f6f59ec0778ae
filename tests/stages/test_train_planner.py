"""``train-planner`` for planners that learn from demonstrations, from scenes, or not at all."""

import dataclasses

import numpy as np
import pytest
import torch

from sagemp_cli.config.composition import compose
from sagemp_cli.errors import ArtifactError, ConfigError
from sagemp_cli.learning.fit import History
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.freshness import Freshness, survey
from sagemp_cli.pipeline.models import planner_from
from sagemp_cli.pipeline.problem import problem_of
from sagemp_cli.pipeline.requirements import require_sound_config
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.planners import NeuralODE
from sagemp_cli.storage import PlannerModel, read_artifact, sha256_of

from .conftest import Interrupt


class Listener(Interrupt):
    """Progress that remembers what was said."""

    def __init__(self):
        super().__init__()
        self.said = []

    def say(self, text):
        self.said.append(text)


def context_of(folder, planner, *, drop=("hidden",), training=None, **options):
    """The toy experiment with another planner; ``options`` are those of its class."""
    config = compose(["effort=toy", f"planner={planner}", f"artifacts={folder}"])
    section = {k: v for k, v in config["planner"].items() if k not in drop}
    config = {**config, "planner": section | options}
    if training is not None:
        config["planner_training"] = training
    return StageContext.of(config, progress=Listener())


def planner_file(context):
    stage = stage_named("train-planner")
    path = stage.run(context)
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert not context.partial_folder("train-planner").exists()
    return read_artifact(path, PlannerModel)


def card_of(artifact):
    return dict(zip(artifact.record.figure_names, artifact.record.figures.tolist(), strict=True))


@pytest.mark.parametrize(
    ("planner", "steps"), [("flow_matching", {"integration_steps": 2}), ("diffusion", {"denoising_steps": 4})]
)
def test_a_generative_planner_is_trained_with_a_whole_model_card(work, planner, steps, tmp_path):
    work("gen-data")
    training = {"steps": 20, "learning_rate": 1e-3, "held_out": 0.2, "loss": {"batch_size": 8}}
    context = context_of(tmp_path, planner, training=training, width=8, knots=8, **steps)
    artifact = planner_file(context)
    card, made = card_of(artifact), planner_from(artifact)
    wanted = {"parameters", "demonstrations", "loss", "held-out loss", "collision-free", "in goal", "roughness"}
    assert wanted | {"start error", "goal error", "median position error"} <= set(card)
    shares = [value for name, value in card.items() if name.startswith("demonstrated share ")]
    assert shares and sum(shares) == pytest.approx(1)
    assert all(name.replace("demonstrated ", "") in card for name in card if name.startswith("demonstrated share "))
    assert card["parameters"] == sum(p.numel() for p in made.parameters())
    start = torch.tensor(context.config["start"]["center"], dtype=torch.float64)
    scene = problem_of(context.config).scene
    plans = made.sample(start, scene.goal, scene=scene, count=3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(plans[:, 0], start.expand(3, 4))


@pytest.fixture
def plans(tmp_path):
    """A CSV with the positions of two ways through the toy scene, half as long as the horizon."""
    path = tmp_path / "plans.csv"
    config = compose(["effort=toy"])
    start, goal = np.array(config["start"]["center"][:2]), np.array(config["scene"]["goal"]["lower"][:2])
    rows = ["trajectory,t,px,py"]
    for label, side in (("left", 0.6), ("right", -0.6)):
        for s in np.linspace(0, 1, 6):
            x, y = start + s * (goal - start) + np.array([0, side * np.sin(np.pi * s)])
            rows.append(f"{label},{s * 1.0},{x},{y}")
    path.write_text("\n".join(rows))
    return path


def test_a_file_of_trajectories_is_a_planner_that_needs_no_demonstrations(tmp_path, plans):
    context = context_of(tmp_path, "from_file", path=str(plans))
    artifact = planner_file(context)
    (parent,) = artifact.header.parents
    assert (parent.role, parent.sha256) == ("trajectories", sha256_of(plans))
    assert len(artifact.record.curve.step) == 0
    card = card_of(artifact)
    assert set(card) >= {"parameters", "collision-free", "in goal", "goal error", "start error"}
    assert "planner: theta: direction of the position's differences" in context.progress.said
    assert any("trajectory left ends after 1 s and keeps its last row" in text for text in context.progress.said)
    assert "direction of the position's differences" in artifact.record.arguments
    assert survey(context)["train-planner"].freshness is Freshness.FRESH
    kept = plans.read_text()
    plans.unlink()
    assert planner_from(artifact).trajectories.shape == (2, 26, 4)
    plans.write_text(kept.replace("0.0,", "0.1,", 1))
    state = survey(context)["train-planner"]
    assert state.freshness is Freshness.STALE and state.why == "plans.csv has changed since"


def test_a_file_that_is_missing_is_one_line(tmp_path):
    with pytest.raises(ArtifactError, match="plans.csv: no such file"):
        stage_named("train-planner").run(context_of(tmp_path, "from_file", path=str(tmp_path / "plans.csv")))
    with pytest.raises(ConfigError, match="planner.path must name a file of trajectories"):
        stage_named("train-planner").run(context_of(tmp_path, "from_file"))


@dataclasses.dataclass(frozen=True)
class RoundOptions:
    """What the planner below takes from ``planner_training``."""

    rounds: int = 2


@pytest.fixture
def self_taught(monkeypatch):
    """The neural ODE as if it taught itself."""
    calls = []

    def learn(self, options, *, scene, generator, resumable, progress):
        calls.append((options.rounds, resumable.path.name, len(resumable.identity)))
        self.field.reset(generator)
        empty = np.zeros(0, dtype=np.int64)
        return History(loss=np.linspace(1, 0.5, options.rounds), figures={}, validated_at=empty, validation={})

    monkeypatch.setattr(NeuralODE, "learns_from", "scenes")
    monkeypatch.setattr(NeuralODE, "learn", learn, raising=False)
    monkeypatch.setattr(NeuralODE, "options_type", RoundOptions, raising=False)
    return calls


def test_a_planner_that_teaches_itself_needs_no_demonstrations(tmp_path, self_taught):
    context = context_of(tmp_path, "neural_ode", drop=(), training={"rounds": 4})
    require_sound_config(context.config)
    artifact = planner_file(context)
    assert self_taught == [(4, "checkpoint.h5", 16)] and artifact.header.parents == ()
    assert len(artifact.record.curve.step) == 4 and card_of(artifact)["loss"] == 0.5
    assert {"parameters", "collision-free", "start error"} <= set(card_of(artifact))


def test_a_planner_whose_plans_are_dear_is_asked_for_as_few_as_it_says(tmp_path, self_taught, monkeypatch):
    asked, sample = [], NeuralODE.sample

    def counting(self, *arguments, count, **options):
        asked.append(count)
        return sample(self, *arguments, count=count, **options)

    monkeypatch.setattr(NeuralODE, "sample", counting)
    monkeypatch.setattr(NeuralODE, "affordable_plans", 3, raising=False)
    planner_file(context_of(tmp_path, "neural_ode", drop=(), training={"rounds": 4}))
    assert asked == [3, 3]  # the model card's and the figure's


def test_options_of_a_planner_that_teaches_itself_are_those_of_its_own(tmp_path, self_taught):
    context = context_of(tmp_path, "neural_ode", drop=(), training={"round": 4})
    with pytest.raises(ConfigError, match=r"round: no such option \(did you mean 'rounds'\?"):
        require_sound_config(context.config)
    with pytest.raises(ConfigError, match="planner_training.round: no such option"):
        stage_named("train-planner").run(context)


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("+planner_training.loss.batch=3", "planner_training.loss.batch: FlowMatchingLoss has no such option"),
        ("+planner.integrator=rk4", "planner.integrator: FlowMatching has no such option"),
        ("planner.knots=few", "planner.knots must be a whole number of at least 1, found 'few'"),
    ],
)
def test_wrong_options_are_found_before_anything_is_trained(override, text):
    with pytest.raises(ConfigError) as caught:
        require_sound_config(compose(["planner=flow_matching", override]))
    assert text in str(caught.value) and "\n" not in str(caught.value)
