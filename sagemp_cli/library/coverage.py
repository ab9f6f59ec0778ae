"""How many references a library needs: the paper's theorem on minimal invasiveness.

If the planner's plan is mu-safely stabilizable, and a fresh draw falls into its delta-ball (delta = epsilon / L,
where every plan is mu-safely stabilizable too) with probability ``p_samp``, then after C independent draws the
closed loop of the closest library entry is within epsilon of tracking the plan itself with probability at least
``1 - exp(-p_samp C)``.

The paper's proof calls ``1 - (1 - p)^C`` "the chance of zero successes"; it is the chance of at least one. The
bound itself is right. C counts draws from the planner (line 3 of Algorithm 2), certified or not: only draws in
the ball are needed, and those are certified by assumption. The theorem speaks about deterministic dynamics.
"""

from __future__ import annotations

import math

from sagemp_cli.errors import UsageError


def imitation_probability(p_samp: float, draws: int) -> float:
    """The theorem's lower bound ``1 - exp(-p_samp C)`` on Pr[E_xi <= epsilon] after ``draws`` = C."""
    _check("p_samp", p_samp, closed=True)
    if draws < 0:
        raise UsageError(f"draws must not be negative, found {draws}")
    return -math.expm1(-p_samp * draws)


def draws_needed(p_samp: float, alpha: float) -> int:
    """The smallest whole ``C >= log(1/alpha) / p_samp``: enough draws for probability at least ``1 - alpha``."""
    _check("p_samp", p_samp, closed=True)
    _check("alpha", alpha, closed=False)
    return math.ceil(math.log(1.0 / alpha) / p_samp)


def _check(name: str, value: float, *, closed: bool) -> None:
    if not (0 < value < 1 or (closed and value == 1)):
        raise UsageError(f"{name} must lie in (0, 1{']' if closed else ')'}, found {value}")
