"""The layers of docs/architecture.md: imports point downwards only, and the checker stands apart."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "sagemp_cli"

LAYERS = (
    ("errors", "monitor"),
    ("progress", "workers", "reading"),
    ("plugins",),
    ("config",),
    ("sets", "storage"),
    ("dynamics", "scenes", "learning"),
    ("loop", "problem"),
    ("reachability",),
    ("verification", "planners", "experts", "identification", "trackers"),
    ("library", "checker"),
    ("execution", "pipeline"),
    ("report",),
    ("stages",),
    ("cli",),
)
"""From the bottom to the top; a part may import from any layer below its own, and from no other part beside it."""

RANK = {part: rank for rank, parts in enumerate(LAYERS) for part in parts}


def part_of(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("sagemp_cli."):
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith("sagemp_cli."))


FILES = sorted(p for p in ROOT.rglob("*.py") if p.parent != ROOT or p.stem in RANK)


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_downwards(path):
    own = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert own in RANK, f"{own} has no layer; give it one here and in docs/architecture.md"
    for module in imports(path):
        other = part_of(module)
        assert other == own or RANK[other] < RANK[own], (
            f"{path.relative_to(ROOT)} imports {module}, which is not below it"
        )


def test_the_checker_shares_no_code_with_what_it_checks():
    """It may use the reading of files, nothing that knows a robot, a config's classes, or computes sets or controls."""
    allowed = {"checker", "reading", "progress", "errors"}
    for path in (ROOT / "checker").rglob("*.py"):
        for module in imports(path):
            assert part_of(module) in allowed or module == "sagemp_cli.storage.content", f"{path.name} imports {module}"


def test_a_check_loads_neither_torch_nor_a_robot():
    code = """
import sys
from pathlib import Path
import sagemp_cli.checker.check, sagemp_cli.checker.claim
heavy = ("torch", "sagemp_cli.dynamics", "sagemp_cli.reachability", "sagemp_cli.config", "sagemp_cli.loop", "scipy")
print([m for m in sys.modules if m.startswith(heavy)])
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert found.stdout.strip() == "[]"
