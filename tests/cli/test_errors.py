"""Bad input: one line, exit code 2, nothing written; interrupts and bugs have codes of their own."""

from __future__ import annotations

import errno
import os
import signal
import time
from pathlib import Path

import pytest

from sagemp_cli.cli.time_limit import time_limit
from sagemp_cli.errors import EXIT_INTERRUPTED, EXIT_TIME_LIMIT
from sagemp_cli.storage import atomic

FOLDER = Path("artifacts/unicycle_node")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["verify", "--partitions", "0"], "proof.partitions must be a positive number of cells in all"),
        (["verify", "--partitions", "4x"], "2 counts such as 2x2, or auto; found '4x'"),
        (["verify", "--partitions", "it's"], 'found "it\'s"'),
        (["verify", "--partitions", "-4"], "found -4"),
        (
            ["verify", "--partitions", "2", "proof.partitions=3"],
            "--partitions 2 and the override proof.partitions=...",
        ),
        (["gen-data", "--seed", "1", "seed=2"], "--seed 1 and the override seed=... contradict each other"),
        (["gen-data", "experiment=unicyle_node"], "unknown experiment (did you mean 'unicycle_node'?)"),
        (["gen-data", "planner.hiden=3"], "planner.hiden: unknown key (did you mean 'planner.hidden'?)"),
        (["gen-data", "start.radius=[0,0,0,0]"], "start.radius must be positive in at least one of px, py, theta, v"),
        (["gen-data", "start.radius=[-1,1,0,0]"], "start.radius must not be negative, found -1.0 for px"),
        (["gen-data", "oops"], "'oops' is not an override of the form key=value"),
        (["status", "horizn=3"], "horizn: unknown key (did you mean 'horizon'?)"),
        (["inspect", "none.h5"], "none.h5: no such file"),
        (["inspect", "."], ".: is a folder, an HDF5 file is needed"),
        (["status", "seed=x"], "seed must be a whole number of at least 0, found 'x'"),
        (["gen-data", "name=../.."], "letters, digits and _ - . +, a letter, digit or _ first; found '../..'"),
        (["gen-data", "name=/root/x"], "must be a folder's name"),
        (["gen-data", "name=..", "effort=toy"], "must be a folder's name"),
        (["gen-data", "name=''"], "must be a folder's name"),
        (["gen-data", 'name="a\tb"'], "must be a folder's name"),
        (["gen-data", "effort.suffix=/../.."], "must be a folder's name"),
        (["gen-data", "artifacts=''"], "artifacts must be the path of a folder, found ''"),
        (["config", "list", "planner=zzz"], "planner=zzz: unknown planner"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2_and_nothing_is_written(sagemp, made_up, arguments, message):
    result = sagemp(*arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith("error: ")
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert result.stdout == ""
    assert made_up.ran == []
    assert list(Path().iterdir()) == []


def test_config_validate_reports_all_errors_of_a_config_at_once(sagemp):
    result = sagemp("config", "validate", "+tracker.width=3", "dynamics.dt=fast")
    assert result.exit_code == 2
    assert "tracker.width: Tracker has no such option" in result.stderr
    assert "dynamics.dt must be a positive number of seconds, found 'fast'" in result.stderr


def test_config_validate_checks_every_option(sagemp):
    result = sagemp("config", "validate")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.endswith("configs checked, no errors\n")


def test_config_show_prints_what_compose_makes(sagemp):
    import yaml

    from sagemp_cli.config.composition import compose

    assert yaml.safe_load(sagemp("config", "show", "seed=3").stdout) == compose(["seed=3"])


def test_config_list_marks_what_is_in_use(sagemp):
    shown = sagemp("config", "list", "propagator=auto_lirpa").stdout
    assert "  * auto_lirpa" in shown
    assert "    affine" in shown


def everything():
    return sorted(str(p) for p in Path().rglob("*") if p.is_file())


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "demonstrations.h5: cannot be written: no space left on the disk"),
        (errno.EROFS, "demonstrations.h5: cannot be written: the folder or file is read-only"),
    ],
)
def test_a_full_or_read_only_disk_is_one_line_and_loses_nothing(sagemp, made_up, monkeypatch, number, message):
    sagemp("gen-data")
    before = (FOLDER / "demonstrations.h5").read_bytes()

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(atomic.os, "fsync", refuse)
    result = sagemp("gen-data", "--overwrite")
    assert result.exit_code == 2
    assert result.stderr == f"error: {FOLDER}/{message}\n"
    assert (FOLDER / "demonstrations.h5").read_bytes() == before
    assert everything() == [f"{FOLDER}/demonstrations.h5", f"{FOLDER}/demonstrations.png"]


def test_an_artifacts_folder_that_is_a_file_is_named(sagemp, made_up):
    Path("artifacts").write_text("in the way")
    result = sagemp("gen-data")
    assert result.exit_code == 2
    assert "artifacts is a file where a folder is needed" in result.stderr


def test_an_interrupt_has_its_exit_code_and_leaves_no_artifact(sagemp, made_up, monkeypatch):
    def press(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic.os, "fsync", press)
    result = sagemp("gen-data")
    assert result.exit_code == EXIT_INTERRUPTED
    assert result.stderr.startswith("interrupted: nothing half-written is left")
    assert "run the same command" in result.stderr
    assert everything() == []


@pytest.fixture(params=["in the foreground", "in the background, where Ctrl-C is ignored"])
def job(request):
    before = signal.getsignal(signal.SIGINT)
    if "background" in request.param:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_time_limit_stops_a_stage_like_an_interrupt(sagemp, monkeypatch, job):
    import sagemp_cli.stages.gen_data as stage

    cleaned = []

    def slow(context):
        try:
            time.sleep(3)
        except KeyboardInterrupt:
            cleaned.append(True)
            raise

    monkeypatch.setattr(stage, "run", slow)
    handler = signal.getsignal(signal.SIGINT)
    result = sagemp("gen-data", "--time-limit", "0.2")
    assert signal.getsignal(signal.SIGINT) is handler
    assert result.exit_code == EXIT_TIME_LIMIT
    assert result.stderr.startswith("error: --time-limit 0.2 ran out: ")
    assert cleaned == [True]


def test_ctrl_c_in_the_background_is_still_ignored_while_a_time_limit_runs():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with time_limit(60):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_bug_is_one_line_unless_debugging_was_asked_for(sagemp, monkeypatch):
    import sagemp_cli.stages.gen_data as stage

    def broken(context):
        raise ZeroDivisionError("first line\nsecond line")

    monkeypatch.setattr(stage, "run", broken)
    result = sagemp("gen-data")
    assert result.exit_code == 1
    assert result.stderr == (
        "internal error: ZeroDivisionError: first line second line (a bug of sagemp; SAGEMP_DEBUG=1 shows where)\n"
    )
    monkeypatch.setenv("SAGEMP_DEBUG", "1")
    assert "Traceback" in sagemp("gen-data").stderr


def test_a_plugin_that_cannot_be_loaded_is_one_line_whatever_the_command(sagemp):
    Path("broken_plugin.py").write_text("x = 1 / 0\n")
    for plugin, message in (
        ("nowhere.py", "error: plugin nowhere.py: no such file\n"),
        ("broken_plugin.py", "error: plugin broken_plugin.py: line 1: ZeroDivisionError: division by zero\n"),
    ):
        refused = sagemp("--plugin", plugin, "config", "list")
        assert (refused.exit_code, refused.stderr) == (2, message)
