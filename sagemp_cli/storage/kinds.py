"""The kinds of artifact: one record class each. ``docs/artifacts.md`` describes them in prose.

Dimensions: ``count`` demonstrations or references, ``K`` steps, ``n`` states, ``m`` controls, ``cells`` of all
partitions together, ``rollouts`` simulated runs, ``bins`` of a histogram. Arrays are time first after the count.
Numbers are finite but where ``finite=False`` says otherwise: bounds that overflowed are infinite, figures that were
not measured NaN.

Longer than other files, since every kind is declared here: what a file may hold is to be read in one place.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from sagemp_cli.errors import ConfigError
from sagemp_cli.plugins.stages import own_stages
from sagemp_cli.storage.record import array, group, scalar, texts, weights


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Expert trajectories of trajectory optimisation, exactly feasible (made by ``gen-data``)."""

    states: np.ndarray = array("count K+1 n", "states of the rollout of the stored controls")
    controls: np.ndarray = array("count K m", "controls")
    problem: np.ndarray = array("count", "index of the problem; one problem may have several solutions", dtype="int64")
    side: tuple[str, ...] = texts("count", "side on which each obstacle is passed, e.g. 'LR'")
    cost: np.ndarray = array("count", "optimised cost")
    optimality: np.ndarray = array("count", "norm of the projected gradient of the problem at the solution")
    control_violation: np.ndarray = array("count", "largest excess over a control limit")
    state_violation: np.ndarray = array("count", "largest excess over a state limit")
    clearance: np.ndarray = array("count", "smallest signed distance to obstacles and workspace", units="m")
    goal_error: np.ndarray = array("count", "distance of the final position from the goal's centre", units="m")
    iterations: np.ndarray = array("count", "solver iterations", dtype="int64")
    seconds: np.ndarray = array("count", "solver time", units="s")
    failed: tuple[str, ...] = texts("failures", "one line for each problem that was not solved: index and reason")


@dataclass(frozen=True, kw_only=True)
class TrainingCurve:
    """Losses over training steps."""

    step: np.ndarray = array("points", "training step", dtype="int64")
    names: tuple[str, ...] = texts("figures", "names of the figures")
    values: np.ndarray = array("points figures", "figures; NaN where one was not measured at that step", finite=False)


@dataclass(frozen=True, kw_only=True)
class PlannerModel:
    """A trained generative planner (made by ``train-planner``); built from the config's ``planner`` section."""

    weights: dict[str, np.ndarray] = weights("parameters and buffers")
    arguments: str = scalar("constructor arguments that came from the data, as JSON")
    curve: TrainingCurve = group(TrainingCurve, "training and validation curve")
    figure_names: tuple[str, ...] = texts("report", "model card: names of the figures")
    figures: np.ndarray = array("report", "model card: values, e.g. open-loop safety rate", finite=False)


@dataclass(frozen=True, kw_only=True)
class TrackerModel:
    """A trained tracking policy (made by ``train-tracker``)."""

    weights: dict[str, np.ndarray] = weights("parameters and buffers")
    arguments: str = scalar("constructor arguments, as JSON")
    curve: TrainingCurve = group(TrainingCurve, "training curve")
    figure_names: tuple[str, ...] = texts("report", "model card: names of the figures")
    figures: np.ndarray = array("report", "model card: values, e.g. tracking error", finite=False)


@dataclass(frozen=True, kw_only=True)
class DynamicsModel:
    """A learned robot model (made by ``train-dynamics``); built from the config's ``dynamics`` section."""

    weights: dict[str, np.ndarray] = weights("parameters, in the robot's units")
    curve: TrainingCurve = group(TrainingCurve, "training and validation curve")
    figure_names: tuple[str, ...] = texts("report", "model card: names of the figures")
    figures: np.ndarray = array("report", "model card: values", finite=False)
    error_rms: np.ndarray = array("n", "root mean square error of each state's derivative on unseen transitions")
    error_max: np.ndarray = array("n", "largest error of each state's derivative on unseen transitions")
    error_edges: np.ndarray = array("n bins+1", "edges of the bins of 'error_counts'")
    error_counts: np.ndarray = array("n bins", "unseen transitions whose error lies in each bin", dtype="int64")


@dataclass(frozen=True, kw_only=True)
class ProgramRecord:
    """A step of a closed loop as instructions (see ``docs/program.md``); instruction i makes slot i."""

    kinds: tuple[str, ...] = texts("instructions", "what each instruction does")
    sizes: np.ndarray = array("instructions", "entries of each result", dtype="int64")
    operand_begin: np.ndarray = array(
        "instructions+1", "where each instruction's part of 'operands' begins", dtype="int64"
    )
    operands: np.ndarray = array("reads", "slots that are read", dtype="int64")
    number_begin: np.ndarray = array(
        "instructions+1", "where each instruction's part of 'numbers' begins", dtype="int64"
    )
    numbers: np.ndarray = array("numbers", "constants, exact; limits of a clamp may be infinite", finite=False)
    index_begin: np.ndarray = array(
        "instructions+1", "where each instruction's part of 'indices' begins", dtype="int64"
    )
    indices: np.ndarray = array("indices", "entries that are picked", dtype="int64")
    outputs: np.ndarray = array("outputs", "slots of next state, control and deviation (-1: none)", dtype="int64")


@dataclass(frozen=True, kw_only=True)
class LoopRecord:
    """The closed loop that a claim is about (see ``docs/certificates.md``)."""

    programs: tuple[ProgramRecord, ...] = group(ProgramRecord, "the step, one program or several", many=True)
    step_program: np.ndarray = array("K", "which of the programs each step is", dtype="int64")
    lookahead: int = scalar("numbers of a step: the next so many states of the reference; 0: none")
    state_names: tuple[str, ...] = texts("n", "names of the states")
    state_units: tuple[str, ...] = texts("n", "their units")
    control_names: tuple[str, ...] = texts("m", "names of the controls")
    control_units: tuple[str, ...] = texts("m", "their units")
    position: np.ndarray = array("p", "states that are the position in the scene", dtype="int64")
    dt: float | None = scalar(
        "time between two samples; said, not proved, but in continuous time, where it is part of the claim",
        units="s",
        optional=True,
    )
    lag: np.ndarray | None = array(
        "lags sides",
        "in continuous time: least and most of the control's delay and of its measurement's jitter",
        units="s",
        optional=True,
    )
    rate: ProgramRecord | None = group(
        ProgramRecord,
        "in continuous time x' - w, of the state and, as numbers, the control, which 'programs' is then",
        optional=True,
    )


@dataclass(frozen=True, kw_only=True)
class Relaxations:
    """The relaxations of a proof, from which it can be done again (see ``docs/certificates.md``)."""

    slope: np.ndarray = array("cells K entries", "slope of each line (scale of a product)", finite=False)
    offset: np.ndarray = array("cells K entries", "offset of each line", finite=False)
    radius: np.ndarray = array("cells K entries", "greatest distance of the function from the line", finite=False)
    kept: np.ndarray | None = array(
        "cells K bytes", "which generators were kept after each step, one bit each", dtype="uint8", optional=True
    )


@dataclass(frozen=True, kw_only=True)
class FlowBounds:
    """What is proved of a loop in continuous time within its periods (see ``docs/continuous_time.md``).

    A cell has a division of its own; S is the most parts that any has, and the rest of the others is 0.
    """

    substeps: np.ndarray = array("cells", "equal parts that a period is cut into", dtype="int64")
    order: np.ndarray = array("cells", "degree of the Taylor polynomials, p", dtype="int64")
    inner_lower: np.ndarray = array(
        "cells K S-1 n", "lower bounds of the states where parts 2 to S of a period begin", finite=False
    )
    inner_upper: np.ndarray = array(
        "cells K S-1 n", "upper bounds of the states where parts 2 to S of a period begin", finite=False
    )
    lower: np.ndarray = array(
        "cells K S n", "lower corners of boxes that no solution leaves within a part", finite=False
    )
    upper: np.ndarray = array(
        "cells K S n", "upper corners of boxes that no solution leaves within a part", finite=False
    )
    remainder_lower: np.ndarray = array(
        "cells K S n", "lower bounds of what the polynomial of a part leaves out", finite=False
    )
    remainder_upper: np.ndarray = array(
        "cells K S n", "upper bounds of what the polynomial of a part leaves out", finite=False
    )
    curve: np.ndarray = array(
        "cells K S n",
        "bounds of h^2 / 2 times the size of x'' under a constant disturbance, h the length of a part",
        finite=False,
    )
    drift: np.ndarray = array(
        "cells K S n", "how far a solution is from that under a mean of w, beside the integrals of both", finite=False
    )
    jump: np.ndarray | None = array(
        "cells K S n",
        "of a control that lags, bounds of how much it changes the rate at the beginning of a part",
        finite=False,
        optional=True,
    )
    measured_lower: np.ndarray | None = array(
        "cells K n", "of a control that lags, lower bounds of what is left out of the state that was measured",
        finite=False, optional=True,
    )  # fmt: skip
    measured_upper: np.ndarray | None = array(
        "cells K n", "of a control that lags, upper bounds of what is left out of the state that was measured",
        finite=False, optional=True,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Tubes:
    """References, their tubes and the verdicts (the body of ``verify``'s certificate and of a library)."""

    references: np.ndarray | None = array(
        "count K+1 n", "references from the planner, fixed in the proof; a loop may have none", optional=True
    )
    start_lower: np.ndarray = array("count n", "lower corner of X_I")
    start_upper: np.ndarray = array("count n", "upper corner of X_I")
    disturbance_lower: np.ndarray = array("d", "lower corner of W")
    disturbance_upper: np.ndarray = array("d", "upper corner of W")
    cell_reference: np.ndarray = array("cells", "index of the reference that each cell belongs to", dtype="int64")
    cell_lower: np.ndarray = array("cells n", "lower corners of the partition's cells")
    cell_upper: np.ndarray = array("cells n", "upper corners of the partition's cells")
    tube_lower: np.ndarray = array("cells K+1 n", "lower bounds of the reach set of each cell and step", finite=False)
    tube_upper: np.ndarray = array("cells K+1 n", "upper bounds of the reach set of each cell and step", finite=False)
    control_lower: np.ndarray = array("count K m", "lower bounds of the controls over all cells", finite=False)
    control_upper: np.ndarray = array("count K m", "upper bounds of the controls over all cells", finite=False)
    verdict: tuple[str, ...] = texts("count", "SAFE, MAY_COLLIDE, MISSES_GOAL, MAY_VIOLATE, UNBOUNDED or UNSAFE")
    step: np.ndarray = array("count", "step that decided the verdict (-1: none, SAFE)", dtype="int64")
    fraction: np.ndarray = array("count", "part of that step that was over when it was decided, 0 or more, below 1")
    constraint: tuple[str, ...] = texts("count", "obstacle, workspace or goal dimension that decided ('' if SAFE)")
    constraint_names: tuple[str, ...] = texts("constraints", "names of the constraints of 'clearance'")
    clearance: np.ndarray = array(
        "count constraints",
        "smallest certified distance to each constraint over all of the time (m), or margin of each requirement",
        finite=False,
    )
    goal_margin: np.ndarray = array(
        "count n", "distance of the tube at K from the goal's faces (negative: outside)", finite=False
    )
    seconds: np.ndarray = array("count", "share of the proof time", units="s")
    propagator: str = scalar("propagator that made the tubes")
    rigorous: bool = scalar("whether rounding is included in the tubes")
    between: str = scalar(
        "'segments': the safe set is kept over the whole of every step; 'samples': at samples only; 'continuous': at "
        "all times, by every solution of an ODE"
    )
    parts: int = scalar(
        "parts of a step, or in continuous time of a part of a period, that were checked one by one; 1 with 'samples'"
    )
    relaxations: Relaxations | None = group(Relaxations, "what the proof can be done again from", optional=True)
    flow: FlowBounds | None = group(FlowBounds, "in continuous time, what is proved between the samples", optional=True)


@dataclass(frozen=True, kw_only=True)
class RequirementRecord:
    """What has to hold of the state at all times of an interval (see ``docs/certificates.md``)."""

    name: str = scalar("what it is called; said, not proved")
    margins: ProgramRecord = group(ProgramRecord, "of the state: its output 'control' must not be negative")
    every: bool = scalar("whether all margins must hold, or at each time one of them at least")
    strict: bool = scalar("whether a margin must be above 0, or 0 will do")
    first: float = scalar("when it has to hold from on, in periods, 0 to K")
    last: float = scalar("up to when, included, likewise")


@dataclass(frozen=True, kw_only=True)
class Counterexample:
    """A replayed rollout that violates the claim."""

    reference: int = scalar("index of the reference")
    kind: str = scalar("'collision', 'workspace', 'goal' or 'requirement'")
    step: int = scalar("step of the violation")
    fraction: float = scalar("part of that step that is over at the violation, 0 or more, below 1")
    constraint: str = scalar("obstacle, 'workspace', goal dimension or requirement")
    depth: float = scalar("depth of the violation (> 0)")
    states: np.ndarray = array("K+1 n", "replayed states")
    disturbances: np.ndarray = array(
        "signal unknowns",
        "disturbances of all steps, in continuous time of equally many equal pieces of each period; of a control that "
        "lags also the seconds of its delay and its measurement's jitter",
    )


@dataclass(frozen=True, kw_only=True)
class TrueModel:
    """What is proved of the analytical model that a learned one stands for (see ``docs/certificates.md``)."""

    program: ProgramRecord = group(ProgramRecord, "its step, by way of the learned one")
    tubes: Tubes = group(Tubes, "references, cells, tubes and verdicts of the analytical model")
    deviation: np.ndarray = array(
        "count K n", "bound of the learned model's deviation at each step, which w is enlarged by", finite=False
    )


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Further plans of the planner, of which the certificate says how many could be certified and proves nothing."""

    drawn: int = scalar("plans drawn, from starts as those of a library")
    certified: int = scalar("how many of them 'affine' certified, from all of X_I")
    seed: int = scalar("what they were drawn with")


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What ``verify`` proved, with everything that the proof speaks about."""

    tubes: Tubes = group(Tubes, "references, cells, tubes and verdicts")
    loop: LoopRecord = group(LoopRecord, "the closed loop that this is about")
    counterexamples: tuple[Counterexample, ...] = group(Counterexample, "replayed counterexamples", many=True)
    falsifier_rollouts: int = scalar("rollouts that the falsifier tried")
    verdict: str = scalar("VERIFIED, FALSIFIED or UNKNOWN for all references together")
    true_model: TrueModel | None = group(
        TrueModel, "of a learned robot: what holds of its analytical model", optional=True
    )
    requirements: tuple[RequirementRecord, ...] | None = group(
        RequirementRecord, "of a loop in continuous time, what has to hold beside a scene", many=True, optional=True
    )
    samples: Samples | None = group(
        Samples, "further plans, if any were drawn: said by whoever made the file, not proved", optional=True
    )


@dataclass(frozen=True, kw_only=True)
class Library:
    """Certified references (Algorithm 2, made by ``build-library``)."""

    tubes: Tubes = group(Tubes, "the certified references only")
    loop: LoopRecord = group(LoopRecord, "the closed loop that this is about")
    rejected_references: np.ndarray = array("rejected K+1 n", "references that were not certified", finite=False)
    rejected_reason: tuple[str, ...] = texts("rejected", "why each was rejected")
    reason_names: tuple[str, ...] = texts("reasons", "reasons of rejection")
    reason_counts: np.ndarray = array("reasons", "how often each occurred", dtype="int64")
    sampled: int = scalar("references sampled altogether")
    wanted: int = scalar("certified references asked for, C")
    mode: tuple[str, ...] = texts("count", "side on which each reference passes each obstacle, e.g. 'LR'")
    mode_names: tuple[str, ...] = texts("modes", "modes that the planner proposed, the most often proposed first")
    mode_drawn: np.ndarray = array(
        "modes", "how often each was proposed, of references that are safe by themselves", dtype="int64"
    )


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """Executions of Algorithm 3 (made by ``execute``)."""

    sampled_references: np.ndarray = array("queries K+1 n", "what the planner proposed at run time")
    chosen: np.ndarray = array("queries", "index of the closest certified reference in the library", dtype="int64")
    reference_error: np.ndarray = array("queries", "distance E_tau of the paper's equation 10 to the chosen one")
    query: np.ndarray = array("rollouts", "query that each rollout belongs to", dtype="int64")
    states: np.ndarray = array("rollouts K+1 n", "executed states")
    controls: np.ndarray = array("rollouts K m", "executed controls")
    disturbances: np.ndarray = array(
        "rollouts K unknowns",
        "disturbances; of a control that lags also the seconds of its delay and its measurement's jitter",
    )
    in_tube: np.ndarray = array("rollouts", "whether the whole rollout stayed in its tube", dtype="bool")
    safe: np.ndarray = array(
        "rollouts", "whether it stayed in the safe set over the whole of every step and reached the goal", dtype="bool"
    )


@dataclass(frozen=True, kw_only=True)
class Trials:
    """Rollouts of references, executed in one way."""

    clearance: np.ndarray = array(
        "count kinds rollouts",
        "smallest signed distance to obstacles and workspace over the whole of all steps",
        units="m",
        finite=False,
    )
    reached: np.ndarray = array("count kinds rollouts", "whether the state at step K was in the goal", dtype="bool")
    nearest: np.ndarray = array(
        "count kinds K+1 n", "states of the rollout of the least clearance among equals", finite=False
    )


@dataclass(frozen=True, kw_only=True)
class SafetyRates:
    """How many references are safe open loop, under the tracker, and certified (made by ``safety-rates``)."""

    references: np.ndarray = array("count K+1 n", "references sampled from the planner")
    controls: np.ndarray = array("count K m", "controls recovered from each reference by the dynamics' inverse")
    residual: np.ndarray = array(
        "count n", "root mean square over the steps of the slope of each state that these controls do not make, per s"
    )
    disturbances: tuple[str, ...] = texts("kinds", "kinds of disturbances: none, random, worst case")
    open_loop: Trials = group(Trials, "the controls played back")
    closed_loop: Trials = group(Trials, "the references tracked")
    verdict: tuple[str, ...] = texts("count", "of the proof over all of X_I: SAFE (certified) or why it is not")
    step: np.ndarray = array("count", "step that decided the verdict (-1: none, SAFE)", dtype="int64")
    fraction: np.ndarray = array("count", "part of that step that was over when it was decided, 0 or more, below 1")
    constraint: tuple[str, ...] = texts("count", "obstacle, workspace or goal dimension that decided ('' if SAFE)")
    tube_lower: np.ndarray = array("count K+1 n", "lower bounds of each reference's tube, all cells", finite=False)
    tube_upper: np.ndarray = array("count K+1 n", "upper bounds of each reference's tube, all cells", finite=False)
    seconds: np.ndarray = array("count", "share of the proof time", units="s")
    propagator: str = scalar("propagator that made the tubes")
    rigorous: bool = scalar("whether rounding is included in the tubes")


@dataclass(frozen=True)
class Kind:
    """Name and format versions of a record class.

    Attributes:
        version: the newest one, which is written.
        oldest: the oldest one that is read.
        command: of an old file, what makes it again.
    """

    name: str
    version: int
    record: type
    oldest: int = 1
    command: str = ""


KINDS = (
    Kind("demonstrations", 1, Demonstrations),
    Kind("dynamics", 1, DynamicsModel),
    Kind("planner", 1, PlannerModel),
    Kind("tracker", 1, TrackerModel),
    Kind("certificate", 4, Certificate, oldest=4, command="sagemp verify --overwrite"),
    Kind("library", 5, Library, oldest=5, command="sagemp build-library --overwrite"),
    Kind("rollouts", 2, Rollouts, oldest=2, command="sagemp execute --overwrite"),
    Kind("safety", 2, SafetyRates, oldest=2, command="sagemp safety-rates --overwrite"),
)


def own_kinds() -> tuple[Kind, ...]:
    """The kinds of what stages from outside write, see :mod:`sagemp_cli.plugins.stages`.

    Raises:
        ConfigError: a stage's record is not declared as one.
    """
    found = own_stages()
    for stage in found:
        declared = is_dataclass(stage.record) and all("form" in f.metadata for f in fields(stage.record))
        if not declared or stage.record in [k.record for k in KINDS]:
            raise ConfigError(
                f"stage '{stage.name}': its record must be a dataclass of its own, with fields declared by array, "
                "texts, scalar, weights or group of sagemp_cli.storage.record"
            )
    return tuple(Kind(stage.name, 1, stage.record) for stage in found)


def kind_of(record: type) -> Kind:
    """The kind that a record class belongs to."""
    known = next((k for k in KINDS if k.record is record), None)
    return known or next(k for k in own_kinds() if k.record is record)
