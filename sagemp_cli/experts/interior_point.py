"""A primal-dual interior-point method for problems with the structure of a trajectory.

A trajectory is a chain of nodes ``z_k = (x_k, u_k)``, k = 0..K; each is tied only to its neighbours. The Newton
system of such a chain, ordered node by node, is a band matrix of half-width ``2 n + m``, so one step costs a banded
LU factorisation (``scipy.linalg.solve_banded``), linear in K. General solvers (``scipy.optimize``'s
``trust-constr`` and ``SLSQP``) find the same optima but do not see the band: minutes where this takes tenths of a
second.

Method: slacks on all inequalities, a logarithmic barrier that is lowered in stages (Fiacco-McCormick), Newton
directions with the curvature of cost and barrier, steps limited to keep slacks and multipliers positive, and a
backtracking line search on the l1 merit function (Nocedal and Wright 2006, chapter 19). The curvature of the
constraints themselves is left out (Gauss-Newton): every direction then descends without further care, and on the
unicycle it took no more steps than exact Hessians made positive semidefinite. The price is linear convergence.
It finds local optima; which one is the initial guess's business (:mod:`sagemp_cli.experts.homotopy`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

Array = NDArray[np.float64]


class ChainProblem(Protocol):
    """``min cost(z)  s.t.  defects(z) = 0,  inequalities(z) >= 0`` over a chain ``z (K+1, n+m)``, states first.

    Node 0's defect is ``start - x_0``, node k's is ``f(x_{k-1}, u_{k-1}) - x_k``. The cost is quadratic. Node K has
    controls only to keep the arrays rectangular; nothing may depend on them.
    """

    state_dim: int
    control_dim: int
    active: NDArray[np.bool_]
    """Which of the inequalities ``(K+1, c)`` exist; the others are ignored."""

    def cost(self, z: Array) -> float:
        """The cost of a chain."""
        ...

    def cost_gradient(self, z: Array) -> Array:
        """Its gradient ``(K+1, n+m)``."""
        ...

    def cost_curvature(self) -> tuple[Array, Array]:
        """Its Hessian: diagonals ``(K+1, n+m)`` and the coupling ``(K, m)`` of ``u_k`` with ``u_{k+1}``."""
        ...

    def constraints(self, z: Array) -> tuple[Array, Array]:
        """Defects ``(K+1, n)`` and inequalities ``(K+1, c)``."""
        ...

    def jacobians(self, z: Array) -> tuple[Array, Array]:
        """``df/dz (K, n, n+m)`` at nodes 0..K-1 and the inequalities' Jacobian ``(K+1, c, n+m)``."""
        ...


@dataclass(frozen=True)
class ChainSolution:
    """Where the method stopped.

    Attributes:
        z: nodes ``(K+1, n+m)``.
        multipliers: of the defects, ``(K+1, n)``.
        duals: of the inequalities, ``(K+1, c)``, not negative.
        iterations: Newton steps taken.
        converged: whether the scaled optimality conditions hold within the tolerance asked for.
        reason: why it stopped without converging, or empty.
    """

    z: Array
    multipliers: Array
    duals: Array
    iterations: int
    converged: bool
    reason: str


def optimality_error(problem: ChainProblem, z: Array, multipliers: Array, duals: Array) -> float:
    """Largest violation of the first-order (KKT) conditions without feasibility, scaled as in IPOPT.

    The stationarity and complementarity residuals are divided by the mean size of the multipliers where that
    exceeds 100.
    """
    _, inequalities = problem.constraints(z)
    dynamics_jacobian, inequality_jacobian = problem.jacobians(z)
    gradient = _stationarity(problem, z, multipliers, duals, dynamics_jacobian, inequality_jacobian)
    products = duals * np.where(problem.active, inequalities, 0.0)
    scale = _multiplier_scale(multipliers, duals)
    return float(max(np.abs(gradient).max(), np.abs(products).max()) / scale)


def solve_chain(
    problem: ChainProblem,
    guess: Array,
    *,
    optimality: float = 1e-4,
    feasibility: float = 1e-8,
    max_iterations: int = 200,
) -> ChainSolution:
    """A local optimum near ``guess (K+1, n+m)``, which need not be feasible.

    Deterministic: the same problem and guess give the same floating-point numbers on the same machine.

    Args:
        problem: the chain.
        guess: starting point.
        optimality: tolerance on the scaled optimality conditions. Convergence at the end is linear, a factor of
            0.3 to 0.85 per step, so every digit costs iterations.
        feasibility: tolerance on defects and inequalities, which converge sooner.
        max_iterations: Newton steps after which to stop with a reason.
    """
    z, active = guess.copy(), problem.active
    barrier = 0.1
    multipliers = np.zeros((z.shape[0], problem.state_dim))
    defects, inequalities = problem.constraints(z)
    slack = np.where(active, np.maximum(inequalities, 0.05), 1.0)
    duals = np.where(active, barrier / slack, 0.0)
    penalty, lowest = 1.0, 0.1 * optimality
    diagonal, coupling = problem.cost_curvature()
    index = np.arange(z.shape[1])
    diagonal = diagonal + 1e-8  # states and controls without a cost still need a unique step
    for iteration in range(max_iterations):
        dynamics_jacobian, inequality_jacobian = problem.jacobians(z)
        gap = np.where(active, inequalities - slack, 0.0)
        gradient = _stationarity(problem, z, multipliers, duals, dynamics_jacobian, inequality_jacobian)
        scale = _multiplier_scale(multipliers, duals)
        infeasible = max(np.abs(defects).max(), np.abs(gap).max())
        stationarity = np.abs(gradient).max() / scale

        products = np.where(active, slack * duals, 0.0)
        if infeasible <= feasibility and max(stationarity, products.max() / scale) <= optimality:
            return ChainSolution(z, multipliers, duals, iteration, True, "")
        while barrier > lowest:
            off_center = np.where(active, np.abs(products - barrier), 0.0).max() / scale
            if max(stationarity, infeasible, off_center) > 10.0 * barrier:
                break
            barrier = max(lowest, min(0.2 * barrier, barrier**1.5))

        ratio = np.where(active, duals / slack, 0.0)
        hessian = np.einsum("kc,kci,kcj->kij", ratio, inequality_jacobian, inequality_jacobian)
        hessian[:, index, index] += diagonal
        # The condensed system: slack and dual steps are expressed through dz (Nocedal and Wright, 19.13).
        pull = np.where(active, barrier / slack - duals - ratio * gap, 0.0)
        force = -gradient + np.einsum("kc,kci->ki", pull, inequality_jacobian)
        step, multiplier_step = _newton_step(hessian, coupling, dynamics_jacobian, force, -defects)
        if not (np.isfinite(step).all() and np.isfinite(multiplier_step).all()):
            return ChainSolution(z, multipliers, duals, iteration, False, "the Newton system is singular")
        slack_step = np.where(active, np.einsum("kci,ki->kc", inequality_jacobian, step) + gap, 0.0)
        dual_step = np.where(active, barrier / slack - duals - ratio * slack_step, 0.0)

        longest = _to_boundary(slack, slack_step, active)
        dual_length = _to_boundary(duals, dual_step, active)
        slope = (problem.cost_gradient(z) * step).sum() - (np.where(active, barrier / slack, 0.0) * slack_step).sum()
        residual = np.abs(defects).sum() + np.abs(gap).sum()
        if residual > 1e-12:  # below that, rounding decides the sign of the slope
            penalty = max(penalty, slope / (0.7 * residual))
        descent = slope - penalty * residual
        here = _merit(problem.cost(z), slack, defects, gap, active, barrier, penalty)
        length = longest
        while True:
            z_next = z + length * step
            defects_next, inequalities_next = problem.constraints(z_next)
            slack_next = slack + length * slack_step
            # A slack below its inequality may be raised to it: the merit only falls.
            slack_next = np.where(active, np.maximum(slack_next, inequalities_next), 1.0)
            gap_next = np.where(active, inequalities_next - slack_next, 0.0)
            there = _merit(problem.cost(z_next), slack_next, defects_next, gap_next, active, barrier, penalty)
            if there <= here + 1e-4 * length * descent + 1e-12 * abs(here):
                break
            length *= 0.5
            if length < 1e-8:
                return ChainSolution(z, multipliers, duals, iteration, False, "no step improves the trajectory")
        z, slack, defects, inequalities = z_next, slack_next, defects_next, inequalities_next
        multipliers = multipliers + length * multiplier_step
        duals = duals + dual_length * dual_step
        # Keep the duals near barrier / slack (the same safeguard as in IPOPT, equation 16).
        duals = np.where(active, np.clip(duals, 1e-10 * barrier / slack, 1e10 * barrier / slack), 0.0)
    return ChainSolution(z, multipliers, duals, max_iterations, False, f"no convergence in {max_iterations} iterations")


def _stationarity(
    problem: ChainProblem, z: Array, multipliers: Array, duals: Array, dynamics_jacobian: Array, jacobian: Array
) -> Array:
    """Gradient of the Lagrangian with respect to z."""
    gradient = problem.cost_gradient(z) - np.einsum("kc,kci->ki", duals, jacobian)
    gradient[:-1] += np.einsum("kn,kni->ki", multipliers[1:], dynamics_jacobian)
    gradient[:, : problem.state_dim] -= multipliers
    return gradient


def _multiplier_scale(multipliers: Array, duals: Array) -> float:
    mean = (np.abs(multipliers).sum() + np.abs(duals).sum()) / (multipliers.size + duals.size)
    return max(100.0, mean) / 100.0


def _merit(
    cost: float,
    slack: Array,
    defects: Array,
    gap: Array,
    active: NDArray[np.bool_],
    barrier: float,
    penalty: float,
) -> float:
    logarithms = np.log(slack, where=active, out=np.zeros_like(slack)).sum()
    return cost - barrier * logarithms + penalty * (np.abs(defects).sum() + np.abs(gap).sum())


def _to_boundary(value: Array, step: Array, active: NDArray[np.bool_]) -> float:
    """The longest step of at most 1 that leaves 0.5 % of every positive value."""
    shrinking = active & (step < 0)
    return float(min(1.0, (0.995 * value[shrinking] / -step[shrinking]).min(initial=np.inf)))


def _newton_step(
    hessian: Array, coupling: Array, dynamics_jacobian: Array, force: Array, target: Array
) -> tuple[Array, Array]:
    """Solve the condensed KKT system; unknowns per node are ordered [multiplier, state, control]."""
    nodes, n = target.shape
    width = force.shape[1]
    m, s = width - n, n + width
    own = np.zeros((nodes, s, s))
    own[:, n:, n:] = hessian
    index = np.arange(n)
    own[:, index, n + index] = own[:, n + index, index] = -1.0
    below = np.zeros((nodes - 1, s, s))  # rows of node k+1, columns of node k
    below[:, :n, n:] = dynamics_jacobian
    control = np.arange(s - m, s)
    below[:, control, control] = coupling
    band = np.zeros((2 * s + 1, nodes * s))
    row, column = np.indices((s, s))
    start = s * np.arange(nodes)[:, None, None]
    band[s + row - column, start + column] = own
    row, column = np.triu_indices(s)  # the rest of `below` is zero and outside the band
    start = s * np.arange(nodes - 1)[:, None]
    band[2 * s + row - column, start + column] = below[:, row, column]
    band[column - row, start + s + row] = below[:, row, column]
    right = np.concatenate([target, force], axis=1).ravel()
    try:
        solution = solve_banded((s, s), band, right, overwrite_ab=True, overwrite_b=True, check_finite=False)
    except np.linalg.LinAlgError:
        solution = np.full_like(right, np.nan)
    solution = solution.reshape(nodes, s)
    return solution[:, n:], solution[:, :n]
