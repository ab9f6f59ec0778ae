"""Axis-aligned boxes: the sets that go into a proof.

Everything here is float64 and exact or rounded outwards; see each function. Leading dimensions are batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import NonFiniteError, UsageError
from sagemp_cli.sets.rounding import round_down, round_up


@dataclass(frozen=True)
class Box:
    """The box ``Int(lower, upper) = {z | lower <= z <= upper}`` of the paper's section III.

    Attributes:
        lower: lower corners, shape ``(..., n)``, float64; ``-inf`` allowed only in goal boxes.
        upper: upper corners, same shape.
    """

    lower: Tensor
    upper: Tensor

    def __post_init__(self) -> None:
        lower = torch.as_tensor(self.lower, dtype=torch.float64)
        upper = torch.as_tensor(self.upper, dtype=torch.float64)
        if lower.shape != upper.shape:
            raise UsageError(f"box corners differ in shape: {tuple(lower.shape)} and {tuple(upper.shape)}")
        if bool(torch.isnan(lower).any() | torch.isnan(upper).any()):
            raise NonFiniteError("box corner is NaN; corners must be numbers")
        if bool((lower > upper).any()):
            worst = int((upper - lower).reshape(-1, lower.shape[-1]).amin(0).argmin())
            raise UsageError(f"box has negative width in dimension {worst}; lower must not exceed upper")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    @classmethod
    def around(cls, center: Sequence[float] | Tensor, radius: Sequence[float] | Tensor) -> Box:
        """The box ``center +- radius``, corners rounded outwards where the radius is not zero."""
        c = torch.as_tensor(center, dtype=torch.float64)
        r = torch.as_tensor(radius, dtype=torch.float64)
        if bool((r < 0).any()) or not bool(torch.isfinite(r).all()):
            raise UsageError(f"radius must be finite and not negative, found {r.tolist()}")
        if not bool(torch.isfinite(c).all()):
            raise NonFiniteError(f"box center must be finite, found {c.tolist()}")
        flat = r == 0
        return cls(torch.where(flat, c, round_down(c - r)), torch.where(flat, c, round_up(c + r)))

    @property
    def dim(self) -> int:
        """Number of dimensions n."""
        return self.lower.shape[-1]

    @property
    def has_faces(self) -> bool:
        """Whether it ends anywhere: whether a side of it is finite."""
        return bool((torch.isfinite(self.lower) | torch.isfinite(self.upper)).any())

    @property
    def center(self) -> Tensor:
        """A point of the box near its middle, ``(..., n)``."""
        return torch.minimum(torch.maximum(0.5 * self.lower + 0.5 * self.upper, self.lower), self.upper)

    @property
    def radius(self) -> Tensor:
        """An upper bound on ``|z - center|`` over the box, rounded up, ``(..., n)``."""
        c = self.center
        spread = torch.maximum(self.upper - c, c - self.lower)
        return torch.where(spread == 0, spread, round_up(spread))

    @property
    def width(self) -> Tensor:
        """``upper - lower`` (round to nearest), ``(..., n)``."""
        return self.upper - self.lower

    def contains(self, other: Box | Tensor) -> Tensor:
        """Whether points or boxes lie inside, exactly; shape is the broadcast batch shape."""
        low, high = (other.lower, other.upper) if isinstance(other, Box) else (other, other)
        return ((self.lower <= low) & (high <= self.upper)).all(-1)

    def split(self, counts: Sequence[int]) -> Box:
        """Uniform partition into ``prod(counts)`` cells, shape ``(cells, n)``; neighbours share faces exactly.

        The cells cover the box without gaps: outer faces are the box's own corners and inner faces are
        the same floating-point numbers on both sides.
        """
        if self.lower.dim() != 1:
            raise UsageError("only a single box can be split")
        if len(counts) != self.dim or any(int(c) < 1 for c in counts):
            raise UsageError(f"partition counts must be {self.dim} positive integers, found {list(counts)}")
        faces = []
        for low, high, count in zip(self.lower, self.upper, counts, strict=True):
            inner = low + (high - low) * (torch.arange(1, count, dtype=torch.float64) / count)
            cuts = torch.cat([low[None], inner.clamp(low, high), high[None]])
            faces.append((cuts[:-1], cuts[1:]))
        lowers = torch.cartesian_prod(*[f[0] for f in faces]).reshape(-1, self.dim)
        uppers = torch.cartesian_prod(*[f[1] for f in faces]).reshape(-1, self.dim)
        return Box(lowers, uppers)

    def hull(self, dim: int = 0) -> Box:
        """The smallest box that contains all boxes along a batch dimension."""
        return Box(self.lower.amin(dim), self.upper.amax(dim))

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Uniform samples ``(count, n)`` of a single box."""
        unit = torch.rand(count, self.dim, dtype=torch.float64, generator=generator)
        return torch.minimum(torch.maximum(self.lower + unit * self.width, self.lower), self.upper)
