"""Algorithm 2 of the paper: sample references until enough of them are certified."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sagemp_cli.errors import EXIT_UNKNOWN, ConfigError, SagempError
from sagemp_cli.progress import Progress, Silent
from sagemp_cli.scenes.scene import Scene
from sagemp_cli.verification.verdict import Outcome
from sagemp_cli.verification.verification import Verification

REFERENCE_COLLIDES = "reference in collision"
REFERENCE_MISSES = "reference misses goal"
TUBE_COLLIDES = "tube in collision"
TUBE_MISSES = "tube misses goal"
TUBE_UNBOUNDED = "tube unbounded"
REASONS = (REFERENCE_COLLIDES, REFERENCE_MISSES, TUBE_COLLIDES, TUBE_MISSES, TUBE_UNBOUNDED)
"""Why a reference is not added to the library; the first two are found without propagating anything."""

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
        sampled: references drawn from the planner altogether; certified ones beyond the wanted number are
            neither in the library nor among the rejected.
    """

    certified: Verification
    rejected: Tensor
    reasons: tuple[str, ...]
    sampled: int

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
        progress: reports certified references.

    Raises:
        NothingCertifiedError: the budget ended without a single one.
    """
    if wanted < 1 or budget < wanted or batch < 1:
        raise ConfigError(
            f"library: size and batch must be positive and budget at least size, "
            f"found size {wanted}, batch {batch}, budget {budget}"
        )
    certified: list[Verification] = []
    rejected: list[Tensor] = []
    reasons: list[str] = []
    sampled = have = 0
    with (progress or Silent()).task("certified references", wanted) as task:
        while have < wanted and sampled < budget:
            references = draw(min(batch, budget - sampled))
            sampled += len(references)
            why = reference_faults(references, scene, position=position)
            sound = [r for r, reason in enumerate(why) if not reason]
            if sound:
                found = verify(references[sound])
                for r, verdict in zip(sound, found.verdicts, strict=True):
                    if verdict.outcome is not Outcome.SAFE:
                        why[r] = REASON_OF[verdict.outcome]
                safe = found.safe[: wanted - have]
                if safe:
                    certified.append(found.select(safe))
                have += len(safe)
                task.advance(len(safe), f"{sampled} of {budget} sampled")
            bad = [r for r, reason in enumerate(why) if reason]
            rejected.append(references[bad])
            reasons.extend(why[r] for r in bad)
    if not certified:
        why = ", ".join(f"{n} x {reason}" for reason, n in Counter(reasons).most_common())
        raise NothingCertifiedError(f"library: none of {sampled} sampled references could be certified ({why})")
    return Build(Verification.join(certified), torch.cat(rejected), tuple(reasons), sampled)


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
