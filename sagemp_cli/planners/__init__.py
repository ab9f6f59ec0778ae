"""Planners: what samples references, and how those that learn are trained."""

from sagemp_cli.planners.base import LearnedPlanner, Planner
from sagemp_cli.planners.neural_ode import NeuralODE
from sagemp_cli.planners.training import plan_figures, train_planner

__all__ = ["LearnedPlanner", "NeuralODE", "Planner", "plan_figures", "train_planner"]
