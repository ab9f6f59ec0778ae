"""The layers of docs/architecture.md: imports point downwards only, and the checker stands apart."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "sagemp_cli"

RANK = {
    "cli": 9,
    "stages": 8,
    "report": 7,
    "library": 6,
    "execution": 7,
    "baselines": 7,
    "checker": 7,
    "models": 6,
    "reachability": 5,
    "planners": 5,
    "experts": 5,
    "identification": 5,
    "trackers": 5,
    "closed_loop": 4,
    "training": 4,
    "workers": 4,
    "checkpoint": 3,
    "dynamics": 3,
    "scenes": 3,
    "sets": 2,
    "storage": 2,
    "config": 2,
    "binding": 1,
    "progress": 1,
    "errors": 0,
}
EXCEPTIONS = {
    # the closed loop is built around the tracking policy, a leaf of its own package
    ("closed_loop", "sagemp_cli.trackers.policy"),
}


def part_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("sagemp_cli."):
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith("sagemp_cli."))


FILES = sorted(p for p in ROOT.rglob("*.py") if p.name not in ("__main__.py",) and p.parent != ROOT or p.stem in RANK)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_downwards(path):
    own = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert own in RANK, f"{own} has no layer; give it one here and in docs/architecture.md"
    for module in imports(path):
        other = part_of(module)
        if other == own or (own, module) in EXCEPTIONS:
            continue
        assert RANK[other] < RANK[own] or (RANK[other] == RANK[own] and other in ("trackers", "reachability")), (
            f"{path.relative_to(ROOT)} imports {module}, which is not below it"
        )


def test_the_checker_shares_no_code_with_what_it_checks():
    """It may use the robots' formulas and the reading of files, nothing that computes sets, controls or rollouts."""
    allowed = {"checker", "dynamics", "binding", "storage", "progress", "errors"}
    for path in (ROOT / "checker").rglob("*.py"):
        for module in imports(path):
            assert part_of(module) in allowed, f"{path.name} imports {module}"
