"""Back-ends of other packages: the example of docs/backends.md, installed as a package would be."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from mvs_backends import backend_names, get_backend
from mvs_backends.base import MvsOptions
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job

DOCS = Path(__file__).parents[2] / "docs" / "backends.md"


def install(folder: Path, code: str, *lines: str) -> None:
    """What an installer leaves of a package with entry points."""
    (folder / "my_package.py").write_text(code, encoding="utf-8")
    info = folder / "my_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("\n".join(["[cityrecon.mvs_backends]", *lines]) + "\n", encoding="utf-8")


def test_the_example_of_the_documentation_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = DOCS.read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    entry = re.search(r'plane-sweep = "(.*)"', text)
    assert code is not None and entry is not None
    assert len(code[1].splitlines()) <= 30
    install(tmp_path, code[1], f"plane-sweep = {entry[1]}", "broken = my_package:Nothing", "number = my_package:np")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert {"patchmatch", "plane-sweep"} <= set(backend_names())
    backend = get_backend("plane-sweep")
    assert backend.availability(MvsOptions()).ok
    job = plane_job(tmp_path / "job", normal=(0.0, 0.0, 1.0))
    backend.estimate(job=job, options=MvsOptions(), num_threads=1)
    depth, normal = read_map(job.depth_map_path(0)), read_map(job.normal_map_path(0))
    assert (depth > 2.0).all() and (depth < 12.0).all()
    np.testing.assert_array_equal(normal[..., 2], -1.0)
    with pytest.raises(ValueError, match="'broken' of my_package:Nothing doesn't load"):
        get_backend("broken")
    with pytest.raises(ValueError, match="'number'"):
        get_backend("number")
