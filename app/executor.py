"""Run independent jobs, each in a process of its own: one that fails, aborts or is killed doesn't end the others."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from app.child_process import die_with_parent
from app.errors import CityReconError
from app.log import log_to_file
from app.workspace import is_disk_full
from fusion.errors import FusionError
from mvs_backends.base import MvsError

logger = logging.getLogger(__name__)

Report = Callable[[int, int], None]
Job = Callable[..., None]
"""A module-level function; its last argument is a `Report`, called with (steps done, steps in all)."""


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def split_cores(num_tasks: int, num_jobs: int) -> tuple[int, int]:
    """(processes, threads in each) for a number of tasks; ``num_jobs`` processes at most, 0: one per core."""
    cores = available_cores()
    processes = max(1, min(num_jobs or cores, num_tasks))
    return processes, max(1, cores // processes)


@dataclass
class _Running:
    process: multiprocessing.process.BaseProcess
    pipe: Connection
    environment: Mapping[str, str]
    reason: str | None = None
    """Why it failed; None also while it runs."""
    reported: bool = False


def run_jobs(
    function: Job,
    jobs: Mapping[str, tuple[Any, ...]],
    *,
    num_workers: int,
    log_file: Path,
    on_progress: Callable[[str, int, int], None],
    on_done: Callable[[str, str | None], None],
    environments: Sequence[Mapping[str, str]] = (),
) -> None:
    """Run ``function(*arguments, report)`` for each job.

    Args:
        function: module-level function.
        jobs: arguments by job name.
        num_workers: processes at a time.
        log_file: where the jobs' log records go.
        on_progress: called with (job, steps done, steps in all).
        on_done: called once per job with the reason of its failure, or None.
        environments: variables to set in each of the processes at a time, so that each can have a GPU of its own;
            empty: they have those of this process.
    """
    context = multiprocessing.get_context("spawn")
    waiting = list(jobs.items())[::-1]
    running: dict[str, _Running] = {}
    free = list(environments or [{} for _ in range(num_workers)])[::-1]
    try:
        while waiting or running:
            while waiting and free:
                name, arguments = waiting.pop()
                environment = free.pop()
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(
                    target=_run_job,
                    args=(function, arguments, theirs, log_file, os.getpid(), environment),
                    name=name,
                )
                process.start()
                theirs.close()
                running[name] = _Running(process, ours, environment)
            by_pipe = {job.pipe: name for name, job in running.items()}
            for ready in wait(list(by_pipe)):
                name = by_pipe[ready]  # type: ignore[index]
                job = running[name]
                try:
                    message = job.pipe.recv()
                except EOFError:
                    job.process.join()
                    job.pipe.close()
                    if not job.reported and is_disk_full(log_file.parent):
                        job.reason = f"no space left on the disk of {log_file.parent}"
                    elif not job.reported:
                        job.reason = f"{_how_it_ended(job.process.exitcode)}; see {log_file}"
                    del running[name]
                    free.append(job.environment)
                    on_done(name, job.reason)
                    continue
                if message[0] == "progress":
                    on_progress(name, message[1], message[2])
                else:
                    job.reason, job.reported = message[1], True
    finally:
        for job in running.values():
            job.process.kill()
            job.process.join()


def _run_job(
    function: Job,
    arguments: tuple[Any, ...],
    pipe: Connection,
    log_file: Path,
    parent: int,
    environment: Mapping[str, str],
) -> None:
    die_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with log_file.open("ab") as handle:
        # Native libraries write to the descriptors, also when they abort the process.
        os.dup2(handle.fileno(), 1)
        os.dup2(handle.fileno(), 2)
    log_to_file(log_file)
    os.environ.update(environment)
    try:
        function(*arguments, lambda done, total: pipe.send(("progress", done, total)))
    except (CityReconError, MvsError, FusionError, OSError, MemoryError) as error:
        logger.error("%s", error, exc_info=True)
        pipe.send(("done", _reason(error)))
    else:
        pipe.send(("done", None))


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error) or type(error).__name__


def _how_it_ended(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"its process was ended by {signal.Signals(-exit_code).name}"
    return f"its process ended with exit code {exit_code}"
