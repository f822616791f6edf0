"""Dense multi-view stereo back-ends.

Other packages add theirs by an entry point of the group `cityrecon.mvs_backends` that names a subclass of `MvsBackend`.
"""

from __future__ import annotations

# Before pycolmap, which holds a zlib of its own: loaded first, parts of it would take the place of the system's, which
# Python, and OpenCV for PNG files, use, and the process would abort.
import zlib  # noqa: F401
from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint, entry_points

from mvs_backends.base import MvsBackend, MvsOptions


def _patchmatch() -> MvsBackend:
    from mvs_backends.patchmatch.backend import PatchMatch

    return PatchMatch()


def _colmap() -> MvsBackend:
    from mvs_backends.colmap import Colmap

    return Colmap()


def _openmvs() -> MvsBackend:
    from mvs_backends.openmvs import OpenMvs

    return OpenMvs()


def _acm(program: str) -> MvsBackend:
    from mvs_backends.acm import Acm

    return Acm(program)


# Whoever only wants to know names or options waits for none of them to be loaded.
_BUILT_IN: dict[str, Callable[[], MvsBackend]] = {
    "patchmatch": _patchmatch,
    "colmap": _colmap,
    "openmvs": _openmvs,
    **{program.lower(): partial(_acm, program) for program in ("ACMP", "ACMH", "ACMM", "ACMMP")},
}


def backend_names() -> tuple[str, ...]:
    """Names of back-ends: our own, then those of other packages."""
    return (*_BUILT_IN, *(name for name in sorted(_entry_points()) if name not in _BUILT_IN))


def choose_backend(name: str, options: MvsOptions) -> str:
    """The name itself, but for `auto`: `colmap` if CUDA really works here, else `patchmatch`."""
    if name != "auto":
        return name
    return "colmap" if get_backend("colmap").availability(options).ok else "patchmatch"


def get_backend(name: str) -> MvsBackend:
    """The back-end of that name.

    Raises:
        ValueError: no such back-end, or another package's doesn't load.
    """
    if name in _BUILT_IN:
        return _BUILT_IN[name]()
    found = _entry_points().get(name)
    if found is None:
        raise ValueError(f"no back-end {name!r}; choose one of: auto, {', '.join(backend_names())}")
    try:
        backend = found.load()
    except (ImportError, AttributeError) as error:
        raise ValueError(f"back-end {name!r} of {found.value} doesn't load: {error}") from error
    if not (isinstance(backend, type) and issubclass(backend, MvsBackend)):
        raise ValueError(f"back-end {name!r}: {found.value} is no subclass of MvsBackend")
    return backend()


def _entry_points() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group="cityrecon.mvs_backends")}
