"""Ranges of numbers for the signatures of what a config configures; :mod:`.binding` checks them and says them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Interval, MinLen

Count = Annotated[int, Ge(1)]
"""A whole number of at least 1."""
Whole = Annotated[int, Ge(0)]
"""A whole number of at least 0."""
Positive = Annotated[float, Gt(0)]
"""A positive number."""
NonNegative = Annotated[float, Ge(0)]
"""A number of at least 0."""


@dataclass(frozen=True)
class OrInfinite:
    """Beside a range: infinity is in it. Numbers are finite otherwise."""


Share = Annotated[float, Interval(ge=0, le=1)]
"""A number in [0, 1]."""
Part = Annotated[float, Interval(gt=0, le=1)]
"""A number in (0, 1]."""
Fraction = Annotated[float, Interval(gt=0, lt=1)]
"""A number in (0, 1)."""
Decay = Annotated[float, Interval(ge=0, lt=1)]
"""A number in [0, 1)."""
Widths = Annotated[list[Count], MinLen(1)]
"""Widths of layers: at least one, each at least 1."""
