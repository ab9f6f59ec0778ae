"""The vision-language planner: the scene as a picture, a prompt, and the answer's waypoints as a reference."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from sagemp_cli.config.ranges import Count, Decay, NonNegative, Positive
from sagemp_cli.errors import ConfigError, UsageError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.learning.fit import History, fit
from sagemp_cli.learning.schedule import Schedule
from sagemp_cli.planners.base import starts_of
from sagemp_cli.planners.vlm.answer import MOST_WAYPOINTS, AnswerError, waypoints_of
from sagemp_cli.planners.vlm.lessons import Lessons, answer_figures
from sagemp_cli.planners.vlm.local import Local
from sagemp_cli.planners.vlm.network import ReaderOptions, SceneReader
from sagemp_cli.planners.vlm.practice import practice_of, random_exercise
from sagemp_cli.planners.vlm.prompts import axes_of, fill, template
from sagemp_cli.planners.vlm.question import Question
from sagemp_cli.planners.vlm.recording import Replay
from sagemp_cli.planners.vlm.service import ENDPOINTS, Service, ServiceOptions
from sagemp_cli.planners.vlm.waypoints import Drive, reference_of
from sagemp_cli.progress import Progress
from sagemp_cli.scenes.frame import Frame
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.sets import Box

PROVIDERS = ("local", *ENDPOINTS, "replay")
SERVICE_PLANS = 4
"""Plans that are asked of a service for model cards and figures, where others give hundreds."""
_SHOWN = 32
"""Starts from which the stand-in is tried in the experiment's own scene."""


@dataclass(frozen=True, kw_only=True)
class PracticeOptions(Schedule):
    """How the stand-in learns.

    Attributes:
        exercises: random scenes to learn from.
        held_out: random scenes for the figures.
        batch: scenes per update.
        margin: distance to obstacles that is learned, as a share of half the picture.
    """

    learning_rate: Positive = 3e-3
    ema_decay: Decay | None = 0.99
    exercises: Count = 2000
    held_out: Count = 100
    batch: Count = 32
    margin: Decay = 0.08

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.exercises, self.held_out, self.batch) < 1 or not 0 <= self.margin < 1:
            raise ConfigError(
                "planner_training: exercises, held_out and batch must be positive and margin in [0, 1), "
                f"found {self.exercises}, {self.held_out}, {self.batch} and {self.margin}"
            )


class Provider(Protocol):
    """What answers questions."""

    @property
    def label(self) -> str:
        """What it is, for figures."""
        ...

    def answers(self, questions: Sequence[Question], *, generator: torch.Generator) -> list[str]:
        """One text per question; untrusted."""
        ...


class VLM(nn.Module):
    """A vision-language model as planner (paper, section V; prompts of its appendix).

    The scene is rendered, the prompt gets start and goal in image coordinates, and the waypoints of the answer become a
    reference: straight lines with rounded corners, heading filled in (and speed, for the four-state unicycle). The
    answer is untrusted; one that gives no usable waypoints is asked for again, up to ``attempts`` times.

    Providers: ``gemini`` and ``openai`` ask a service (key from the environment), ``replay`` draws from recorded
    answers, and ``local`` is a **stand-in**: a small network that :meth:`learn` trains on rendered random scenes,
    followed by a search on what it sees. What it plans says nothing of what a vision-language model would;
    :attr:`label` is there to say so wherever its plans are shown.

    Args:
        state_dim: 3 for ``[px, py, theta]``, 4 for ``[px, py, theta, v]``.
        horizon: number of steps K.
        dt: seconds a step.
        provider: one of :data:`PROVIDERS`.
        prompt: a name in ``data/prompts``, or the path of a text file.
        attempts: how often a question is asked until an answer is usable.
        most_waypoints: an answer with more is not usable.
        drive: how waypoints are driven.
        service: how a service is called.
        network: size of the stand-in's network.
        diversity: of the stand-in's answers: 0 always the cheapest way, about 1 other sides as well.
        recording: file of recorded answers, or a folder of them, such as a service's cache.
    """

    options_type: ClassVar = PracticeOptions
    learns_from: str = "scenes"
    """What training needs; of an instance with another provider than ``local`` it is "nothing"."""

    def __init__(
        self,
        *,
        state_dim: int,
        horizon: int,
        dt: float,
        provider: str = "local",
        prompt: str = "over_burger",
        attempts: Count = 3,
        most_waypoints: Count = MOST_WAYPOINTS,
        drive: Drive | None = None,
        service: ServiceOptions | None = None,
        network: ReaderOptions | None = None,
        diversity: NonNegative = 0.3,
        recording: str | None = None,
    ) -> None:
        super().__init__()
        if state_dim not in (3, 4):
            raise ConfigError(
                "planner: the VLM planner fills in heading and speed of a unicycle with 3 or 4 states, "
                f"found a robot with {state_dim}"
            )
        if provider not in PROVIDERS:
            raise ConfigError(f"planner.provider must be one of {', '.join(PROVIDERS)}, found '{provider}'")
        if (recording is None) == (provider == "replay"):
            raise ConfigError(f"planner.recording is for provider 'replay' and only for it, found {recording!r}")
        template(prompt)  # complain about a missing one now
        self.state_dim, self.horizon, self.dt = int(state_dim), int(horizon), float(dt)
        self.provider_name, self.prompt, self.recording = provider, prompt, recording
        self.attempts, self.most_waypoints, self.diversity = int(attempts), int(most_waypoints), float(diversity)
        self.drive, self.service, self.network = (
            drive or Drive(),
            service or ServiceOptions(),
            network or ReaderOptions(),
        )
        self.learns_from = "scenes" if provider == "local" else "nothing"
        if provider in ENDPOINTS:
            self.affordable_plans = SERVICE_PLANS
        self.reader = SceneReader(**asdict(self.network)) if provider == "local" else None

    @property
    def arguments(self) -> dict[str, Any]:
        """Plain keyword arguments that rebuild this planner; its weights are in ``state_dict()``."""
        return {
            "state_dim": self.state_dim,
            "horizon": self.horizon,
            "dt": self.dt,
            "provider": self.provider_name,
            "prompt": self.prompt,
            "attempts": self.attempts,
            "most_waypoints": self.most_waypoints,
            "drive": asdict(self.drive),
            "service": asdict(self.service),
            "network": asdict(self.network),
            "diversity": self.diversity,
            "recording": self.recording,
        }

    @property
    def provider(self) -> Provider:
        """What answers."""
        if self.provider_name == "local":
            assert self.reader is not None
            return Local(self.reader, self.diversity)
        if self.provider_name == "replay":
            assert self.recording is not None
            return Replay(Path(self.recording))
        return Service(ENDPOINTS[self.provider_name], self.service)

    @staticmethod
    def stand_in(section: Mapping[str, Any]) -> str:
        """What takes the model's place with these options of the config, in a few words; empty if nothing does."""
        return Local.label if section.get("provider", "local") == "local" else ""

    @property
    def label(self) -> str:
        """What answered, to be shown in every figure that is made from its plans."""
        return f"VLM planner, {self.provider.label}"

    @torch.no_grad()
    def sample(self, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator) -> Tensor:
        """References ``(count, K+1, n)`` that end in the goal's middle, see :class:`~sagemp_cli.planners.base.Planner`.

        Raises:
            AnswerError: no usable waypoints after ``attempts`` answers.
            ServiceError: the service cannot be used.
        """
        provider = self.provider
        if isinstance(provider, Service):
            provider = provider.within(count)
        return self._references(provider, start, goal, scene=scene, count=count, generator=generator)

    def _references(
        self, provider: Provider, start: Tensor, goal: Box, *, scene: Scene, count: int, generator: torch.Generator
    ) -> Tensor:
        starts = starts_of(start, count=count, state_dim=self.state_dim).numpy()
        frame, target = Frame.of(scene.workspace, *axes_of(self.prompt)), _middle_of(goal)
        questions = [self._question(place, target, scene, frame) for place in starts[:, :2]]
        waypoints: dict[int, np.ndarray] = {}
        for attempt in range(self.attempts):
            open_ones = [i for i in range(count) if i not in waypoints]
            answers = provider.answers([questions[i] for i in open_ones], generator=generator)
            for i, answer in zip(open_ones, answers, strict=True):
                try:
                    waypoints[i] = waypoints_of(answer, frame, most=self.most_waypoints)
                except AnswerError as e:
                    if attempt == self.attempts - 1:
                        raise AnswerError(f"no usable answer in {self.attempts} attempts: {e}") from None
            if len(waypoints) == count:
                break
        references = [
            reference_of(
                np.concatenate([frame.to_workspace(waypoints[i]), target[None]]),
                starts[i],
                horizon=self.horizon,
                dt=self.dt,
                drive=self.drive,
            )
            for i in range(count)
        ]
        return torch.from_numpy(np.stack(references))

    def _question(self, place: np.ndarray, target: np.ndarray, scene: Scene, frame: Frame) -> Question:
        numbers = {"start": frame.to_image(place).tolist(), "goal": frame.to_image(target).tolist()}
        text = template(self.prompt)
        digest = hashlib.sha256(text.encode()).hexdigest()
        return Question(fill(text, **numbers), digest, scene, frame, place, target)

    def learn(
        self,
        options: PracticeOptions,
        *,
        scene: Scene,
        generator: torch.Generator,
        resumable: Resumable | None = None,
        progress: Progress | None = None,
    ) -> History:
        """Train the stand-in on random scenes; see :func:`~sagemp_cli.planners.vlm.practice.random_exercise`.

        The validation figures are those of :func:`~sagemp_cli.planners.vlm.lessons.answer_figures` on held-out random
        scenes, and on the given scene under this planner's own prompt, from starts drawn where those of practice are:
        on its left.

        Args:
            options: what is learned from, and how long.
            scene: the scene to report on; nothing is learned from it.
            generator: source of all randomness.
            resumable, progress: see :func:`sagemp_cli.learning.fit.fit`.

        Raises:
            UsageError: the provider is not ``local``: there is nothing to train.
        """
        if self.reader is None:
            raise UsageError(f"planner.provider '{self.provider_name}' has nothing to train; only 'local' learns")
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=generator)))
        kept_back = [random_exercise(rng) for _ in range(options.held_out)]
        practice = practice_of(
            [random_exercise(rng) for _ in range(options.exercises)], pixels=self.reader.pixels, margin=options.margin
        )
        seed = int(torch.randint(2**62, (), generator=generator))
        self.reader.reset(generator)

        def validate(reader: nn.Module) -> Mapping[str, float]:
            assert isinstance(reader, SceneReader)
            random = answer_figures(reader, kept_back, seed=seed)
            here = self._figures_in(scene, reader, seed)
            found = {f"{name} (stand-in, random scenes)": value for name, value in random.items()}
            return found | {f"{name} (stand-in, this scene)": value for name, value in here.items()}

        return fit(
            self.reader,
            Lessons(practice, options.batch),
            options,
            generator=generator,
            validate=validate,
            validate_every=math.ceil(options.steps / 5),
            resumable=resumable,
            progress=progress,
            description="training the stand-in for a VLM",
        )

    def _figures_in(self, scene: Scene, reader: SceneReader, seed: int) -> dict[str, float]:
        """Shares of references in a scene that keep clear, and that pass over the landmark that the prompt names."""
        frame, generator = Frame.of(scene.workspace), torch.Generator().manual_seed(seed % 2**31)
        unit = torch.rand(16 * _SHOWN, 2, generator=generator, dtype=torch.float64).numpy()
        places = torch.from_numpy(frame.to_workspace(np.array([-0.95, -0.7]) + unit * np.array([0.35, 1.4])))
        places = places[scene.signed_distance(places) > 0.1 * frame.scale][:_SHOWN]
        if len(places) == 0:
            return {}
        starts = torch.zeros(len(places), self.state_dim, dtype=torch.float64)
        starts[:, :2] = places
        provider = Local(reader, self.diversity)
        paths = self._references(provider, starts, scene.goal, scene=scene, count=len(starts), generator=generator)[
            ..., :2
        ]
        figures = {"collision-free": float((scene.signed_distance(paths) > 0).all(-1).double().mean())}
        words = template(self.prompt).lower()
        for landmark in scene.landmarks:
            if landmark.object in words:
                apart = torch.linalg.vector_norm(paths - torch.tensor(landmark.center), dim=-1)
                figures[f"passes over {landmark.name}"] = float((apart.amin(-1) < landmark.radius).double().mean())
        return figures


def _middle_of(goal: Box) -> np.ndarray:
    """The middle of the goal's place, metres.

    Raises:
        ConfigError: the goal has no bounded place.
    """
    low, high = goal.lower[:2], goal.upper[:2]
    if not bool((torch.isfinite(low) & torch.isfinite(high)).all()):
        raise ConfigError("scene.goal: a VLM is told a goal point, so the goal must be bounded in the position")
    return (0.5 * low + 0.5 * high).numpy()
