"""Artifacts in HDF5: typed records, provenance, atomic writes."""

from sagemp_cli.storage.artifact import (
    Artifact,
    Header,
    Parent,
    open_header,
    read_artifact,
    sha256_of,
    write_artifact,
)
from sagemp_cli.storage.atomic import hdf5_image, refuse_existing, write_whole
from sagemp_cli.storage.kinds import (
    KINDS,
    Certificate,
    Counterexample,
    Demonstrations,
    Kind,
    Library,
    PlannerModel,
    Relaxations,
    Rollouts,
    TrackerModel,
    TrainingCurve,
    Tubes,
)

__all__ = [
    "KINDS",
    "Artifact",
    "Certificate",
    "Counterexample",
    "Demonstrations",
    "Header",
    "Kind",
    "Library",
    "Parent",
    "PlannerModel",
    "Relaxations",
    "Rollouts",
    "TrackerModel",
    "TrainingCurve",
    "Tubes",
    "hdf5_image",
    "open_header",
    "read_artifact",
    "refuse_existing",
    "sha256_of",
    "write_artifact",
    "write_whole",
]
