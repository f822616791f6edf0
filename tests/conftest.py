"""What tests of all kinds share."""

from __future__ import annotations

from types import ModuleType

import pytest

from fusion.errors import FusionError
from fusion.open3d_import import import_open3d


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """Open3D; what asks for it is skipped on a machine that lacks its system libraries."""
    try:
        return import_open3d()
    except FusionError as error:
        pytest.skip(str(error))
