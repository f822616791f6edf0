"""The command line as a user meets it: help, flags, exit codes, one line per error, nothing left behind."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from app.command_line import default_workspace
from app.commands import app
from app.config import RunConfig, option_docs

ROOT = Path(__file__).parents[2]
COMMANDS = [command.callback.__name__ if command.name is None else command.name for command in app.registered_commands]  # type: ignore[union-attr]


def cityrecon(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", "from app.cli import main; main()", *map(str, arguments)],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_is_in_the_readme(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.output
    assert f"`{command}`" in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("module", "unused"),
    [
        ("app.commands", {"cv2", "numba", "ortools", "pycolmap"}),
        ("app.clustering.stage", {"ortools", "pycolmap"}),
        ("app.view_selection.stage", {"cv2", "pycolmap"}),
    ],
)
def test_what_takes_long_to_load_is_loaded_by_those_who_use_it(module: str, unused: set[str]) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert not unused & set(result.stdout.split())


def test_every_option_of_a_stage_is_a_flag_of_its_command() -> None:
    sections = {"cluster": "clustering", "select": "selection", "sfm": "sfm", "fuse": "fusion", "densify": "stereo"}
    for command, section in sections.items():
        command_info = typer.main.get_command(app).commands[command]  # type: ignore[attr-defined]
        flags = {flag for parameter in command_info.params for flag in parameter.opts}
        for option in option_docs(type(getattr(RunConfig(), section))):
            assert f"--{option.replace('_', '-')}" in flags


@pytest.mark.parametrize("command", COMMANDS)
def test_no_flag_means_two_things(command: str) -> None:
    parameters = typer.main.get_command(app).commands[command].params  # type: ignore[attr-defined]
    flags = [flag for parameter in parameters for flag in (*parameter.opts, *parameter.secondary_opts)]
    assert len(set(flags)) == len(flags)


def test_workspace_is_beside_the_output() -> None:
    assert default_workspace(Path("a/town.ply")) == Path("a/town.workspace")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["full", "{tmp}/none", "{tmp}/out.ply"], "none"),
        (["full", "{tmp}/empty", "{tmp}/out.ply"], "empty"),
        (["full", "{tmp}/empty", "{tmp}/out.las"], "must end in .ply"),
        (["full", "{tmp}/empty", "{tmp}/nowhere/out.ply"], "create its parent"),
        (["full", "{tmp}/empty", "{tmp}/out.ply", "--backend", "magic"], "patchmatch"),
        (["full", "{tmp}/empty", "{tmp}/out.ply", "--set", "selection.n_viz=3"], "did you mean n_vis"),
        (["full", "{tmp}/empty", "{tmp}/out.ply", "--config", "{tmp}/none.toml"], "cannot read"),
        (["cluster", "{tmp}/ws"], "is no workspace"),
        (["fuse", "{tmp}/empty"], "is no workspace"),
        (["cluster", "{tmp}/ws", "--overlap-m", "-1"], "overlap_m"),
        (["compare", "{tmp}/a.ply", "{tmp}/b.ply"], "a.ply"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, arguments: list[str], complaint: str) -> None:
    (tmp_path / "empty").mkdir()
    result = cityrecon(*(argument.format(tmp=tmp_path) for argument in arguments))
    assert result.returncode == 2, result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert complaint in errors[0]
    assert "Traceback" not in result.stderr
    assert [path.name for path in tmp_path.rglob("*")] == ["empty"]


def test_a_terminated_run_says_so_in_one_line() -> None:
    script = "import os, signal, time, typer; from app.command_line import run_safely; import pycolmap\n"
    script += "def work():\n    os.kill(os.getpid(), signal.SIGTERM)\n    time.sleep(60)\n"
    script += "app = typer.Typer()\napp.command()(lambda: run_safely(work, verbosity=0))\napp([])"
    result = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 130
    assert result.stderr == "warning: stopped; the same command continues\n"


def test_a_reader_that_has_seen_enough_ends_a_table_quietly() -> None:
    script = "from app.command_line import print_lines; print_lines(str(k) for k in range(100_000))"
    result = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"{sys.executable} -c '{script}' | head -n 2"],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "0\n1\n", "")
