"""What ``verify`` proves, beside the learned robot's own verdict, of the analytical model that it was learned from."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from sagemp_cli.config.binding import Binding
from sagemp_cli.loop.controller import Controller
from sagemp_cli.pipeline.loop_record import deviation_record
from sagemp_cli.pipeline.proof import Proof, counts_of
from sagemp_cli.pipeline.tubes import tubes_record
from sagemp_cli.progress import Progress
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.storage import TrueModel
from sagemp_cli.verification.deviation import Folded, split


@dataclass(frozen=True)
class TrueModelProof:
    """A proof with the learned robot's deviation folded into w.

    Attributes:
        proof: of the same problem, with a propagator that folds and cells of its own.
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
        return cls(dataclasses.replace(proof, propagator=Folded(affine), counts=counts))

    def verify(self, references: Tensor, tracker: Controller, progress: Progress) -> TrueModel:
        """Tubes and verdicts of references ``(R, K+1, n)``, and how much was folded."""
        found = self.proof.verify(references, tracker, progress=progress)
        plain, deviation = split(found, self.proof.problem.dynamics.control_dim)
        return TrueModel(
            program=deviation_record(self.proof.problem, tracker),
            tubes=tubes_record(plain),
            deviation=deviation.numpy(),
        )


def _options(*, partitions: Any = None) -> None:
    """The options of the section: cells as ``proof.partitions`` has them, which is also the default."""


SECTION = Binding("verify.true_model", _options)
