"""A call in a process of its own brings back its result, its errors, its progress and its log, and survives aborts."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from app.errors import CityReconError, DiskFullError, InputError
from app.sfm import isolated
from app.sfm.isolated import run_isolated

Progress = Callable[[int, int], None]


def add(first: int, second: int, progress: Progress) -> int:
    logging.getLogger("app.sfm").info("adding %d", first)
    progress(1, 2)
    os.write(2, b"E noise from a library\n")
    return first + second


def abort(progress: Progress) -> None:
    sys.stderr.write("F1122 model.cc:7] Check failed: a < b\n")
    sys.stderr.flush()
    os.abort()


def refuse(progress: Progress) -> None:
    raise InputError("no good")


def divide(progress: Progress) -> float:
    return 1 / 0


def test_result_progress_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    steps: list[tuple[int, int]] = []
    with caplog.at_level(logging.INFO, logger="app"):
        assert run_isolated(add, 2, 3, log_file=tmp_path / "log", progress=lambda *step: steps.append(step)) == 5
    assert steps == [(1, 2)]
    assert "adding 2" in caplog.text
    assert "noise" in (tmp_path / "log").read_text()


def test_an_abort_is_an_error_of_one_line(tmp_path: Path) -> None:
    with pytest.raises(CityReconError, match="SIGABRT.*Check failed: a < b") as caught:
        run_isolated(abort, log_file=tmp_path / "log")
    assert "\n" not in str(caught.value)


def test_errors_keep_their_kind(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no good"):
        run_isolated(refuse, log_file=tmp_path / "log")
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        run_isolated(divide, log_file=tmp_path / "log")


@pytest.mark.parametrize("function", [divide, abort])
def test_what_fails_on_a_full_disk_says_so(
    function: Callable[[Progress], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite's words for it are `No registered database factory succeeded`."""
    monkeypatch.setattr(isolated, "is_disk_full", lambda folder: folder == tmp_path)
    with pytest.raises(DiskFullError, match="no space left on the disk of .*; free some and run"):
        run_isolated(function, log_file=tmp_path / "log")
    with pytest.raises(InputError):
        run_isolated(refuse, log_file=tmp_path / "log")
