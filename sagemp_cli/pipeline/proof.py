"""How a config wants references proved: partition, memory, and where the work is done."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Gt, Interval, Predicate, doc
from torch import Tensor

from sagemp_cli.config.binding import Binding, build
from sagemp_cli.config.ranges import Count
from sagemp_cli.errors import ConfigError
from sagemp_cli.loop.controller import Controller
from sagemp_cli.problem import Problem
from sagemp_cli.progress import Progress
from sagemp_cli.reachability.flow import AskedDivision
from sagemp_cli.reachability.propagator import Propagator
from sagemp_cli.sets.partition import parse_partitions, uncertain_dimensions
from sagemp_cli.verification.cells import CellProver, Pieces
from sagemp_cli.verification.executors import Executor
from sagemp_cli.verification.memory import cells_within, footprint
from sagemp_cli.verification.verification import Verification, require_references, verify_references


def _power_of_two(count: int) -> bool:
    return count > 0 and count & (count - 1) == 0


@dataclass(frozen=True)
class ProofOptions:
    """The section ``proof``.

    Attributes:
        partitions: as :func:`~sagemp_cli.sets.partition.parse_partitions` reads it.
        budget: cells of one reference at most, with ``partitions: auto``.
        memory: of the results and of what is propagated at a time.
        substeps, order: in continuous time, how periods are divided and how far flows are expanded.
    """

    partitions: Any
    budget: Count
    memory: Annotated[float, Gt(0), doc("a positive number of GiB")]
    substeps: Annotated[int, Predicate(_power_of_two), doc("a power of two")] | Literal["auto"] = "auto"
    order: Annotated[int, Interval(ge=1, le=8), doc("a whole number from 1 to 8")] | Literal["auto"] = "auto"

    @property
    def division(self) -> AskedDivision:
        """The last two."""
        return AskedDivision(*(None if value == "auto" else value for value in (self.substeps, self.order)))


SECTION = Binding("proof", ProofOptions)


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
        compared: whether it is about the analytical model of a learned robot.
        division: in continuous time, how periods are to be divided.
    """

    problem: Problem
    propagator: Propagator
    executor: Executor
    counts: list[int] | None
    budget: int
    memory: float
    compared: bool = False
    division: AskedDivision = AskedDivision()

    @classmethod
    def of(cls, config: Mapping[str, Any], problem: Problem) -> Proof:
        """From sections ``proof``, ``propagator`` and ``executor``.

        Raises:
            ConfigError: a value that is not allowed.
        """
        options: ProofOptions = SECTION.made(config)
        return cls(
            problem=problem,
            propagator=build(config["propagator"], "propagator"),
            executor=build(config["executor"], "executor"),
            counts=counts_of(options.partitions, problem, "proof"),
            budget=options.budget,
            memory=options.memory,
            division=options.division,
        )

    def verify(
        self, references: Tensor, tracker: Controller, *, pieces: Pieces | None = None, progress: Progress | None = None
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
        prover = CellProver(self.propagator, problem, tracker, self.compared, self.division)
        found = footprint(prover, references[0])
        return verify_references(
            prover,
            references,
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


def counts_of(partitions: Any, problem: Problem, where: str) -> list[int] | None:
    """Cells per uncertain dimension of a problem, None for an adaptive partition; ``where`` names the section.

    Raises:
        ConfigError: what is no partition of it.
    """
    try:
        return parse_partitions(partitions, len(uncertain_dimensions(problem.start)), auto=True)
    except ConfigError as e:
        raise ConfigError(f"{where}.{e}") from None
