"""The first line of every benchmark: on what it ran."""

from __future__ import annotations

import os
import platform
from importlib.metadata import packages_distributions, version
from pathlib import Path

_MODULES = ("numpy", "numba", "pycolmap", "ortools", "open3d", "cv2")


def describe_machine() -> str:
    """Processor, cores, memory and versions."""
    models = [
        line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line
    ]
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    # pycolmap may be pycolmap-cuda12, open3d open3d-cpu.
    names = packages_distributions()
    packages = ", ".join(f"{name} {version(name)}" for name in (names[module][0] for module in _MODULES))
    return (
        f"{models[0] if models else platform.machine()}, {len(os.sched_getaffinity(0))} cores, {memory_gib:.0f} GiB; "
        f"Python {platform.python_version()}, {packages}"
    )
