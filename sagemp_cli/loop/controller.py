"""What steers the robot in a closed loop: any function of the state and of the next points of the reference."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor, nn

from sagemp_cli.errors import ConfigError

Precision = Literal["real", "float32"]
"""How a network is taken: as the real function of its numbers, or as float32 arithmetic evaluates it."""


class Controller(nn.Module, ABC):
    """``u_k = control([p_{k+1}, ..., p_{k+N}], x_k)``, written once in torch operations.

    The same function is simulated, trained, bounded by the propagators and carried by certificates, as the numbers that
    it holds and the operations that it does: there may be any batch in front of the dimensions that are said, and a
    value may only be looked at by torch operations. Weights that are parameters or buffers in float64 are stored and
    proved as the exact numbers that they are.

    Attributes:
        state_dim: number of states n.
        control_dim: number of controls m.
        lookahead: points of the reference that are seen, N.
        trains: whether training can change it; one that cannot is taken as it is.
    """

    state_dim: int
    control_dim: int
    lookahead: int
    trains: ClassVar[bool] = True

    @classmethod
    def taken(cls, **options: Any) -> Controller:
        """One that does not train, from the options of its section; where it needs a file, it reads it here.

        Only ``train-tracker`` calls this, for the person who runs it; what reads artifacts calls the constructor.
        """
        return cls(**options)

    def arguments(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """What its constructor is to be called with, to be the same again once its weights are loaded.

        Plain data, which an artifact keeps; of ``given``, what it was made from, everything by default.
        """
        return dict(given)

    def files(self) -> tuple[Path, ...]:
        """Files that it was made from."""
        return ()

    @abstractmethod
    def control(self, window: Tensor, x: Tensor) -> Tensor:
        """Controls ``(..., m)``.

        Args:
            window: the next points of the reference, ``(..., N, n)``.
            x: states, ``(..., n)``.
        """

    def control_range(self) -> tuple[Tensor, Tensor]:
        """What no control leaves in real arithmetic, ``(m,)`` each; infinite if nothing is known."""
        everywhere = torch.full((self.control_dim,), torch.inf, dtype=torch.float64)
        return -everywhere, everywhere


def check_precision(precision: str) -> None:
    """Refuse what is none of :data:`Precision`."""
    if precision not in get_args(Precision):
        raise ConfigError(f"tracker.precision must be one of {', '.join(get_args(Precision))}, found {precision!r}")


def rounded_range(scale: Tensor, offset: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """What ``h scale + offset`` does not leave in float32 arithmetic, for h in ``[-reach, reach]``; ``(m,)`` each.

    Both constants, the product and the sum are rounded once each, by at most ``2^-24`` of what it is.
    """
    size = scale.abs() * reach * (1 + 2.0**-22) + offset.abs() * 2.0**-22 + 2.0**-120
    return offset - size, offset + size


def scaled_in_float32(h: Tensor, scale: Tensor, offset: Tensor) -> Tensor:
    """``h scale + offset`` in float32, as float64; a factor of 1 and a term of 0, which change nothing, left out."""
    if not bool((scale == 1).all()):
        h = h * scale.float()
    if not bool((offset == 0).all()):
        h = h + offset.float()
    return h.double()


def lookahead_errors(window: Tensor, x: Tensor) -> Tensor:
    """The paper's ``e_k = [p_{k+1} - x_k, ..., p_{k+N} - x_k]``, ``(..., N, n)`` (equation 6)."""
    return window - x[..., None, :]
