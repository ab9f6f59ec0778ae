"""How a config wants references proved: partition, memory, and where the work is done."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from sagemp_cli.config.binding import build
from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.tracker import Tracker
from sagemp_cli.pipeline.options import number_complaints
from sagemp_cli.progress import Progress
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.sets.partition import parse_partitions, uncertain_dimensions
from sagemp_cli.verification.cells import CellProver, Pieces
from sagemp_cli.verification.executors import Executor
from sagemp_cli.verification.memory import cells_within, footprint
from sagemp_cli.verification.problem import Problem
from sagemp_cli.verification.verification import Verification, require_references, verify_references


@dataclass(frozen=True)
class Proof:
    """What ``verify`` and ``build-library`` do alike.

    Attributes:
        problem: what is proved.
        propagator: bounds the loop.
        executor: where.
        counts: cells per uncertain dimension, None for an adaptive partition.
        budget: cells of one reference at most, in an adaptive partition.
        memory: GiB.
    """

    problem: Problem
    propagator: Propagator
    executor: Executor
    counts: list[int] | None
    budget: int
    memory: float

    @classmethod
    def of(cls, config: Mapping[str, Any], problem: Problem) -> Proof:
        """From sections ``verify``, ``propagator`` and ``executor``.

        Raises:
            ConfigError: a value that is not allowed.
        """
        section = config["verify"]
        complaints = partition_complaints(section, len(uncertain_dimensions(problem.start)))
        if complaints:
            raise ConfigError("; ".join(complaints))
        return cls(
            problem=problem,
            propagator=build(config["propagator"], "propagator"),
            executor=build(config["executor"], "executor"),
            counts=parse_partitions(section["partitions"], len(uncertain_dimensions(problem.start)), auto=True),
            budget=section["budget"],
            memory=float(section["memory"]),
        )

    def verify(
        self, references: Tensor, tracker: Tracker, *, pieces: Pieces | None = None, progress: Progress | None = None
    ) -> Verification:
        """Tubes and verdicts of references ``(R, K+1, n)``.

        Raises:
            ConfigError: the references have another horizon.
            ResourceError: the memory budget is too small.
        """
        problem, steps = self.problem, references.shape[1] - 1
        require_references(references, problem.dynamics)
        if steps != problem.horizon:
            raise ConfigError(f"horizon is {problem.horizon}, but the planner's references have {steps} steps")
        prover = CellProver(self.propagator, problem.dynamics, tracker, problem.disturbance)
        found = footprint(prover, references[0], problem.start)
        return verify_references(
            self.propagator,
            problem.dynamics,
            tracker=tracker,
            scene=problem.scene,
            references=references,
            start=problem.start,
            disturbance=problem.disturbance,
            counts=self.counts,
            budget=self.budget,
            cells_at_once=cells_within(self.memory, self._most(len(references)), found, self.propagator),
            executor=self.executor,
            pieces=pieces,
            progress=progress,
        )

    def _most(self, references: int) -> int:
        """Cells that are there at the same time at most; of an adaptive partition with all trials of its last round."""
        if self.counts is not None:
            return references * math.prod(self.counts)
        trials = len(uncertain_dimensions(self.problem.start)) * self.budget
        return references * (self.budget + trials)


def partition_complaints(section: Mapping[str, Any], uncertain: int) -> list[str]:
    """What is wrong with ``partitions``, ``budget`` and ``memory`` of the section ``verify``."""
    found = []
    try:
        parse_partitions(section["partitions"], uncertain, auto=True)
    except ConfigError as e:
        found.append(f"verify.{e}")
    found += number_complaints(section, "verify", budget=1)
    memory = section["memory"]
    if not isinstance(memory, int | float) or isinstance(memory, bool) or not 0 < memory < float("inf"):
        found.append(f"verify.memory must be a positive number of GiB, found {memory!r}")
    return found
