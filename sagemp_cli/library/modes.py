"""Modes of references: on which side of each obstacle they pass, and which of them a library holds.

In the plane these are homotopy classes, in space directions of passing (:mod:`sagemp_cli.scenes.sides`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from sagemp_cli.scenes.scene import Scene
from sagemp_cli.scenes.sides import side_label, sides_of


def modes_of(references: Tensor, scene: Scene, *, position: tuple[int, ...]) -> tuple[str, ...]:
    """The mode of each reference ``(R, K+1, n)``, one letter per obstacle; empty in a scene without obstacles."""
    paths = references[..., list(position)].numpy()
    return tuple(side_label(sides_of(path, scene.obstacles), len(position)) for path in paths)


@dataclass(frozen=True)
class Coverage:
    """The modes that a planner proposes and those that a library holds.

    Attributes:
        names: modes, the most often proposed first.
        drawn: how often each was proposed, of references that are safe by themselves.
        held: entries of each.
    """

    names: tuple[str, ...]
    drawn: tuple[int, ...]
    held: tuple[int, ...]

    @classmethod
    def of(cls, drawn: Sequence[str], held: Sequence[str]) -> Coverage:
        """From the modes of all proposals that are safe by themselves, and of all entries."""
        proposed, kept = Counter(drawn), Counter(held)
        names = tuple(name for name, _ in proposed.most_common())
        return cls(names, tuple(proposed[name] for name in names), tuple(kept[name] for name in names))

    @property
    def missing(self) -> tuple[str, ...]:
        """Modes that the planner proposes and the library does not hold."""
        return tuple(name for name, held in zip(self.names, self.held, strict=True) if not held)

    def lines(self) -> list[str]:
        """In words: entries of each mode beside the planner's share, and what is missing."""
        if self.names in ((), ("",)):
            return []
        total = sum(self.drawn)
        shares = ", ".join(
            f"{name} {held} (planner {drawn / total:.0%})"
            for name, held, drawn in zip(self.names, self.held, self.drawn, strict=True)
        )
        lines = [f"modes: {shares}"]
        if self.missing:
            lines.append(
                f"the library holds none of {', '.join(self.missing)}, which the planner proposes; library.fill=modes "
                "fills mode by mode, a larger library.budget draws more"
            )
        return lines
