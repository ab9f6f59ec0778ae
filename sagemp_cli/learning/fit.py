"""The training loop: one for everything that learns, it takes a loss.

Planners, trackers and learned dynamics differ in their losses and in nothing else, so they share this loop:
Adam, a warm-up and a cosine, gradient clipping, an optional moving average of the weights, a validation curve,
checkpoints. A run that was interrupted and resumed ends in the same bits as one that was not.
"""

from __future__ import annotations

import copy
import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from sagemp_cli.errors import ArtifactError, ConfigError, NonFiniteError
from sagemp_cli.learning.checkpoint import Checkpoint, Resumable, read_checkpoint, write_checkpoint
from sagemp_cli.learning.schedule import Schedule
from sagemp_cli.progress import Progress, Silent

Loss = Callable[[nn.Module, int, torch.Generator], tuple[Tensor, Mapping[str, float]]]
"""``loss(module, step, generator)``: the scalar to minimise, and figures to show and record beside it.

Everything random (batches, noise) is drawn from ``generator``, whose state is part of a checkpoint; a loss that
draws from torch's global generator cannot be resumed exactly.
"""

Validation = Callable[[nn.Module], Mapping[str, float]]
"""``validate(module)``: figures of the module in evaluation mode, without gradients; always the same names."""


@dataclass(frozen=True)
class History:
    """The course of a training run.

    Attributes:
        loss: the loss before each step's update, ``(steps,)``.
        figures: what the loss reported beside it, each ``(steps,)``, NaN in steps that did not report it.
        validated_at: number of updates done at each validation, ``(v,)``; the last entry is the end of training.
        validation: the validation's figures, each ``(v,)``.
    """

    loss: np.ndarray
    figures: Mapping[str, np.ndarray]
    validated_at: np.ndarray
    validation: Mapping[str, np.ndarray]

    def then(self, later: History) -> History:
        """This run followed by another of the same module; figures that only one reported are NaN in the other."""

        def joined(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray], sizes: tuple[int, int]) -> dict:
            missing = [np.full(size, np.nan) for size in sizes]
            return {k: np.concatenate([a.get(k, missing[0]), b.get(k, missing[1])]) for k in {**a, **b}}

        return History(
            loss=np.concatenate([self.loss, later.loss]),
            figures=joined(self.figures, later.figures, (len(self.loss), len(later.loss))),
            validated_at=np.concatenate([self.validated_at, later.validated_at + len(self.loss)]),
            validation=joined(self.validation, later.validation, (len(self.validated_at), len(later.validated_at))),
        )


def fit(
    module: nn.Module,
    loss: Loss,
    schedule: Schedule,
    *,
    generator: torch.Generator,
    validate: Validation | None = None,
    validate_every: int | None = None,
    resumable: Resumable | None = None,
    progress: Progress | None = None,
    description: str = "training",
) -> History:
    """Train ``module`` in place, leave it in evaluation mode and return the course of the run.

    Args:
        module: what learns; parameters that do not require gradients stay as they are.
        loss: see :data:`Loss`.
        schedule: updates, learning rates and what is averaged; the average is what ``module`` holds in the end.
        generator: source of all randomness; its state afterwards is that of an uninterrupted run.
        validate: see :data:`Validation`; called every ``validate_every`` updates (a tenth of all if not given) and
            once at the end.
        resumable: makes the run one that can be interrupted: if its checkpoint exists when the run starts, the run
            goes on from there. The caller deletes it once the result is safe.
        progress: where the course is shown.
        description: what is being trained, for progress and errors.

    Raises:
        NonFiniteError: the loss or its gradient became NaN or infinite; ``module`` keeps the last finite weights.
        ArtifactError: the checkpoint is damaged or belongs to another run.
        KeyboardInterrupt: after the checkpoint was written.
    """
    steps, ema_decay = schedule.steps, schedule.ema_decay
    validate_every = max(1, steps // 10) if validate_every is None else validate_every
    if validate_every < 1:
        raise ConfigError(f"{description}: validate_every must be positive, found {validate_every}")
    optimizer = torch.optim.AdamW(
        [p for p in module.parameters() if p.requires_grad],
        lr=schedule.learning_rate,
        weight_decay=schedule.weight_decay,
    )
    run = _Run(module, optimizer, generator, None if ema_decay is None else copy.deepcopy(module).eval())
    checkpoint, identity = (None, "") if resumable is None else (resumable.path, resumable.identity)
    course = replace(schedule, warmup=schedule.warm_up)
    identity = json.dumps([identity, *(getattr(course, f.name) for f in fields(Schedule)), validate_every])
    if checkpoint is not None and checkpoint.exists():
        run.restore(read_checkpoint(checkpoint, identity=identity), checkpoint)
        if progress is not None and 0 < run.done < steps:
            progress.say(f"{description}: goes on from update {run.done} of {steps}")

    def save() -> None:
        if checkpoint is not None:
            with _interrupt_postponed():
                write_checkpoint(checkpoint, Checkpoint(identity, run.arrays()))

    module.train()
    saved = told = time.monotonic()
    done_when_told = run.done
    try:
        with (progress or Silent()).task(description, steps, run.done) as task:
            while True:
                due = run.done % validate_every == 0 or run.done == steps
                if validate is not None and run.done > 0 and due and run.done not in run.validated_at[-1:]:
                    run.record_validation(validate)
                if run.done == steps:
                    break
                if resumable is not None and time.monotonic() - saved > resumable.every_seconds:
                    save()
                    saved = time.monotonic()
                run.update(loss, schedule, description)
                if time.monotonic() - told > 0.1 or run.done == steps:
                    task.advance(run.done - done_when_told, run.note())
                    told, done_when_told = time.monotonic(), run.done
    except KeyboardInterrupt:
        save()
        raise
    if run.average is not None:
        module.load_state_dict(run.average.state_dict())
    module.eval()
    return run.history()


@dataclass
class _Run:
    """Everything that changes while training, consistent between updates even if one is interrupted."""

    module: nn.Module
    optimizer: torch.optim.Optimizer
    generator: torch.Generator
    average: nn.Module | None
    loss: list[float] = field(default_factory=list)
    figures: dict[str, list[float]] = field(default_factory=dict)
    validated_at: list[int] = field(default_factory=list)
    validation: dict[str, list[float]] = field(default_factory=dict)
    random_state: Tensor = field(init=False)
    """State of the generator after the last finished update: an interrupted one has drawn from it already."""

    def __post_init__(self) -> None:
        self.random_state = self.generator.get_state()

    @property
    def done(self) -> int:
        """Number of finished updates."""
        return len(self.loss)

    def update(self, loss: Loss, schedule: Schedule, description: str) -> None:
        rate, clip_norm, ema_decay = schedule.rate_at(self.done), schedule.clip_norm, schedule.ema_decay
        self.optimizer.zero_grad(set_to_none=True)
        value, figures = loss(self.module, self.done, self.generator)
        number = float(value.detach())
        where = f"{description}: the {{}} became {{}} in update {self.done + 1} at learning rate {rate:.3g}"
        if not math.isfinite(number):
            raise NonFiniteError(f"{where.format('loss', number)}; lower the learning rate or check the data for NaN")
        value.backward()
        parameters = self.optimizer.param_groups[0]["params"]
        norm = float(nn.utils.clip_grad_norm_(parameters, math.inf if clip_norm is None else clip_norm))
        if not math.isfinite(norm):
            raise NonFiniteError(f"{where.format('gradient', norm)}; lower the learning rate")
        with _interrupt_postponed():
            self.optimizer.param_groups[0]["lr"] = rate
            self.optimizer.step()
            if self.average is not None and ema_decay is not None:
                self._follow(self.average, ema_decay)
            for name in figures.keys() - self.figures.keys():
                self.figures[name] = [math.nan] * self.done
            for name, values in self.figures.items():
                values.append(float(figures.get(name, math.nan)))
            self.loss.append(number)
            self.random_state = self.generator.get_state()

    @torch.no_grad()
    def _follow(self, average: nn.Module, decay: float) -> None:
        decay = min(decay, (1 + self.done) / (10 + self.done))
        for mean, now in zip(average.parameters(), self.module.parameters(), strict=True):
            mean.lerp_(now, 1 - decay)
        for mean, now in zip(average.buffers(), self.module.buffers(), strict=True):
            mean.copy_(now)

    def record_validation(self, validate: Validation) -> None:
        subject = self.module if self.average is None else self.average
        subject.eval()
        with torch.no_grad():
            found = {name: float(value) for name, value in validate(subject).items()}
        self.module.train()
        with _interrupt_postponed():
            for name, value in found.items():
                self.validation.setdefault(name, [math.nan] * len(self.validated_at)).append(value)
            self.validated_at.append(self.done)

    def note(self) -> str:
        """The latest figures in a few words."""
        latest = {"loss": self.loss[-1]} | {k: v[-1] for k, v in self.validation.items()}
        return ", ".join(f"{name} {value:.3g}" for name, value in latest.items())

    def history(self) -> History:
        return History(
            loss=np.array(self.loss),
            figures={k: np.array(v) for k, v in self.figures.items()},
            validated_at=np.array(self.validated_at, dtype=np.int64),
            validation={k: np.array(v) for k, v in self.validation.items()},
        )

    def _tensors(self) -> dict[str, Tensor]:
        """Every tensor that an update changes in place, by name; the optimizer's only after its first update."""
        named = {f"module/{k}": v for k, v in self.module.state_dict().items()}
        if self.average is not None:
            named |= {f"average/{k}": v for k, v in self.average.state_dict().items()}
        for i, parameter in enumerate(self.optimizer.param_groups[0]["params"]):
            named |= {f"optimizer/{i}/{k}": v for k, v in self.optimizer.state[parameter].items()}
        return named

    def arrays(self) -> dict[str, np.ndarray]:
        """The run as named arrays."""
        named = {k: v.detach().numpy() for k, v in self._tensors().items()}
        named |= {"generator": self.random_state.numpy(), "history/loss": np.array(self.loss)}
        named |= {"history/validated_at": np.array(self.validated_at, dtype=np.int64)}
        named |= {f"history/figures/{k}": np.array(v) for k, v in self.figures.items()}
        named |= {f"history/validation/{k}": np.array(v) for k, v in self.validation.items()}
        return named

    @torch.no_grad()
    def restore(self, found: Checkpoint, path: Path) -> None:
        """Continue where :meth:`arrays` was taken."""
        for i, parameter in enumerate(self.optimizer.param_groups[0]["params"]):
            prefix = f"optimizer/{i}/"
            self.optimizer.state[parameter] = {
                k.removeprefix(prefix): torch.from_numpy(np.array(v))
                for k, v in found.arrays.items()
                if k.startswith(prefix)
            }
        for name, tensor in self._tensors().items():
            value = found.arrays.get(name)
            if value is None or tuple(value.shape) != tuple(tensor.shape):
                shape = None if value is None else tuple(value.shape)
                raise ArtifactError(
                    f"the checkpoint {path} does not fit: {name} has shape {shape}, expected {tuple(tensor.shape)}; "
                    "delete it to start over"
                )
            tensor.copy_(torch.from_numpy(np.array(value)))
        self.random_state = torch.from_numpy(found.arrays["generator"])
        self.generator.set_state(self.random_state)
        self.loss = found.arrays["history/loss"].tolist()
        self.validated_at = found.arrays["history/validated_at"].tolist()
        for series, prefix in ((self.figures, "history/figures/"), (self.validation, "history/validation/")):
            series.update({k.removeprefix(prefix): v.tolist() for k, v in found.arrays.items() if k.startswith(prefix)})


@contextmanager
def _interrupt_postponed() -> Iterator[None]:
    """Hold Ctrl-C back until the block is done (only the main thread receives it)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.getsignal(signal.SIGINT)
    pressed: list[tuple] = []
    signal.signal(signal.SIGINT, lambda *received: pressed.append(received))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL if previous is None else previous)
    if pressed and callable(previous):
        previous(*pressed[0])
