"""Learning a robot model from transitions of its analytical counterpart."""

from sagemp_cli.identification.learning import (
    DynamicsTrainingOptions,
    EnclosureWeight,
    ModelErrors,
    learn_dynamics,
    model_errors,
)
from sagemp_cli.identification.transitions import Transitions, domain_of

__all__ = [
    "DynamicsTrainingOptions",
    "EnclosureWeight",
    "ModelErrors",
    "Transitions",
    "domain_of",
    "learn_dynamics",
    "model_errors",
]
