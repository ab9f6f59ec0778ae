"""Sets of states: boxes, tubes, partitions, and how rounding is kept account of."""

from sagemp_cli.sets.between import PARTS, Between, Bulge, over_steps
from sagemp_cli.sets.box import Box
from sagemp_cli.sets.rounding import round_down, round_up
from sagemp_cli.sets.tube import Tube

__all__ = ["PARTS", "Between", "Box", "Bulge", "Tube", "over_steps", "round_down", "round_up"]
