"""One run of the whole program that several tests look at."""

from __future__ import annotations

from types import ModuleType

import pytest

from tests.small_street import FinishedRun, cityrecon, write_scene


@pytest.fixture(scope="session")
def finished_run(open3d: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """`full --compare-batch` on the small street, which succeeded."""
    run = FinishedRun(tmp_path_factory.mktemp("full"))
    write_scene(run.scene)
    result = cityrecon(*run.full(run.out, "--compare-batch"))
    assert result.returncode == 0, result.stderr
    return run
