"""What says that something could not be proved."""

from __future__ import annotations


class Unproved(Exception):
    """A part of the claim that could not be proved, in one line."""
