"""Console messages by verbosity, a full log file, and progress with an estimate of the time left."""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path

_FILE_FORMAT = "%(asctime)s %(process)d %(levelname)s %(name)s: %(message)s"
_PACKAGES = ("app", "fusion", "mvs_backends")


def log_to_console(verbosity: int) -> None:
    """Show messages on stderr: warnings with -1, facts with 0, details with 1 and more."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel({-1: logging.WARNING, 0: logging.INFO}.get(verbosity, logging.DEBUG))
    handler.setFormatter(_ConsoleFormatter())
    _add(handler)


def log_to_file(path: Path) -> None:
    """Append every record, with tracebacks, to a file."""
    handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter(_FILE_FORMAT))
    _add(handler)


def _add(handler: logging.Handler) -> None:
    for name in _PACKAGES:
        logging.getLogger(name).setLevel(logging.DEBUG)
        logging.getLogger(name).addHandler(handler)


class _LogFile(logging.FileHandler):
    """Where a full disk, which the work itself reports, adds no tracebacks to the console."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Lose the record."""


class _ConsoleFormatter(logging.Formatter):
    """One line per record; tracebacks stay in the log file."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = "" if record.levelno < logging.WARNING else f"{record.levelname.lower()}: "
        clear = "\r\033[K" if sys.stderr.isatty() else ""
        return f"{clear}{prefix}{record.getMessage()}"


class ProgressLine:
    """A line on the terminal, rewritten in place; elsewhere a log record now and then."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._start = time.monotonic()
        self._first: int | None = None
        self._shown = self._start
        self._interval_s = 0.2 if sys.stderr.isatty() else 30.0

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps are finished."""
        now = time.monotonic()
        if self._first is None:
            self._first = done
        last = done >= total
        if now - self._shown < self._interval_s and not (last and sys.stderr.isatty()):
            return
        self._shown = now
        steps = done - self._first
        left = f", {format_seconds((now - self._start) / steps * (total - done))} left" if steps and not last else ""
        text = f"{self._label}: {done}/{total}{left}"
        if sys.stderr.isatty():
            sys.stderr.write(f"\r\033[K{text}" + ("\r\033[K" if last else ""))
            sys.stderr.flush()
        else:
            logging.getLogger(__name__).info("%s", text)


def format_seconds(seconds: float) -> str:
    """`42 s`, `7 min`, `3 h 05 min`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"
