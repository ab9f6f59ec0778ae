"""Libraries of certified references: Algorithm 2, the closest reference, the theorem's bound."""

from sagemp_cli.library.builder import REASONS, Build, Fill, build_library
from sagemp_cli.library.closest import closest_reference
from sagemp_cli.library.coverage import draws_needed, imitation_probability

__all__ = ["REASONS", "Build", "Fill", "build_library", "closest_reference", "draws_needed", "imitation_probability"]
