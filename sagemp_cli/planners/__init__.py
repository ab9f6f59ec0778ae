"""Planners: what samples references, and how those that learn are trained."""

from sagemp_cli.planners.base import LearnedPlanner, Planner, Proposer, SelfTaughtPlanner, StoredPlanner, affordable
from sagemp_cli.planners.diffusion import Diffusion
from sagemp_cli.planners.figures import open_loop_figures, plan_figures, side_shares
from sagemp_cli.planners.flow_matching import FlowMatching
from sagemp_cli.planners.from_file import FromFile
from sagemp_cli.planners.neural_ode import NeuralODE
from sagemp_cli.planners.training import PlannerTrainingOptions, train_planner

__all__ = [
    "Diffusion",
    "FlowMatching",
    "FromFile",
    "LearnedPlanner",
    "NeuralODE",
    "Planner",
    "PlannerTrainingOptions",
    "Proposer",
    "SelfTaughtPlanner",
    "StoredPlanner",
    "affordable",
    "open_loop_figures",
    "plan_figures",
    "side_shares",
    "train_planner",
]
