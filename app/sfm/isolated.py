"""Calls in a process of their own: an abort inside COLMAP becomes an error, and its messages go to a file."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from app.child_process import die_with_parent
from app.errors import CityReconError, DiskFullError
from app.workspace import is_disk_full

logger = logging.getLogger(__name__)

Result = TypeVar("Result")
Progress = Callable[[int, int], None]
_SHOWN_LINES = 3


def run_isolated(
    function: Callable[..., Result], *arguments: object, log_file: Path, progress: Progress | None = None
) -> Result:
    """Call ``function(*arguments, progress)`` in a new process that dies with this one.

    Args:
        function: importable, as are the types of its arguments and its result.
        arguments: positional arguments; a function for progress is added as the last one.
        log_file: what COLMAP and the function write to standard error is appended here.
        progress: called in this process.

    Raises:
        CityReconError: as raised by the function, or the process ended without a result.
        DiskFullError: it failed, and there is no space left.
        RuntimeError: the function raised something else; holds its traceback.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(sender, os.getpid(), log_file, function, arguments), daemon=True)
    process.start()
    sender.close()
    try:
        while True:
            kind, value = receiver.recv()
            if kind == "progress" and progress is not None:
                progress(*value)
            elif kind == "log":
                logging.getLogger(value[0]).log(value[1], "%s", value[2])
            elif kind == "result":
                return value  # type: ignore[no-any-return]
            elif kind == "error":
                raise value
            elif kind == "traceback":
                if is_disk_full(log_file.parent):
                    raise DiskFullError(log_file.parent)
                raise RuntimeError(value)
    except EOFError:
        process.join()
        if is_disk_full(log_file.parent):
            raise DiskFullError(log_file.parent) from None
        raise CityReconError(
            f"{getattr(function, '__name__', 'COLMAP')} ended with {_exit_text(process.exitcode)}: "
            f"{_last_lines(log_file)} (all in {log_file})"
        ) from None
    finally:
        process.kill()
        process.join()
        receiver.close()


class _Forward(logging.Handler):
    """Sends log records to the parent process."""

    def __init__(self, sender: Connection) -> None:
        super().__init__()
        self._sender = sender

    def emit(self, record: logging.LogRecord) -> None:
        self._sender.send(("log", (record.name, record.levelno, record.getMessage())))


def _serve(
    sender: Connection, parent: int, log_file: Path, function: Callable[..., object], arguments: tuple[Any, ...]
) -> None:
    die_with_parent(parent)
    log_file.parent.mkdir(parents=True, exist_ok=True)
    log = os.open(log_file, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(log, sys.stderr.fileno() if sys.stderr is not None else 2)
    os.dup2(log, 2)
    os.close(log)
    package = logging.getLogger("app")
    package.setLevel(logging.DEBUG)
    package.addHandler(_Forward(sender))
    try:
        sender.send(("result", function(*arguments, lambda done, total: sender.send(("progress", (done, total))))))
    except CityReconError as error:
        sender.send(("error", error))
    except Exception:
        sender.send(("traceback", traceback.format_exc()))


def _exit_text(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return signal.Signals(-exitcode).name
    return f"exit code {exitcode}"


def _last_lines(log_file: Path) -> str:
    lines = log_file.read_text(encoding="utf-8", errors="replace").splitlines() if log_file.exists() else []
    telling = [line for line in lines if line[:1] in "EF" and "Check failed" in line] or lines
    return " ".join(" ".join(telling[-_SHOWN_LINES:]).split())[:300]
