"""What is installed here, and what can run."""

from __future__ import annotations

import importlib
import os
import platform
import shutil
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from pathlib import Path

from app.executor import available_cores
from fusion.errors import FusionError
from fusion.open3d_import import import_open3d
from mvs_backends import backend_names, choose_backend, get_backend
from mvs_backends.base import Availability, MvsOptions

_PACKAGES = (
    ("numpy", "numpy"),
    ("numba", "numba"),
    ("opencv-python-headless", "cv2"),
    ("ortools", "ortools.linear_solver.python.model_builder"),
    ("pycolmap", "pycolmap"),
    ("trimesh", "trimesh"),
    ("open3d", "open3d"),
)
"""What is asked for, and a module of it. Another package may bring the module, as pycolmap-cuda12 does."""


def diagnose() -> str:
    """Describe this installation, one fact per line."""
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    lines = [
        f"cityrecon {_version('cityrecon')}, Python {platform.python_version()}, {platform.platform()}",
        f"{available_cores()} cores, {memory_gib:.0f} GiB memory, "
        f"{shutil.disk_usage(Path.cwd()).free / 2**30:.0f} GiB free in {Path.cwd()}",
        "",
        "packages",
    ]
    installed = packages_distributions()
    for wanted, module in _PACKAGES:
        distribution = next(iter(installed.get(module.partition(".")[0], ())), wanted)
        problem = _import_problem(module)
        if problem is not None and module == "open3d":
            problem += " (only `compare` needs it)"
        lines.append(f"  {distribution:24}{_version(distribution):14}{problem or 'works'}")
    lines += ["", "dense back-ends"]
    for name in backend_names():
        try:
            availability = get_backend(name).availability(MvsOptions())
        except ValueError as error:
            availability = Availability(ok=False, reason=str(error))
        lines.append(f"  {name:24}{'yes' if availability.ok else 'no':14}{availability.reason}")
    lines.append(f"  {'auto':24}{'':14}takes {choose_backend('auto', MvsOptions())} here")
    return "\n".join(lines)


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "missing"


def _import_problem(module: str) -> str | None:
    try:
        if module == "open3d":
            import_open3d()
        else:
            importlib.import_module(module)
    except (ImportError, OSError, FusionError) as error:
        return str(error)
    return None
