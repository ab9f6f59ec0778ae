"""The tracking policy, the paper's losses, and training."""

from sagemp_cli.trackers.policy import Tracker

__all__ = ["Tracker"]
