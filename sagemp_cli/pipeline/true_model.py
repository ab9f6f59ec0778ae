"""What ``verify`` proves, beside the learned robot's own verdict, of the analytical model that it was learned from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sagemp_cli.config.binding import Binding
from sagemp_cli.loop.controller import Controller
from sagemp_cli.pipeline.loop_record import deviation_record
from sagemp_cli.pipeline.proof import Proof, counts_of
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.progress import Progress
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.storage import TrueModel
from sagemp_cli.verification.verification import Verification


@dataclass(frozen=True)
class TrueModelProof:
    """A proof with the learned robot's deviation folded into w, by forward affine arithmetic.

    Attributes:
        proof: of the same problem, about the analytical model, with cells of its own.
    """

    proof: Proof

    @classmethod
    def of(cls, config: Mapping[str, Any], proof: Proof) -> TrueModelProof:
        """From the section ``verify.true_model`` and the proof of the learned robot itself.

        Raises:
            ConfigError: an option or a partition that is not one.
        """
        partitions = SECTION.options(config).get("partitions")
        counts = proof.counts if partitions is None else counts_of(partitions, proof.problem, SECTION.where)
        affine = proof.propagator if isinstance(proof.propagator, Affine) else Affine()
        return cls(dataclasses.replace(proof, propagator=affine, counts=counts, compared=True))

    def verify(self, references: Tensor, tracker: Controller, progress: Progress) -> TrueModel:
        """Tubes and verdicts of references ``(R, K+1, n)``, and how much was folded."""
        found = self.proof.verify(references, tracker, progress=progress)
        plain, deviation = split(found, self.proof.problem.dynamics.control_dim)
        return TrueModel(
            program=deviation_record(self.proof.problem, tracker),
            tubes=tubes_record(plain),
            deviation=deviation.numpy(),
        )


def split(found: Verification, controls: int) -> tuple[Verification, Tensor]:
    """A verification about the analytical model as others are, and bounds of ``|e|`` over its tubes, ``(R, K, n)``."""
    lower, upper = found.control_lower, found.control_upper
    deviation = torch.maximum(-lower[..., controls:], upper[..., controls:])
    plain = dataclasses.replace(found, control_lower=lower[..., :controls], control_upper=upper[..., :controls])
    return plain, deviation


def _options(*, partitions: Any = None) -> None:
    """The options of the section: cells as ``proof.partitions`` has them, which is also the default."""


SECTION = Binding("verify.true_model", _options)
