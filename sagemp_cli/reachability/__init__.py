"""Reachability: propagators, relaxations, partitions, verdicts.

:func:`~sagemp_cli.reachability.any_loop.reach` bounds any closed loop that is written in torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sagemp_cli.reachability.any_loop import reach

__all__ = ["reach"]


def __getattr__(name: str) -> Any:
    # Imported when asked for: most of this package's modules need neither torch's functions table nor the propagators.
    if name == "reach":
        from sagemp_cli.reachability.any_loop import reach

        return reach
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
