"""Doors for robots, planners, trackers, propagators and executors that are not part of this package.

A module of your own registers what it brings under a name, and configs use that name::

    from sagemp_cli.plugins import robot

    @robot("diffdrive")
    class DiffDrive(Dynamics): ...

It is found if it is named on the command line (``sagemp --plugin my_robot.py ...``), in the project's own
``conf/project.yaml`` (``plugins: [my_robot.py]``), or if an installed package declares it as an entry point
(``[project.entry-points."sagemp.robots"]``). Nothing that is read from an artifact ever names code to load.
"""

from sagemp_cli.plugins.registry import KINDS, Kind, executor, planner, propagator, robot, tracker
from sagemp_cli.plugins.stages import stage

__all__ = ["KINDS", "Kind", "executor", "planner", "propagator", "robot", "stage", "tracker"]
