"""The training loop: what it learns, what it records, and that a resumed run is the same run."""

import dataclasses
import signal

import numpy as np
import pytest
import torch
from torch import nn

from sagemp_cli.errors import ArtifactError, ConfigError, NonFiniteError
from sagemp_cli.learning.checkpoint import Resumable
from sagemp_cli.learning.fit import fit
from sagemp_cli.learning.schedule import FINAL_SHARE, Schedule
from sagemp_cli.progress import Silent

TRUE = torch.tensor([[1.0, -2.0, 0.5]])


def regression(module, step, generator):
    x = torch.randn(16, 3, generator=generator)
    value = nn.functional.mse_loss(module(x), x @ TRUE.T)
    figures = {"every step": step} | ({"late": 1.0} if step >= 5 else {})
    return value, figures


def line():
    module = nn.Linear(3, 1)
    with torch.no_grad():
        module.weight.fill_(0.3)
        module.bias.fill_(0.1)
    return module


def generator():
    return torch.Generator().manual_seed(3)


def error_of(module):
    return {"error": float((module.weight - TRUE).abs().max())}


SCHEDULE = Schedule(steps=40, learning_rate=0.05, ema_decay=0.9, weight_decay=0.01)
OPTIONS = dict(validate=error_of, validate_every=7)


def interrupted_at(step, kind=KeyboardInterrupt):
    def loss(module, now, source):
        value = regression(module, now, source)
        if now == step:
            raise kind
        return value

    return loss


def assert_same(first, second):
    (module_a, history_a), (module_b, history_b) = first, second
    for name, value in module_a.state_dict().items():
        assert torch.equal(value, module_b.state_dict()[name]), name
    assert np.array_equal(history_a.loss, history_b.loss)
    assert np.array_equal(history_a.validated_at, history_b.validated_at)
    for a, b in ((history_a.figures, history_b.figures), (history_a.validation, history_b.validation)):
        assert a.keys() == b.keys()
        assert all(np.array_equal(a[k], b[k], equal_nan=True) for k in a)


def test_a_linear_regression_finds_the_true_weights():
    module = line()
    history = fit(module, regression, Schedule(steps=400, learning_rate=0.05), generator=generator())
    assert torch.allclose(module.weight, TRUE, atol=1e-3)
    assert history.loss.shape == (400,) and history.loss[-1] < 1e-4 * history.loss[0]
    assert not module.training


def test_history_records_figures_and_validation():
    history = fit(line(), regression, SCHEDULE, generator=generator(), **OPTIONS)
    assert history.figures["every step"].tolist() == list(range(40))
    assert np.isnan(history.figures["late"][:5]).all() and (history.figures["late"][5:] == 1).all()
    assert history.validated_at.tolist() == [7, 14, 21, 28, 35, 40]
    assert history.validation["error"].shape == (6,)


@pytest.mark.parametrize("step", [0, 1, 7, 13, 39])
def test_a_resumed_run_ends_in_the_same_bits(tmp_path, step):
    whole = line()
    expected = fit(whole, regression, SCHEDULE, generator=generator(), **OPTIONS)
    path = tmp_path / "run.h5"
    with pytest.raises(KeyboardInterrupt):
        fit(line(), interrupted_at(step), SCHEDULE, generator=generator(), resumable=Resumable(path), **OPTIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5"]
    module, source = line(), generator()
    history = fit(module, regression, SCHEDULE, generator=source, resumable=Resumable(path), **OPTIONS)
    assert_same((whole, expected), (module, history))
    reference = generator()
    fit(line(), regression, SCHEDULE, generator=reference, **OPTIONS)
    assert torch.equal(source.get_state(), reference.get_state())


class Listener(Silent):
    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


def test_a_resumed_run_says_where_it_goes_on(tmp_path):
    path, fresh, resumed = tmp_path / "run.h5", Listener(), Listener()
    options = OPTIONS | {"resumable": Resumable(path), "description": "training it"}
    with pytest.raises(KeyboardInterrupt):
        fit(line(), interrupted_at(23), SCHEDULE, generator=generator(), progress=fresh, **options)
    fit(line(), regression, SCHEDULE, generator=generator(), progress=resumed, **options)
    assert fresh.said == []
    assert resumed.said == ["training it: goes on from update 23 of 40"]


def test_an_interrupt_while_validating_is_resumed_exactly(tmp_path):
    calls = []

    def impatient(module):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return error_of(module)

    whole = line()
    expected = fit(whole, regression, SCHEDULE, generator=generator(), **OPTIONS)
    path = tmp_path / "run.h5"
    with pytest.raises(KeyboardInterrupt):
        fit(
            line(),
            regression,
            SCHEDULE,
            generator=generator(),
            resumable=Resumable(path),
            **(OPTIONS | {"validate": impatient}),
        )
    module = line()
    history = fit(module, regression, SCHEDULE, generator=generator(), resumable=Resumable(path), **OPTIONS)
    assert_same((whole, expected), (module, history))


def test_ctrl_c_in_the_middle_of_an_update_waits_for_its_end(tmp_path, monkeypatch):
    path, step = tmp_path / "run.h5", torch.optim.AdamW.step
    updates = []

    def pressed(self, *args):
        updates.append(1)
        if len(updates) == 10:
            signal.raise_signal(signal.SIGINT)
        return step(self, *args)

    monkeypatch.setattr(torch.optim.AdamW, "step", pressed)
    with pytest.raises(KeyboardInterrupt):
        fit(line(), regression, SCHEDULE, generator=generator(), resumable=Resumable(path), **OPTIONS)
    monkeypatch.undo()
    whole, module = line(), line()
    expected = fit(whole, regression, SCHEDULE, generator=generator(), **OPTIONS)
    assert_same(
        (whole, expected),
        (module, fit(module, regression, SCHEDULE, generator=generator(), resumable=Resumable(path), **OPTIONS)),
    )


def test_a_crash_resumes_from_the_last_periodic_checkpoint(tmp_path):
    path = tmp_path / "run.h5"
    options = OPTIONS | {"resumable": Resumable(path, every_seconds=0.0)}
    with pytest.raises(MemoryError):
        fit(line(), interrupted_at(20, MemoryError), SCHEDULE, generator=generator(), **options)
    seen = []

    def watched(module, step, source):
        seen.append(step)
        return regression(module, step, source)

    whole, module = line(), line()
    history = fit(module, watched, SCHEDULE, generator=generator(), **options)
    assert seen[0] == 20
    assert_same((whole, fit(whole, regression, SCHEDULE, generator=generator(), **OPTIONS)), (module, history))


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    path = tmp_path / "run.h5"
    with pytest.raises(KeyboardInterrupt):
        fit(line(), interrupted_at(5), SCHEDULE, generator=generator(), resumable=Resumable(path, "one"), **OPTIONS)
    for identity, schedule in (("two", SCHEDULE), ("one", dataclasses.replace(SCHEDULE, learning_rate=0.04))):
        with pytest.raises(ArtifactError, match=r"run\.h5 belongs to other work .* delete it to start over"):
            fit(line(), regression, schedule, generator=generator(), resumable=Resumable(path, identity), **OPTIONS)
    with pytest.raises(ArtifactError, match=r"does not fit: module/weight has shape \(1, 3\), expected \(1, 2\)"):
        fit(nn.Linear(2, 1), regression, SCHEDULE, generator=generator(), resumable=Resumable(path, "one"), **OPTIONS)


def test_a_damaged_checkpoint_is_named(tmp_path):
    path = tmp_path / "run.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n and nothing more")
    with pytest.raises(ArtifactError, match=r"cannot read the checkpoint .*run\.h5 .* delete it to start over"):
        fit(line(), regression, SCHEDULE, generator=generator(), resumable=Resumable(path), **OPTIONS)


def test_the_moving_average_is_kept_and_validated():
    seen = []

    def remember(module):
        seen.append(module.weight.clone())
        return {}

    module = line()
    schedule = Schedule(steps=200, learning_rate=0.02, shape="constant", warmup=0, ema_decay=0.95)
    trace = []

    def noisy(subject, step, source):
        trace.append(subject.weight.detach().clone())
        return (subject.weight * torch.randn(1, 3, generator=source)).sum() + 0 * subject.bias.sum(), {}

    fit(module, noisy, schedule, generator=generator(), validate=remember, validate_every=1)
    # Recompute the average from the trace of the weights: trace[i] is what update i - 1 left.
    mean = trace[0].clone()
    for i in range(1, 200):
        decay = min(0.95, i / (9 + i))
        mean = decay * mean + (1 - decay) * trace[i]
        assert torch.allclose(seen[i - 1], mean, atol=1e-6)
    assert torch.equal(module.weight, seen[-1])


@pytest.mark.parametrize(("factor", "what"), [(float("nan"), "loss became nan"), (float("inf"), "loss became inf")])
def test_a_loss_that_is_not_finite_stops_the_run(factor, what):
    module = line()

    def broken(subject, step, source):
        value, figures = regression(subject, step, source)
        return value * (factor if step == 3 else 1), figures

    with pytest.raises(NonFiniteError, match=rf"^the thing: the {what} in update 4 at learning rate 0.05; lower"):
        fit(
            module,
            broken,
            Schedule(steps=9, learning_rate=0.05, shape="constant"),
            generator=generator(),
            description="the thing",
        )
    assert bool(torch.isfinite(module.weight).all())


def test_a_gradient_that_is_not_finite_stops_the_run():
    module = line()

    def kink(subject, step, source):
        return torch.sqrt(subject.weight * 0.0).sum() + 0 * subject.bias.sum(), {}

    with pytest.raises(NonFiniteError, match="the gradient became nan in update 1"):
        fit(module, kink, Schedule(steps=9, learning_rate=0.05), generator=generator())
    assert bool(torch.isfinite(module.weight).all())


def test_clipping_bounds_the_gradient():

    def steep(subject, step, source):
        return 1e6 * regression(subject, step, source)[0], {}

    module, norms = line(), []
    original = torch.optim.AdamW.step

    def step(self, *args):
        norms.append(float(torch.cat([p.grad.flatten() for p in self.param_groups[0]["params"]]).norm()))
        return original(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.optim.AdamW, "step", step)
        for clip_norm in (0.5, None):
            fit(module, steep, Schedule(steps=5, learning_rate=0.01, clip_norm=clip_norm), generator=generator())
    assert max(norms[:5]) <= 0.5 + 1e-5
    assert min(norms[5:]) > 1e3


def test_the_learning_rate_warms_up_and_falls():
    def at(step, shape="cosine"):
        return Schedule(steps=101, learning_rate=2.0, warmup=10, shape=shape).rate_at(step)

    assert at(0) == pytest.approx(2 / 11)
    assert at(10) == pytest.approx(2.0)
    assert at(55) == pytest.approx(2 * (1 + FINAL_SHARE) / 2)
    assert at(100) == pytest.approx(2 * FINAL_SHARE)
    assert all(at(k) > at(k + 1) for k in range(10, 100))
    assert at(90, "constant") == 2.0


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"shape": "cosin"}, "shape must be 'cosine' or 'constant', found 'cosin'"),
        ({"steps": 0}, "steps must be positive and 0 <= warmup < steps, found 0 and 0"),
        ({"learning_rate": -1.0}, "learning_rate must be a positive number, found -1.0"),
        ({"ema_decay": 1.0}, r"ema_decay must lie in \[0, 1\), found 1.0"),
    ],
)
def test_wrong_options_are_named(wrong, text):
    with pytest.raises(ConfigError, match=text):
        Schedule(**({"steps": 9, "learning_rate": 0.1} | wrong))


def test_a_validation_every_zeroth_update_is_refused():
    with pytest.raises(ConfigError, match="training: validate_every must be positive, found 0"):
        fit(line(), regression, SCHEDULE, generator=generator(), validate_every=0)


def test_progress_counts_every_update_once_even_when_resumed(tmp_path):
    class Counting:
        def __init__(self):
            self.done = 0

        def task(self, description, total, done=0):
            self.description, self.total, self.done = description, total, done
            return self

        def __enter__(self):
            return self

        def __exit__(self, *raised):
            return None

        def advance(self, steps=1, note=""):
            self.done += steps
            self.last = note

        def say(self, text):
            pass

    path = tmp_path / "run.h5"
    with pytest.raises(KeyboardInterrupt):
        fit(line(), interrupted_at(9), SCHEDULE, generator=generator(), resumable=Resumable(path), **OPTIONS)
    progress = Counting()
    fit(line(), regression, SCHEDULE, generator=generator(), resumable=Resumable(path), progress=progress, **OPTIONS)
    assert (progress.description, progress.total, progress.done) == ("training", 40, 40)
    assert progress.last.startswith("loss ") and "error " in progress.last
