"""Certified tracking of generative motion plans (SaGe-MP).

The package is layered and imports point downwards only, see ``docs/architecture.md``.
"""

__version__ = "0.1.0"
