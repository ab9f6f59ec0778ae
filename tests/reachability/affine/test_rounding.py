"""The rounding of a whole pass: tubes of linear loops hold their exact reach sets, thanks to the account of it."""

from fractions import Fraction

import pytest
import torch

from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.reachability.affine.compiled import operations
from sagemp_cli.sets import Box

STEPS = 12
A = [[0.7, 0.1, -0.3], [1 / 3, 0.9, 0.2], [-0.1, 1 / 7, 0.8]]
C = [0.1, -1 / 3, 0.7]


class Linear:
    """``x+ = A (x / 3) * 3.1 + w + c`` in a way that rounds a good deal."""

    horizon, state_dim = STEPS, 3

    def step(self, k, x, w):
        a, c = torch.tensor(A, dtype=torch.float64), torch.tensor(C, dtype=torch.float64)
        return torch.nn.functional.linear(x / 3, a) * 3.1 + w + c


def exact_bounds(start, w):
    """Lower and upper bounds of every state after every step, as fractions."""
    a = [[Fraction(v) * Fraction(3.1) / 3 for v in row] for row in A]
    low, high = ([Fraction(v) for v in side] for side in (start.lower.tolist(), start.upper.tolist()))
    w_low, w_high = ([Fraction(v) for v in side] for side in (w.lower.tolist(), w.upper.tolist()))
    center = [(p + q) / 2 for p, q in zip(low, high, strict=True)]
    generators = [[(high[i] - low[i]) / 2 if i == j else Fraction(0) for j in range(3)] for i in range(3)]
    found = []
    for _ in range(STEPS):
        center = [
            sum(a[i][j] * center[j] for j in range(3)) + Fraction(C[i]) + (w_low[i] + w_high[i]) / 2 for i in range(3)
        ]
        generators = [[sum(a[i][j] * g[j] for j in range(3)) for i in range(3)] for g in generators]
        generators += [[(w_high[i] - w_low[i]) / 2 if i == j else Fraction(0) for j in range(3)] for i in range(3)]
        reach = [sum(abs(g[i]) for g in generators) for i in range(3)]
        found.append([(c - r, c + r) for c, r in zip(center, reach, strict=True)])
    return found


def holds(start, w):
    tube = Affine().propagate(Linear(), start, w)
    return all(
        Fraction(float(tube.lower[k + 1, i])) <= low and high <= Fraction(float(tube.upper[k + 1, i]))
        for k, row in enumerate(exact_bounds(start, w))
        for i, (low, high) in enumerate(row)
    )


POINT = Box.around([0.3, -1.1, 2.7], [0.0] * 3)
SMALL = Box.around([0.3, -1.1, 2.7], [1e-17, 0.0, 3e-16])
WIDE = Box.around([0.3, -1.1, 2.7], [0.1, 0.2, 0.3])


@pytest.mark.parametrize("start", [POINT, SMALL, WIDE], ids=["point", "small", "wide"])
@pytest.mark.parametrize("noise", [0.0, 1e-16, 0.05])
def test_the_tube_holds_the_exact_reach_set(start, noise):
    assert holds(start, Box.around([0.01, 0.0, 0.1], [noise] * 3))


def test_without_what_a_step_rounds_it_would_not(monkeypatch):
    still = Box.around([0.01, 0.0, 0.1], [0.0] * 3)
    assert holds(POINT, still)
    monkeypatch.setattr(operations, "SAFETY", 0.0)
    assert not holds(POINT, still)
