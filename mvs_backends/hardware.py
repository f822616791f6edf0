"""What of this machine the programs of back-ends may use: GPUs and memory."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from mvs_backends.base import MvsError

_QUERY = ("--query-gpu=name,uuid,driver_version", "--format=csv,noheader")
_TIMEOUT_S = 60.0
_MEMORY_SHARE = 0.5
_CGROUP_FILES = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


@functools.cache
def installed_gpus() -> tuple[str, ...]:
    """Name, identity and driver of each NVIDIA GPU, as nvidia-smi tells; empty without it."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return ()
    try:
        found = subprocess.run([program, *_QUERY], capture_output=True, text=True, timeout=_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired):
        return ()
    return tuple(line.strip() for line in found.stdout.splitlines() if line.strip()) if found.returncode == 0 else ()


def chosen_gpus(gpu_index: str) -> tuple[str, ...]:
    """The GPUs of `MvsOptions.gpu_index`, each as CUDA_VISIBLE_DEVICES names it; empty: all, and how many isn't known.

    Raises:
        MvsError: there are fewer.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = tuple(str(number) for number in range(len(installed_gpus())))
    if visible is not None:
        names = tuple(name.strip() for name in visible.split(",") if name.strip())
    if gpu_index == "-1":
        return names
    chosen = [int(number) for number in gpu_index.split(",")]
    if names and max(chosen) >= len(names):
        raise MvsError(f"there is no GPU {max(chosen)}, only {len(names)}, counted from 0; set --gpu-index")
    return tuple(names[number] if names else str(number) for number in chosen)


def gpu_environment(gpus: Sequence[str]) -> dict[str, str]:
    """Environment variables that show a program these GPUs only; all if none are named."""
    return {"CUDA_VISIBLE_DEVICES": ",".join(gpus)} if gpus else {}


def deal_gpus(gpus: Sequence[str], num_jobs: int) -> tuple[tuple[str, ...], ...]:
    """GPUs for each of the jobs that may run side by side: all of a lone job, one each of many."""
    num_sharers = max(1, min(len(gpus), num_jobs))
    return tuple(tuple(gpus[sharer::num_sharers]) for sharer in range(num_sharers))


def memory_budget_gib(num_threads: int) -> float:
    """Memory for a job that has so many of this process's cores: its share of half of what is free."""
    free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    for line in Path("/proc/meminfo").read_text().splitlines() if Path("/proc/meminfo").exists() else ():
        if line.startswith("MemAvailable:"):
            free = 1024 * int(line.split()[1])
    limits = [path.read_text().strip() for path in _CGROUP_FILES if path.exists()]
    free = min([free, *(int(limit) for limit in limits if limit.isdigit())])
    return _MEMORY_SHARE * free / 2**30 * min(1.0, num_threads / len(os.sched_getaffinity(0)))
