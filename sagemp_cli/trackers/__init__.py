"""The tracking policy, the paper's losses, and training."""

from sagemp_cli.loop.tracker import Tracker

__all__ = ["Tracker"]
