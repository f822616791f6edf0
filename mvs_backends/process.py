"""Programs of others, run for a dense job."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mvs_backends.base import MvsError

_POLL_S = 0.2
_NUM_LAST_LINES = 3
_TRACE = ("@ ", "*** ", "PC: @")
"""How the lines of glog's stack traces begin, which come after the reason."""
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


def find_program(name: str, given: str) -> Path | None:
    """A program's executable.

    Args:
        name: of the executable.
        given: its path or the folder that holds it; empty: it is searched on PATH.

    Returns:
        None if it isn't there or can't be executed.
    """
    if not given:
        found = shutil.which(name)
        return Path(found) if found else None
    path = Path(given).expanduser().absolute()
    path = path / name if path.is_dir() else path
    return path if path.is_file() and os.access(path, os.X_OK) else None


def run_subprocess(
    command: Sequence[str | Path],
    *,
    log_file: Path,
    environment: Mapping[str, str] | None = None,
    timeout_s: float = 0.0,
    on_wait: Callable[[], None] | None = None,
) -> None:
    """Run a program to its end. It and what it starts die with this process.

    Args:
        command: executable and arguments; no shell reads them.
        log_file: gets what it prints, after what is there.
        environment: variables to set for it.
        timeout_s: it is killed when it runs longer; 0: never.
        on_wait: called a few times a second.

    Raises:
        MvsError: it can't be started, fails, is killed, or runs too long; with its last lines.
    """
    name = Path(command[0]).name
    log_file.parent.mkdir(parents=True, exist_ok=True)
    with log_file.open("ab") as log:
        log.write(f"$ {shlex.join(map(str, command))}\n".encode())
        log.flush()
        try:
            process = subprocess.Popen(
                [str(part) for part in command],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **(environment or {})},
                start_new_session=True,
                preexec_fn=_die_with_parent,
            )
        except OSError as error:
            raise MvsError(f"{command[0]} can't be started: {error.strerror}; check the path") from error
    end = time.monotonic() + timeout_s if timeout_s > 0 else float("inf")
    try:
        while not _ended(process):
            if time.monotonic() > end:
                raise MvsError(f"{name} ran longer than {timeout_s:g} s and was stopped; {_last_lines(log_file)}")
            if on_wait is not None:
                on_wait()
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if process.returncode < 0:
        raise MvsError(f"{name} was ended by {signal.Signals(-process.returncode).name}; {_last_lines(log_file)}")
    if process.returncode > 0:
        raise MvsError(f"{name} ended with exit code {process.returncode}; {_last_lines(log_file)}")


def _ended(process: subprocess.Popen[bytes]) -> bool:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_POLL_S)
    return process.returncode is not None


def _die_with_parent() -> None:
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _last_lines(log_file: Path) -> str:
    with log_file.open(encoding="utf-8", errors="replace") as log:
        stripped = (line.strip() for line in log)
        lines = deque((line for line in stripped if line and not line.startswith(_TRACE)), maxlen=_NUM_LAST_LINES)
    return f"its last lines: {' | '.join(lines)} (all in {log_file})"
