"""A step as data: recorded from any loop, run on tensors, stored and read back, refused when it is no program."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from sagemp_cli.errors import ArtifactError, UsageError
from sagemp_cli.loop.closed_loop import ClosedLoop
from sagemp_cli.reachability.program.arithmetic import identity
from sagemp_cli.reachability.program.kinds import KINDS
from sagemp_cli.reachability.program.loops import record, recorded
from sagemp_cli.reachability.program.program import Instruction, Outputs, Program
from sagemp_cli.reachability.program.stored import from_record, to_record
from sagemp_cli.sets import Box

from ..propagator_cases import DISTURBANCE, START, AffineLoop, EveryOperation, line, rollouts, unicycle_loop


def every_kind(x, w, p):
    """A step in which every kind of instruction occurs."""
    a, b, c = x
    f = nn.functional
    first = torch.sin(a) * torch.cos(b) + torch.tan(0.3 * c) + torch.atan(a) - torch.tanh(b) / (3 + torch.sigmoid(c))
    second = f.silu(a) + torch.exp(b) - torch.log(4 + c) + torch.sqrt(5 + a) + torch.abs(b) + torch.reciprocal(7 + c)
    third = torch.relu(a) + f.leaky_relu(b, 0.1) + f.elu(c) + f.softplus(a, 2.0, 9.0) - a**3 + b.clamp(-0.3, 0.2)
    fourth = torch.maximum(a, b) - torch.minimum(b, c) * torch.atan2(a, 2 + b) + identity(c) + p[0] * w[1]
    mixed = f.linear(x, torch.tensor([[1.0, 2.0, 3.0]]).double(), torch.tensor([0.5]).double())
    third = (
        third + f.gelu(a) + f.gelu(b, approximate="tanh") - f.mish(c) + f.softsign(a) * f.hardswish(b) + torch.erf(c)
    )
    third = third + torch.floor(a) - torch.ceil(b) + torch.round(3 * c) * torch.trunc(2 * a) + torch.sign(b)
    third = third + torch.remainder(a, 0.7) - torch.fmod(b, 0.7) + torch.atan2(torch.sin(c), torch.cos(c))
    third = third + torch.logaddexp(a, 2 * b)
    third = third + torch.where(a > 0.1, b, c) * (b >= c)
    narrow = f.linear(torch.tanh(x.float()), torch.tensor([[1.0, 2.0, 3.0]])).double()
    return torch.stack([first - second, third, 0.1 * fourth]) + w + p[1] * mixed + narrow, first[None], -x


X, P = torch.tensor([0.3, -0.5, 0.2]).double(), torch.tensor([1.0, 2.0]).double()
PROGRAM = record(every_kind, X, X, P)


def test_every_kind_does_on_batches_what_torch_does_on_single_states():
    assert {i.kind for i in PROGRAM.instructions} == set(KINDS)
    generator = torch.Generator().manual_seed(0)
    x, w, p = (torch.randn(50, size, dtype=torch.float64, generator=generator) for size in (3, 3, 2))
    found = PROGRAM.run(x, w, p)
    expected = [every_kind(*row) for row in zip(x, w, p, strict=True)]
    for name, values in zip(("next", "control", "deviation"), zip(*expected, strict=True), strict=True):
        close = 1e-6 if name == "next" else 1e-14  # in float32 torch rounds more than once
        torch.testing.assert_close(getattr(found, name), torch.stack(values), rtol=close, atol=close)


@pytest.mark.parametrize("loop", [unicycle_loop(line(0.1)), AffineLoop()], ids=str)
def test_a_recorded_loop_steps_as_the_loop_does(loop):
    n = loop.state_dim
    start, w = (
        (START, DISTURBANCE) if n == 4 else (Box.around([1.0, 0.0], [0.5, 0.5]), Box.around([0.0] * 2, [0.1] * 2))
    )
    found = recorded(loop, start, w)
    assert (found.horizon, found.state_dim, recorded(found, start, w)) == (loop.horizon, n, found)
    states = rollouts(loop, start, w)
    torch.testing.assert_close(rollouts(found, start, w), states, rtol=1e-13, atol=1e-13)


def test_our_own_loop_is_one_program_with_the_window_as_its_numbers_and_says_its_control():
    loop = unicycle_loop(line(0.3))
    found = recorded(loop, START, DISTURBANCE)
    assert len(found.programs) == 1 and found.numbers.shape == (loop.horizon, 8)
    torch.testing.assert_close(found.numbers[3], loop.window(3).flatten(), rtol=0, atol=0)
    x = START.sample(5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found.outputs(2, x, torch.zeros(4)).control, loop.control(2, x), rtol=1e-13, atol=1e-13)
    assert found.outputs(2, x, torch.zeros(4)).deviation is None


def test_a_batch_of_references_is_a_batch_of_numbers():
    loop = unicycle_loop(line(0.3), line(-0.2))
    found = recorded(loop, START, DISTURBANCE)
    assert found.batch == (2, 1)
    x = START.sample(5, torch.Generator().manual_seed(0)).expand(2, 5, 4)
    torch.testing.assert_close(
        found.step(4, x, torch.zeros(4)), loop.step(4, x, torch.zeros(4)), rtol=1e-13, atol=1e-13
    )


def test_steps_that_are_the_same_are_one_program_and_others_are_several():
    box = Box.around([0.1, 0.2, 0.3], [0.1, 0.1, 0.1])
    assert len(recorded(EveryOperation(), box, box).programs) == 1
    box = Box.around([0.1, 0.2], [0.1, 0.1])
    assert len(recorded(AffineLoop(), box, box).programs) == AffineLoop().horizon


def test_a_loop_whose_later_class_overrides_the_step_is_recorded_by_its_step():
    class Windy(ClosedLoop):
        def step(self, k, x, w):
            return super().step(k, x, w) + 0.5

    plain = unicycle_loop(line(0.1))
    windy = Windy(plain.dynamics, plain.tracker, plain.references)
    x, w = START.center, torch.zeros(4, dtype=torch.float64)
    torch.testing.assert_close(
        recorded(windy, START, DISTURBANCE).step(1, x, w), plain.step(1, x, w) + 0.5, rtol=1e-13, atol=1e-13
    )


def test_what_the_outputs_do_not_need_is_dropped():
    def step(x, w):
        torch.sin(x)
        return 2 * x

    assert record(step, X[:2], X[:1]).kinds == ("state", "disturbance", "constant", "mul")


def test_weights_keep_their_gradient_where_autograd_is_on():
    layer = nn.Linear(2, 2, dtype=torch.float64)
    gain = nn.Parameter(torch.zeros(2, dtype=torch.float64))
    x = torch.tensor([[0.3, -0.5]], dtype=torch.float64)
    record(lambda x, w: layer(x) * gain + gain, X[:2], X[:1]).run(x, x[:, :1]).next.sum().backward()
    torch.testing.assert_close(gain.grad, (layer(x) + 1)[0].detach())
    with torch.no_grad():
        program = record(lambda x, w: layer(x), X[:2], X[:1])
    assert not any(c.requires_grad for i in program.instructions for c in i.constants)


def test_a_program_is_the_same_after_it_was_stored():
    again = from_record(to_record(PROGRAM))
    assert again.same_as(PROGRAM)
    assert not from_record(to_record(record(lambda x, w: x + 1, X[:1], X[:1]))).same_as(
        record(lambda x, w: x + 2, X[:1], X[:1])
    )


def changed(**arrays):
    return dataclasses.replace(to_record(PROGRAM), **arrays)


STORED = to_record(PROGRAM)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (changed(kinds=("os.system", *STORED.kinds[1:])), r"instruction 0 \('os.system'\) is none of state"),
        (changed(kinds=("state", "state", *STORED.kinds[2:])), "must be among the first"),
        (changed(operands=STORED.operands + 1000), "reads slots"),
        (changed(operands=-1 - STORED.operands), "reads slots"),
        (changed(sizes=STORED.sizes * 2), "instruction 3"),
        (changed(indices=STORED.indices + 100), "picks entries that are not there"),
        (changed(numbers=STORED.numbers[:-1]), "'number_begin' does not divide"),
        (changed(number_begin=STORED.number_begin[::-1].copy()), "'number_begin' does not divide"),
        (changed(numbers=STORED.numbers * np.nan), "not finite"),
        (changed(outputs=STORED.outputs * 0 + 1000), "output 'next' must be a slot"),
        (changed(outputs=np.array([-1, -1, -1])), "output 'next' must be a slot"),
        (changed(outputs=np.array([3, -1, -1])), "output 'next' has 1 entries, the state 3"),
        (changed(outputs=STORED.outputs[:2]), "2 outputs, expected 3"),
    ],
)
def test_what_is_no_program_is_refused_in_one_line(record, message):
    with pytest.raises(ArtifactError, match=message) as error:
        from_record(record)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("kind", "numbers", "message"),
    [
        ("leaky_relu", [1.5], "slope 1.5, allowed is at most 1"),
        ("elu", [-0.5], "alpha -0.5, allowed is a positive one"),
        ("remainder", [0.0], "period 0.0, allowed is a positive one"),
        ("pow", [1.0], "exponent 1.0, allowed are those below 2\\^31 in size other than 0 and 1"),
        ("pow", [2.0**31], "exponent 2147483648.0, allowed are those below 2\\^31 in size"),
        ("softplus", [0.0, 20.0], "beta 0.0, allowed is a positive one"),
    ],
)
def test_constants_that_no_relaxation_is_right_for_are_refused(kind, numbers, message):
    inputs = Instruction("state", 1), Instruction("disturbance", 1)
    wrong = Instruction(kind, 1, (0,), tuple(torch.tensor(v, dtype=torch.float64) for v in numbers))
    with pytest.raises(UsageError, match=message):
        Program((*inputs, wrong), Outputs(2))


def test_layers_take_a_weight_that_depends_on_the_state_and_a_constant_input():
    inputs = torch.tensor([[1.0, 2.0], [3.0, -1.0], [0.5, 4.0]]).double()

    def step(x, w):
        weight = torch.stack([x[:2], x[1:]])
        both = nn.functional.linear(inputs, weight) + nn.functional.linear(inputs, x[:2])[:, None]
        return both.sum(0).repeat(2)[:3]

    for x in torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)):
        torch.testing.assert_close(record(step, X, X).run(x[None], X[None]).next[0], step(x, X))


def test_limits_that_are_equal_for_equal_entries_make_one_entry():
    program = record(lambda x, w: torch.clamp(x[:1].expand(3), *torch.tensor([[-1.0] * 3, [0.1] * 3])), X, X)
    assert [i.size for i in program.instructions if i.kind == "clamp"] == [1]
    apart = record(lambda x, w: torch.clamp(x[:1].expand(3), max=torch.tensor([0.1, 0.2, 0.3])), X, X)
    torch.testing.assert_close(apart.run(X[None], X[None]).next[0], torch.tensor([0.1, 0.2, 0.3]).double())


def test_a_value_takes_the_shape_of_another_one():
    def step(x, w):
        one, column = x[:1].expand_as(x), x.reshape(3, 1)
        return one * x.view_as(w) + column.reshape_as(w) - column.expand_as(torch.zeros(3, 2)).sum(-1)

    torch.testing.assert_close(record(step, X, X).run(X[None], X[None]).next[0], step(X, X))
