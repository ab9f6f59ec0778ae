"""Which share of a planner's further plans can be certified: how much a verdict about one plan hangs on luck."""

from __future__ import annotations

import dataclasses

from sagemp_cli.loop.controller import Controller
from sagemp_cli.pipeline.context import StageContext
from sagemp_cli.pipeline.proof import Proof
from sagemp_cli.pipeline.reference_starts import reference_starts
from sagemp_cli.pipeline.stage import stage_named
from sagemp_cli.planners.base import Planner, affordable
from sagemp_cli.reachability.affine.affine import Affine
from sagemp_cli.storage import Samples


def sample_share(
    context: StageContext, planner: Planner, tracker: Controller, proof: Proof, *, wanted: int
) -> Samples | None:
    """How many of so many further plans are certified by ``affine``; None if none are wanted.

    They start as those of a library do and are proved from all of X_I, with the partition of the certificate. Only the
    numbers are kept of them, which the certificate says and does not prove.
    """
    if not wanted:
        return None
    count = affordable(planner, wanted)
    generator = context.generator("verify: samples")
    problem = proof.problem
    spread = context.config["library"]["start_spread"]
    starts = reference_starts(problem, spread).sample(count, generator)
    plans = planner.sample(starts, problem.scene.goal, scene=problem.scene, count=count, generator=generator)
    found = dataclasses.replace(proof, propagator=Affine()).verify(plans, tracker, progress=context.progress)
    return Samples(drawn=count, certified=len(found.safe), seed=stage_named("verify").seed_in(context.config))
