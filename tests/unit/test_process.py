"""Programs of others."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from mvs_backends.base import MvsError
from mvs_backends.process import run_subprocess


def test_the_last_lines_are_the_reason_and_not_the_stack_trace(tmp_path: Path) -> None:
    text = r"reading\nstarting\n\nno GPU\nwhat(): Check failed\n*** Aborted ***\nPC: @     0x12\n    @     0x1 f()\n"
    script = f"printf '{text}'; kill -ABRT $$"
    with pytest.raises(MvsError) as caught:
        run_subprocess(["/bin/sh", "-c", script], log_file=tmp_path / "log")
    assert "SIGABRT; its last lines: starting | no GPU | what(): Check failed (all in" in str(caught.value)


def test_the_environment_is_added_to_ours(tmp_path: Path) -> None:
    run_subprocess(["/bin/sh", "-c", 'echo "$HERE $HOME"'], log_file=tmp_path / "log", environment={"HERE": "it is"})
    assert f"it is {os.environ.get('HOME', '')}" in (tmp_path / "log").read_text()


def test_a_program_that_runs_too_long_ends_with_its_children(tmp_path: Path) -> None:
    script = f"(sleep 600 & echo $! > {tmp_path / 'child'}; wait)"
    with pytest.raises(MvsError, match=r"ran longer than 0\.5 s and was stopped"):
        run_subprocess(["/bin/sh", "-c", script], log_file=tmp_path / "log", timeout_s=0.5)
    child = int((tmp_path / "child").read_text())
    for _ in range(100):
        status = Path(f"/proc/{child}/stat")
        if not status.exists() or " Z " in status.read_text():
            return
        time.sleep(0.05)
    pytest.fail("its child goes on")
