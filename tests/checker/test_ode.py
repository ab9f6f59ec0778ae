"""The checker writes the period of an ODE as the propagator does, instruction by instruction, from its own code."""

import numpy as np
import pytest
import torch

from sagemp_cli.checker.ode import flow_of
from sagemp_cli.checker.program import Instruction, Program
from sagemp_cli.reachability.continuous.expansion import expansion
from sagemp_cli.reachability.continuous.sampled import SampledLoop
from sagemp_cli.reachability.flow import Division
from sagemp_cli.reachability.program.loops import record
from sagemp_cli.reachability.program.stored import to_record

from .by_hand import line, program

silu = torch.nn.functional.silu

RATES = {
    "sin and cos": lambda x, u: torch.stack([torch.sin(x[1]) * x[0] + u[0], torch.cos(x[1]) - x[0] * torch.sin(x[1])]),
    "exp and log": lambda x, u: torch.stack([torch.exp(-x[0]) + x[1], torch.log(x[0] + 2) * u[0]]),
    "sqrt": lambda x, u: torch.stack([torch.sqrt(x[1] * x[1] + 1), u[0] * torch.sqrt(x[0] + 1)]),
    "quotients": lambda x, u: torch.stack([x[0] / (1 + x[1] * x[1]), 1 / (x[0] + 2)]) + u,
    "one divisor for all": lambda x, u: (x + u) / (2 + x[:1]) - u / 3,
    "reciprocal": lambda x, u: torch.reciprocal(x + 1.5) * u,
    "tanh and tan": lambda x, u: torch.stack([torch.tanh(x[0] * x[1]), torch.tan(0.5 * x[0]) - u[0]]),
    "sigmoid and silu": lambda x, u: torch.stack([torch.sigmoid(x[1]) * u[0], silu(x[0])]),
    "atan": lambda x, u: torch.stack([torch.atan(x[1]), torch.atan(x[0] * u[0])]),
    "atan2": lambda x, u: torch.stack([torch.atan2(x[0], 1 + x[1]), torch.atan2(u[0] + 2 * x[0], x[1] * x[1])]),
    "powers": lambda x, u: torch.stack([x[1] ** 3 - x[0] ** 5, u[0] * x[0] ** 2 + x[1] ** 6]),
    "negative powers": lambda x, u: torch.stack([(x[0] + 1.5) ** -2 - u[0], (x[1] + 2) ** -3 + (x[0] + 3) ** -1]),
    "constant": lambda x, u: torch.stack([x[1], torch.tensor(-9.81, dtype=torch.float64) + 0 * x[0]]),
    "control only": lambda x, u: torch.stack([u[0] * 2, torch.cos(u[0])]),
    "one entry with all": lambda x, u: x * x[:1] - x[1:] + u,
    "twice the same": lambda x, u: torch.stack([x[0] * x[1] + x[0] * x[1], torch.sin(x[0]) * torch.sin(x[0])]),
    "network": lambda x, u: torch.tanh(torch.cat([x, u]) @ WEIGHT) @ WEIGHT[:, :3].T[:3, :2].contiguous()[:3] * 0.5,
}
WEIGHT = torch.tensor([[0.5, -1.0, 0.25], [1.0, 0.125, 2.0], [-0.75, 1.5, 0.5]], dtype=torch.float64)


def sampled_of(rate, m=1, period=0.1):
    x0, nothing = torch.tensor([0.3, 0.4], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    u0 = torch.full((m,), 0.2, dtype=torch.float64)

    def control(x, w, ref):
        hidden = torch.relu(ref - torch.stack([x[0], x[1] * x[0], x[0] + 2 * x[1]]) @ WEIGHT)
        return x * 1, (torch.tanh(hidden[:1]) + hidden[1:2])[:m]

    return SampledLoop(
        record(control, x0, nothing, torch.ones(3, dtype=torch.float64)),
        record(lambda x, w, u: rate(x, u), x0, nothing, u0),
        torch.ones(4, 3, dtype=torch.float64), 4, period,
    )  # fmt: skip


def as_checked(made) -> Program:
    """A recorded program as the checker reads it."""
    r = to_record(made)

    def parts(values, begin):
        return [values[a:b] for a, b in zip(begin[:-1], begin[1:], strict=True)]

    lists = zip(r.kinds, parts(r.operands, r.operand_begin), parts(r.numbers, r.number_begin),
                parts(r.indices, r.index_begin), strict=True)  # fmt: skip
    lines = [Instruction(kind, tuple(reads.tolist()), numbers, entries) for kind, reads, numbers, entries in lists]
    outputs = {n: s for n, s in zip(("next", "control", "deviation"), r.outputs.tolist(), strict=True) if s >= 0}
    g = int(r.sizes[2]) if r.kinds[2] == "numbers" else 0
    return Program.of(lines, outputs, states=int(r.sizes[0]), disturbances=int(r.sizes[1]), numbers=g)


def said(p: Program) -> list:
    return [
        *((i.kind, i.reads, w, i.constants.tobytes(), i.entries.tolist()) for i, w in zip(p.instructions, p.widths)),
        p.next, p.control,
    ]  # fmt: skip


@pytest.mark.parametrize("name", RATES)
def test_the_programs_are_the_propagators_instruction_by_instruction(name):
    loop = sampled_of(RATES[name])
    for substeps, order in ((1, 1), (1, 2), (2, 3), (4, 5)):
        theirs = expansion(loop, Division(substeps, order))
        ours = flow_of(
            as_checked(loop.control), as_checked(loop.rate), period=loop.period, substeps=substeps, order=order
        )
        pairs = (
            (ours.step, theirs.step), (ours.coefficients, theirs.coefficients), (ours.slope, theirs.tangent),
        )  # fmt: skip
        for mine, other in pairs:
            assert said(mine) == said(as_checked(other))
        assert ours.length == theirs.length


def rate_of(*lines, n=2, m=0, next_=None):
    return program(*lines, n=n, d=n, g=m, next=1 + len(lines) + (m > 0) if next_ is None else next_)


NOTHING = program(line("neg", 0), n=2, d=2, next=2)


@pytest.mark.parametrize(
    ("control", "rate", "options", "message"),
    [
        (NOTHING, rate_of(line("relu", 0)), {}, "'relu' stands in the right-hand side"),
        (NOTHING, rate_of(line("clamp", 0, constants=[-1, -1, 1, 1])), {}, "'clamp' stands"),
        (NOTHING, rate_of(line("maximum", 0, 0)), {}, "'maximum' stands"),
        (NOTHING, rate_of(line("add", 0, 1)), {}, "reads the disturbance, which is added"),
        (NOTHING, rate_of(line("neg", 0), next_=1), {}, "reads the disturbance, which is added"),
        (NOTHING, rate_of(line("neg", 0), m=1, next_=3), {}, "takes 1 and 2"),
        (
            program(line("add", 0, 1), line("pick", 2, entries=[0]), n=2, d=2, next=2, control=3),
            rate_of(line("mul", 0, 2), m=1, next_=3), {}, "nobody measures",
        ),
        (NOTHING, rate_of(line("neg", 0)), {"substeps": 3}, "powers of two"),
        (NOTHING, rate_of(line("neg", 0)), {"substeps": 0}, "powers of two"),
        (NOTHING, rate_of(line("neg", 0)), {"substeps": 2**40}, "powers of two"),
        (NOTHING, rate_of(line("neg", 0)), {"order": 0}, "the order is 0"),
        (NOTHING, rate_of(line("neg", 0)), {"order": 31}, "the order is 31"),
        (NOTHING, rate_of(line("neg", 0)), {"period": 0.0}, "the period is 0"),
        (NOTHING, rate_of(line("neg", 0)), {"period": -0.1}, "the period is -0.1"),
        (NOTHING, rate_of(line("neg", 0)), {"period": np.inf}, "the period is inf"),
        (NOTHING, rate_of(line("neg", 0)), {"period": np.nan}, "the period is nan"),
        (NOTHING, rate_of(line("neg", 0)), {"period": 5e-324, "substeps": 2}, "the period is 5e-324"),
        (NOTHING, rate_of(line("mul", 0, 0)), {"substeps": 4096, "order": 30}, "instructions"),
    ],
)  # fmt: skip
def test_what_is_no_ode_that_can_be_checked_is_refused_in_one_line(control, rate, options, message):
    with pytest.raises(ValueError, match=message):
        flow_of(control, rate, **({"period": 0.1, "substeps": 1, "order": 2} | options))
