"""All figures of all experiments that were run: what ``make reproduce-figures`` makes.

``python -m sagemp_cli.report.reproduce [ARTIFACTS]`` draws the figures of every experiment's artifacts again into
``<artifacts>/figures``. It reads artifacts only; what was not run is not drawn.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sagemp_cli.errors import ArtifactError, SagempError
from sagemp_cli.report.certificate import draw_certificate
from sagemp_cli.report.demonstrations import draw_demonstrations
from sagemp_cli.report.dynamics import draw_dynamics
from sagemp_cli.report.figure import save_figure
from sagemp_cli.report.library import draw_library
from sagemp_cli.report.planner import draw_planner
from sagemp_cli.report.rollouts import draw_rollouts
from sagemp_cli.report.safety import draw_safety
from sagemp_cli.report.training import draw_training
from sagemp_cli.storage import (
    Certificate,
    Demonstrations,
    DynamicsModel,
    Library,
    PlannerModel,
    Rollouts,
    SafetyRates,
    TrackerModel,
    read_artifact,
)

FIGURES: tuple[tuple[Callable[..., Figure], tuple[tuple[str, type], ...]], ...] = (
    (draw_demonstrations, (("demonstrations", Demonstrations),)),
    (draw_dynamics, (("dynamics", DynamicsModel),)),
    (draw_planner, (("planner", PlannerModel),)),
    (draw_training, (("tracker", TrackerModel),)),
    (draw_certificate, (("certificate", Certificate),)),
    (draw_library, (("library", Library),)),
    (draw_rollouts, (("rollouts", Rollouts), ("library", Library))),
    (draw_safety, (("safety", SafetyRates),)),
)
"""Each figure and the artifacts that it reads, by file name; the first one names the figure."""


def draw_experiment(folder: Path, into: Path) -> list[Path]:
    """Draw every figure whose artifacts are in an experiment's folder, as ``<experiment>_<artifact>.png``."""
    drawn = []
    for draw, sources in FIGURES:
        paths = [folder / f"{name}.h5" for name, _ in sources]
        if all(path.exists() for path in paths):
            artifacts: list[Any] = [
                read_artifact(path, record) for path, (_, record) in zip(paths, sources, strict=True)
            ]
            drawn.append(save_figure(draw(*artifacts), into / f"{folder.name}_{sources[0][0]}.png"))
    return drawn


def main(arguments: list[str]) -> int:
    """Draw the figures of all experiments below a folder and print their paths; an exit code."""
    root = Path(arguments[0] if arguments else "artifacts")
    try:
        names = {name for _, sources in FIGURES for name, _ in sources}
        folders = sorted({path.parent for path in root.glob("*/*.h5") if path.stem in names})
        if not folders:
            raise ArtifactError(f"{root}: holds no experiment's artifacts; make some with 'sagemp run'")
        for folder in folders:
            for path in draw_experiment(folder, root / "figures"):
                print(path)
    except SagempError as e:
        print(f"error: {e}", file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
