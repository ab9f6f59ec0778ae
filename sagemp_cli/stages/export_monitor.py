"""``sagemp export monitor``: what a robot needs to compare measured states with its tubes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from sagemp_cli import monitor
from sagemp_cli.errors import UsageError
from sagemp_cli.pipeline.tubes import selected
from sagemp_cli.storage import Certificate, Library, read_any_artifact, refuse_existing, write_whole


def export_monitor(path: Path, to: Path, *, overwrite: bool = False) -> tuple[int, Path]:
    """Write the tubes of a file's certified references as NPZ, and the monitor's module ``monitor.py`` beside it.

    References keep their order; those that are not certified are left out.

    Returns:
        How many references were written, and where the module is.

    Raises:
        ArtifactError: the file cannot be read, or one of the two is there already.
        UsageError: another kind of file, or no reference is certified.
    """
    module = to.with_name("monitor.py")
    for new in (to, module):
        refuse_existing(new, overwrite)
    _, artifact = read_any_artifact(path)
    if not isinstance(artifact.record, Certificate | Library) or not artifact.unchanged:
        raise UsageError(f"{path}: tubes are in certificates and libraries that nobody changed, this is none")
    tubes, loop = artifact.record.tubes, artifact.record.loop
    if loop.lag is not None and loop.lag[1, 1] > 0:
        raise UsageError(
            f"{path}: what is measured is up to {loop.lag[1, 1]:g} s old, and the tubes are those of the instants: a "
            "monitor would raise alarms of nothing"
        )
    safe = [r for r, verdict in enumerate(tubes.verdict) if verdict == "SAFE"]
    if not safe:
        raise UsageError(f"{path}: no reference is certified, so there is nothing to watch")
    tubes, image = selected(tubes, np.array(safe)), io.BytesIO()
    np.savez_compressed(
        image,
        lower=tubes.tube_lower,
        upper=tubes.tube_upper,
        cell_lower=tubes.cell_lower,
        cell_upper=tubes.cell_upper,
        cell_reference=tubes.cell_reference,
        names=np.array(loop.state_names),
        dt=np.array(np.nan if loop.dt is None else loop.dt),
        certificate=np.array(artifact.sha256),
    )
    write_whole(to, image.getvalue(), overwrite=overwrite)
    write_whole(module, Path(monitor.__file__).read_bytes(), overwrite=overwrite)
    return len(safe), module
