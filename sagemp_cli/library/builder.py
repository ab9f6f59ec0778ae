"""Algorithm 2 of the paper: sample references until enough of them are certified.

Two things are added to it. An entry that repeats another one is worth nothing: references closer than a stated
distance to one that is held are not taken. And a library may be filled mode by mode (:mod:`sagemp_cli.library.modes`):
as long as its planner proposes several, none takes more than its even share.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

from sagemp_cli.errors import EXIT_UNKNOWN, ConfigError, SagempError
from sagemp_cli.library.modes import Coverage, modes_of
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.verification.verdict import Outcome
from sagemp_cli.verification.verification import Verification

REFERENCE_COLLIDES = "reference in collision"
REFERENCE_MISSES = "reference misses goal"
TUBE_COLLIDES = "tube in collision"
TUBE_MISSES = "tube misses goal"
TUBE_UNBOUNDED = "tube unbounded"
DUPLICATE = "duplicate of an entry"
REASONS = (REFERENCE_COLLIDES, REFERENCE_MISSES, TUBE_COLLIDES, TUBE_MISSES, TUBE_UNBOUNDED, DUPLICATE)
"""Why a reference is not added to the library; the first two are found without propagating anything."""


class Fill(StrEnum):
    """Which certified references are taken."""

    FIRST = "first"
    """The first ones, as in the paper."""
    MODES = "modes"
    """Of each mode that the planner proposes as many, as far as there are."""


REASON_OF = {
    Outcome.MAY_COLLIDE: TUBE_COLLIDES,
    Outcome.MISSES_GOAL: TUBE_MISSES,
    Outcome.UNBOUNDED: TUBE_UNBOUNDED,
}
"""The reason that an outcome of a proof is."""


class NothingCertifiedError(SagempError):
    """The budget ended before a single reference was certified; there is no library to write."""

    exit_code = EXIT_UNKNOWN


@dataclass(frozen=True)
class Build:
    """What Algorithm 2 returns, with an account of what it threw away.

    Attributes:
        certified: the library, at least one and at most the wanted number of references.
        rejected: references that were not certified, ``(rejected, K+1, n)``.
        reasons: why, one of :data:`REASONS` each.
        sampled: references drawn from the planner altogether; what was not needed is neither in the library nor
            among the rejected.
        modes: of each entry.
        coverage: the modes proposed and those held.
    """

    certified: Verification
    rejected: Tensor
    reasons: tuple[str, ...]
    sampled: int
    modes: tuple[str, ...]
    coverage: Coverage

    @property
    def counts(self) -> tuple[int, ...]:
        """How often each of :data:`REASONS` occurred."""
        found = Counter(self.reasons)
        return tuple(found[reason] for reason in REASONS)


def build_library(
    draw: Callable[[int], Tensor],
    verify: Callable[[Tensor], Verification],
    *,
    scene: Scene,
    position: tuple[int, ...],
    wanted: int,
    budget: int,
    batch: int = 8,
    apart: float = 0.0,
    fill: Fill = Fill.FIRST,
    progress: Progress | None = None,
) -> Build:
    """Draw references in batches, reject or certify them, stop at ``wanted`` certified ones or at the budget.

    Args:
        draw: ``draw(count)`` samples references ``(count, K+1, n)`` from the planner, independently.
        verify: proves what it can about references ``(R, K+1, n)``.
        scene: for the check of the reference itself (paper: tau_k in S for all k, tau_K in X_G).
        position: indices of the states that are the position.
        wanted: library size C.
        budget: references drawn at most.
        batch: references per draw, verified in one call.
        apart: references whose positions are at every step closer than this to those of an entry repeat it.
        fill: which certified references are taken. With ``MODES`` those of a mode that has its even share of the
            modes seen so far are set aside; when the budget is over, what is left of the size is filled from them.
        progress: reports certified references.

    Raises:
        NothingCertifiedError: the budget ended without a single one.
    """
    if wanted < 1 or budget < wanted or batch < 1:
        raise ConfigError(
            f"library: size and batch must be positive and budget at least size, "
            f"found size {wanted}, batch {batch}, budget {budget}"
        )
    work = _Library(verify, list(position), wanted, apart)
    drawn: list[str] = []
    aside: list[tuple[Tensor, str]] = []
    sampled = 0
    with (progress or Silent()).task("certified references", wanted) as task:
        while work.room and sampled < budget:
            references = draw(min(batch, budget - sampled))
            sampled += len(references)
            why = reference_faults(references, scene, position=position)
            work.reject(references[[r for r, reason in enumerate(why) if reason]], [reason for reason in why if reason])
            sound = references[[r for r, reason in enumerate(why) if not reason]]
            modes = modes_of(sound, scene, position=position)
            drawn += modes
            share = wanted if fill is Fill.FIRST else -(-wanted // max(1, len(set(drawn))))
            task.advance(work.take(sound, modes, aside, share), f"{sampled} of {budget} sampled")
        while work.room and aside:  # the even shares were not to be had
            some, aside = aside[:batch], aside[batch:]
            task.advance(work.take(torch.stack([r for r, _ in some]), [m for _, m in some], [], wanted))
    if not work.certified:
        why = ", ".join(f"{n} x {reason}" for reason, n in Counter(work.reasons).most_common())
        raise NothingCertifiedError(f"library: none of {sampled} sampled references could be certified ({why})")
    return Build(
        Verification.join(work.certified),
        torch.cat(work.rejected),
        tuple(work.reasons),
        sampled,
        tuple(work.modes),
        Coverage.of(drawn, work.modes),
    )


class _Library:
    """What is certified and what is rejected so far."""

    def __init__(
        self, verify: Callable[[Tensor], Verification], position: list[int], wanted: int, apart: float
    ) -> None:
        self.verify, self.position, self.wanted, self.apart = verify, position, wanted, apart
        self.certified: list[Verification] = []
        self.modes: list[str] = []
        self.rejected: list[Tensor] = []
        self.reasons: list[str] = []
        self.paths: list[Tensor] = []

    @property
    def room(self) -> int:
        return self.wanted - len(self.modes)

    def reject(self, references: Tensor, reasons: Sequence[str]) -> None:
        self.rejected.append(references)
        self.reasons += reasons

    def take(self, references: Tensor, modes: Sequence[str], aside: list[tuple[Tensor, str]], share: int) -> int:
        """Prove those that may be taken, take those that are proved; how many those are."""
        asked: list[int] = []
        for r, mode in enumerate(modes):
            if self._repeats(references[r]):
                self.reject(references[r : r + 1], [DUPLICATE])
            elif self.modes.count(mode) >= share:
                aside.append((references[r], mode))
            else:
                asked.append(r)
        if not asked:
            return 0
        found, taken = self.verify(references[asked]), list[int]()
        for i, (r, verdict) in enumerate(zip(asked, found.verdicts, strict=True)):
            if verdict.outcome is not Outcome.SAFE:
                self.reject(references[r : r + 1], [REASON_OF[verdict.outcome]])
            elif self._repeats(references[r]):
                self.reject(references[r : r + 1], [DUPLICATE])
            elif self.room and self.modes.count(modes[r]) < share:
                taken.append(i)
                self.modes.append(modes[r])
                self.paths.append(references[r][:, self.position])
            elif self.room:
                aside.append((references[r], modes[r]))
        if taken:
            self.certified.append(found.select(taken))
        return len(taken)

    def _repeats(self, reference: Tensor) -> bool:
        """Whether it is at every step closer than ``apart`` to an entry."""
        if not self.paths or not self.apart:
            return False
        gap = torch.linalg.vector_norm(torch.stack(self.paths) - reference[:, self.position], dim=-1)
        return bool((gap.amax(-1) < self.apart).any())


def reference_faults(references: Tensor, scene: Scene, *, position: tuple[int, ...]) -> list[str]:
    """Why each reference ``(R, K+1, n)`` is out already by itself, or an empty string.

    The straight lines from each state to the next are checked, as the robot's are.
    """
    clear = (scene.signed_distance_along(references[..., list(position)]) > 0).all(-1)
    reaches = scene.goal.contains(references[:, -1])
    return [
        REFERENCE_COLLIDES if not c else REFERENCE_MISSES if not g else ""
        for c, g in zip(clear.tolist(), reaches.tolist(), strict=True)
    ]
