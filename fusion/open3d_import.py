"""Open3D on demand: its shared library needs packages that a bare machine lacks."""

from __future__ import annotations

import importlib
from types import ModuleType

from fusion.errors import FusionError

_PACKAGES = "libegl1 libgl1 libx11-6 libusb-1.0-0 libudev1 libidn2-0"


def import_open3d() -> ModuleType:
    """Return the module `open3d`.

    Raises:
        FusionError: It can't be loaded; the message names the system packages that it needs.
    """
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FusionError(
            f"Open3D can't be loaded ({reason}); install what it needs: apt install {_PACKAGES}"
        ) from error
