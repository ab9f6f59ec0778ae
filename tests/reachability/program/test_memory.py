"""Views and copies: what is written in place into a result changes what torch changes, and nothing else."""

from __future__ import annotations

import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch.nn import functional as F  # noqa: N812

from sagemp_cli.errors import SagempError, UsageError
from sagemp_cli.reachability import reach
from sagemp_cli.reachability.program.recorder import Recorder
from sagemp_cli.reachability.program.value import Traced
from sagemp_cli.sets import Box

ONE = {
    "to copy": lambda t: t.to(torch.float64, copy=True),
    "to": lambda t: t.to(torch.float64),
    "to like": lambda t: t.to(t),
    "type_as": lambda t: t.type_as(t),
    "double": lambda t: t.double(),
    "contiguous": lambda t: t.contiguous(),
    "clone": lambda t: t.clone(),
    "clone contiguous": lambda t: t.clone(memory_format=torch.contiguous_format),
    "detach": lambda t: t.detach(),
    "data": lambda t: t.data,
    "flatten": lambda t: t.flatten(),
    "ravel": lambda t: t.ravel(),
    "reshape": lambda t: t.reshape(-1),
    "reshape back": lambda t: t.reshape(t.shape),
    "view": lambda t: t.view(-1),
    "view or reshape": lambda t: t.view(-1) if t.is_contiguous() else t.reshape(-1),
    "stride": lambda t: t.clone() if t.stride()[-1:] == (1,) else t[...],
    "T": lambda t: t.T if t.dim() == 2 else t,
    "mT": lambda t: t.mT,
    "transpose": lambda t: t.transpose(0, -1),
    "squeeze": lambda t: t.squeeze(),
    "squeeze of one": lambda t: t.squeeze(0),
    "unsqueeze": lambda t: t.unsqueeze(0),
    "expand as itself": lambda t: t.expand(t.shape),
    "index": lambda t: t[..., 0],
    "slice": lambda t: t[..., ::2],
    "fancy": lambda t: t[..., [0]],
    "mask": lambda t: t[torch.ones(t.shape, dtype=torch.bool)],
    "select": lambda t: t.select(-1, 0),
    "narrow": lambda t: t.narrow(-1, 0, 1),
    "diagonal": lambda t: t.diagonal(),
    "diag": lambda t: t.diag(),
    "unbind": lambda t: t.unbind(-1)[0],
    "iteration": lambda t: list(t)[-1],
    "chunk": lambda t: t.chunk(2)[0],
    "split": lambda t: t.split(1)[0],
    "unfold": lambda t: t.unfold(-1, 1, 1),
    "movedim": lambda t: t.movedim(0, -1),
    "swapaxes": lambda t: t.swapaxes(0, -1),
    "permute": lambda t: t.permute(*reversed(range(t.dim()))),
    "flip": lambda t: t.flip(0),
    "roll": lambda t: t.roll(1, 0),
    "repeat": lambda t: t.repeat(*[1] * t.dim()),
    "tile": lambda t: t.tile((1,)),
    "repeat_interleave": lambda t: t.repeat_interleave(1, dim=0),
    "gather": lambda t: t.gather(0, torch.zeros(t.shape, dtype=torch.int64)),
    "index_select": lambda t: t.index_select(0, torch.arange(len(t))),
    "tril": lambda t: t.tril(),
    "broadcast_to": lambda t: t.broadcast_to(t.shape),
    "broadcast_tensors": lambda t: torch.broadcast_tensors(t, torch.ones(1))[0],
    "broadcast of a constant": lambda t: torch.broadcast_tensors(t, torch.ones(1))[1],
    "atleast_2d": lambda t: torch.atleast_2d(t),
    "cat of one": lambda t: torch.cat([t]),
    "cat": lambda t: torch.cat([t, t], -1),
    "stack": lambda t: torch.stack([t, t], 1),
    "hstack": lambda t: torch.hstack([t, t]),
    "pad of nothing": lambda t: F.pad(t, (0, 0)),
    "pad": lambda t: F.pad(t, (0, 1)),
    "sum over one": lambda t: t[..., :1].sum(-1),
    "sum over one kept": lambda t: t[:1].sum(0, keepdim=True),
    "sum over nothing": lambda t: t.sum(()),
    "sum": lambda t: t.sum(-1),
    "mean over one": lambda t: t[:1].mean(0),
    "mean": lambda t: t.mean(),
    "amax": lambda t: t.amax(-1),
    "amax over one": lambda t: t[..., :1].amax(-1),
    "max of one": lambda t: t.flatten()[:1].max(),
    "min": lambda t: t.min(),
    "norm": lambda t: t.norm(),
    "norm along": lambda t: torch.linalg.vector_norm(t, dim=0),
    "einsum transposed": lambda t: torch.einsum("ij->ji", t),
    "einsum diagonal": lambda t: torch.einsum("ii->i", t),
    "einsum trace": lambda t: torch.einsum("ii->", t),
    "einsum same": lambda t: torch.einsum("i->i", t),
    "einsum with a constant": lambda t: torch.einsum("ij,j->ji", t, torch.ones(t.shape[-1])),
    "zeros_like": lambda t: torch.zeros_like(t),
    "ones_like": lambda t: torch.ones_like(t) + 0.0,
    "full_like": lambda t: torch.full_like(t, 0.25),
    "new_zeros": lambda t: t.new_zeros(t.shape),
    "empty_like": lambda t: torch.empty_like(t).copy_(t),
    "plus": lambda t: t + 0.0,
    "plus a row": lambda t: t + torch.ones(t.shape[-1]),
    "plus its transpose": lambda t: t + t.transpose(0, -1),
    "times": lambda t: t * 1.0,
    "minus": lambda t: -t,
    "positive": lambda t: +t,
    "sin": lambda t: torch.sin(t),
    "relu": lambda t: torch.relu(t),
    "relu in place": lambda t: F.relu(t, inplace=True),
    "relu in place by position": lambda t: F.relu(t, True),
    "leaky_relu in place by position": lambda t: F.leaky_relu(t, 0.5, True),
    "silu in place": lambda t: F.silu(t, True),
    "clamp": lambda t: t.clamp(-0.2, 0.2),
    "clamp in place": lambda t: t.clamp_(-0.2, 0.2),
    "minimum": lambda t: torch.minimum(t, t.transpose(0, -1)),
    "dropout": lambda t: F.dropout(t, 0.5, False),
    "square": lambda t: t**2,
    "power one": lambda t: t**1,
    "power nothing": lambda t: t**0,
    "matmul": lambda t: t @ torch.eye(t.shape[-1], dtype=torch.float64),
    "matmul of itself": lambda t: t @ t.mT,
    "linear": lambda t: F.linear(t, torch.eye(t.shape[-1], dtype=torch.float64)),
    "cumsum": lambda t: t.cumsum(0),
    "diff": lambda t: t.diff(dim=0),
    "outer": lambda t: torch.outer(t, t),
    "cross": lambda t: torch.cross(t, 2.0 * t.flip(0), dim=0),
    "lerp": lambda t: torch.lerp(t, 2.0 * t, 0.5),
    "addcmul": lambda t: torch.addcmul(t, t, t),
    "in place": lambda t: t.mul_(0.5),
    "in place sine": lambda t: t.sin_(),
    "augmented": lambda t: augmented(t),
    "matrix, augmented": lambda t: matrix_augmented(t),
    "copy_": lambda t: t.copy_(t.transpose(0, -1) * 1.0),
    "fill_": lambda t: t[..., 0].fill_(0.3),
    "zero_": lambda t: t[0].zero_(),
    "add_ of its part": lambda t: t.add_(t[0] * 1.0),
    "assignment": lambda t: assigned(t),
}  # fmt: skip
"""Functions of one value whose result a step may write into."""


def augmented(t):
    view = t[0]
    view += 0.5
    return view


def matrix_augmented(t):
    old = t
    t @= torch.eye(t.shape[-1], dtype=torch.float64)
    return t if t is not old else old


def assigned(t):
    t[..., 0] = t[..., -1]
    return t


@st.composite
def layouts(draw):
    """A tensor of ids 0, 1, ... with gaps, steps and permuted dimensions, as a function of its base."""
    shape = draw(st.lists(st.sampled_from([1, 2, 3]), min_size=1, max_size=3))
    order = draw(st.permutations(range(len(shape))))
    kind = draw(st.sampled_from(["plain", "stepped", "inner", "expanded", "square"]))
    if kind == "square":
        shape, order = [3, 3], draw(st.permutations(range(2)))

    def lay(base):
        if kind == "stepped":
            base = base[..., ::2]
        if kind == "inner":
            base = base[..., 1:-1]
        return base.permute(*order) if kind != "expanded" else base[:1].expand(base.shape).permute(*order)

    grown = [*shape[:-1], {"stepped": 2 * shape[-1] - 1, "inner": shape[-1] + 2}.get(kind, shape[-1])]
    return grown, lay


def plain_and_recorded(shape, lay):
    numbers = torch.randn(shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    recorder = Recorder(numbers.flatten(), torch.zeros(1, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    plain = numbers.clone()
    recorded = Traced(recorder, recorder.state.reshape(shape))
    return recorder, (plain, lay(plain)), (recorded, lay(recorded))


def outcome(action):
    """The result, or that torch refuses."""
    try:
        with torch.no_grad():
            return action()
    except SagempError:
        raise
    except (RuntimeError, IndexError) as error:
        return type(error)


@settings(max_examples=8, deadline=None)
@given(layouts())
def test_writing_into_a_result_changes_what_torch_changes(layout):
    for name in ONE:
        recorder, (base, plain), (recorded_base, recorded) = plain_and_recorded(*layout)
        try:
            ours = outcome(lambda: ONE[name](recorded))  # noqa: B023
        except SagempError:
            continue  # refused: nothing is claimed
        torchs = outcome(lambda: ONE[name](plain))  # noqa: B023
        if isinstance(torchs, type) or isinstance(ours, type):
            assert ours is torchs, name
            continue
        assert ours.shape == torchs.shape and ours.stride() == torchs.stride(), name
        if not isinstance(ours, Traced):
            assert torch.equal(ours.to(torchs.dtype), torchs), name
            continue
        assert close(recorder.example(ours.ids), torchs), name
        if not isinstance(outcome(lambda: torchs.mul_(3.0).add_(1.0)), type):  # noqa: B023
            outcome(lambda: ours.mul_(3.0).add_(1.0))  # noqa: B023
            assert close(recorder.example(recorded_base.ids), base) and close(recorder.example(ours.ids), torchs), name


def close(a, b):
    return a.shape == b.shape and torch.allclose(a, b, rtol=1e-12, atol=1e-12)


def test_most_functions_are_not_refused_on_a_square_matrix():
    refused = []
    for name, function in ONE.items():
        _, _, (_, recorded) = plain_and_recorded([3, 3], lambda t: t.T)
        try:
            outcome(lambda: function(recorded))  # noqa: B023
        except SagempError:
            refused.append(name)
    assert refused == []


def window(v):
    """1 on a small part of [0, 1], which no dozen of random points hits."""
    return (2000 * (v - 0.333)).clamp(0, 1) * (2000 * (0.3345 - v)).clamp(0, 1)


def seen_through(copied):
    def step(x, w):
        y = x * 0
        z = copied(y)
        z += window(x[0])
        return y - 0.5 * window(x[0])

    return step


COPIES = {
    "to": (lambda y: y.to(torch.float64, copy=True), -0.5),
    "view": (lambda y: y.to(torch.float64), 0.5),
    "amax": (lambda y: y[None].amax(0), -0.5),
    "max": (lambda y: y.max(), -0.5),
    "einsum": (lambda y: torch.einsum("ij->ji", y[None])[:, 0], 0.5),
}


@pytest.mark.parametrize("name", COPIES)
def test_a_copy_that_is_written_into_leaves_what_it_is_a_copy_of(name):
    copied, extreme = COPIES[name]
    step, start = seen_through(copied), Box.around([0.5], [0.5])
    x = torch.linspace(0.0, 1.0, 4001, dtype=torch.float64)[:, None]
    after = torch.stack([step(v.clone(), None) for v in x])
    assert math.isclose(float(after.abs().max()), abs(extreme)) and float(after[after.abs().argmax()]) * extreme > 0
    tube = reach(step, start, Box.around([0.0], [0.0]), 1, partitions=200, batched=False)
    assert bool((tube.lower[1] <= after.min()) & (after.max() <= tube.upper[1]))


def test_a_product_assigned_to_its_name_is_a_new_value():
    def step(x, w):
        kept = x
        x @= torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
        return 0.5 * kept + 0.0 * x

    tube = reach(step, Box.around([1.0, 2.0], [0.1, 0.2]), Box.around([0.0], [0.0]), 1)
    assert torch.allclose(tube.upper[1], torch.tensor([0.55, 1.1], dtype=torch.float64))


def test_a_step_whose_batch_means_something_else_in_a_small_part_is_told_to_say_which():
    step = seen_through(COPIES["to"][0])  # x[0] of a batch is its first row, which shows where the window is only
    with pytest.raises(UsageError, match="another for a batch .*batched=False or batched=True"):
        reach(step, Box.around([0.5], [0.5]), None, 1, partitions=2000)
