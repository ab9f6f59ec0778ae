"""Robot models: one module per robot, the Euler step written once in :mod:`sagemp_cli.dynamics.base`."""

from sagemp_cli.dynamics.base import Dynamics
from sagemp_cli.dynamics.kinematic_unicycle import KinematicUnicycle
from sagemp_cli.dynamics.planar_quadrotor import PlanarQuadrotor
from sagemp_cli.dynamics.quadrotor import Quadrotor
from sagemp_cli.dynamics.unicycle import Unicycle

__all__ = ["Dynamics", "KinematicUnicycle", "PlanarQuadrotor", "Quadrotor", "Unicycle"]
