"""Dense multi-view stereo back-ends."""

from __future__ import annotations

from mvs_backends.base import MvsBackend
from mvs_backends.patchmatch.backend import PatchMatch

_BACKENDS: dict[str, type[MvsBackend]] = {PatchMatch.name: PatchMatch}

BACKEND_NAMES = tuple(_BACKENDS)
"""Valid back-end names."""


def get_backend(name: str) -> MvsBackend:
    """The back-end of that name.

    Raises:
        ValueError: no such back-end.
    """
    if name not in _BACKENDS:
        raise ValueError(f"no back-end {name!r}; choose one of: {', '.join(BACKEND_NAMES)}")
    return _BACKENDS[name]()
