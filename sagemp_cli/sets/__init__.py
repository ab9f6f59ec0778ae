"""Sets of states: boxes, tubes, partitions, and how rounding is kept account of."""

from sagemp_cli.sets.box import Box
from sagemp_cli.sets.rounding import round_down, round_up
from sagemp_cli.sets.tube import Tube

__all__ = ["Box", "Tube", "round_down", "round_up"]
