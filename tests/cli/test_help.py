"""--help: quick, with examples, for every command; and what typing errors get."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

COMMANDS = [
    ["gen-data"],
    ["train-dynamics"],
    ["train-planner"],
    ["train-tracker"],
    ["verify"],
    ["build-library"],
    ["execute"],
    ["safety-rates"],
    ["run"],
    ["check"],
    ["prove"],
    ["status"],
    ["inspect"],
    ["doctor"],
    ["export", "tracker"],
    ["config", "show"],
    ["config", "validate"],
    ["config", "list"],
]
HEAVY = ("torch", "scipy", "matplotlib", "hydra", "h5py", "numpy", "yaml")


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_examples_of_itself(sagemp, command):
    result = sagemp(*command, "--help")
    assert result.exit_code == 0
    assert "Examples" in result.stdout
    assert f"$ sagemp {' '.join(command)}" in result.stdout


def test_the_help_lists_every_command(sagemp):
    listed = sagemp("--help").stdout
    for command in COMMANDS:
        assert f"│ {command[0]} " in listed


def test_examples_in_the_help_show_brackets_as_typed(sagemp):
    assert "'tracker.hidden=[8,8]'" in sagemp("train-tracker", "--help").stdout
    assert "jq '.files[].state'" in sagemp("status", "--help").stdout


def imported(*arguments, of, folder=None):
    """Which of these modules a command imports."""
    script = (
        "import sys\n"
        f"sys.argv = ['sagemp', *{arguments!r}]\n"
        "from sagemp_cli.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as e:\n    assert not e.code\n"
        f"print([m for m in {of!r} if m in sys.modules], file=sys.stderr)"
    )
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=folder).stderr


def test_help_imports_nothing_heavy_and_comes_at_once():
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = imported("verify", "--help", of=HEAVY)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert found.strip() == "[]"
    # Processor time: what the clock shows on a machine that does nothing else.
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.0


@pytest.mark.parametrize(
    "arguments",
    [("status", "experiment=unicycle_vlm_avoid", "sources.train-tracker=kinematic_node"), ("config", "list")],
    ids=" ".join,
)
def test_what_only_looks_at_files_and_configs_imports_no_mathematics(arguments, tmp_path):
    assert imported(*arguments, of=("torch", "scipy", "matplotlib", "sympy"), folder=tmp_path).strip() == "[]"


def test_the_version_is_shown(sagemp):
    from sagemp_cli import __version__

    assert sagemp("--version").stdout == f"sagemp {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["verfy"], "Did you mean 'verify'?"),
        (["verify", "--partition", "4"], "--partitions"),
        (["run", "--untill", "verify"], "--until"),
        (["inspect"], "Missing argument"),
        (["verify", "--seed", "x"], "--seed"),
    ],
)
def test_an_unknown_command_or_option_gets_the_nearest_known_one_and_exit_code_2(sagemp, arguments, message):
    result = sagemp(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr


def test_shell_completion_is_offered(sagemp):
    assert "--install-completion" in sagemp("--help").stdout
