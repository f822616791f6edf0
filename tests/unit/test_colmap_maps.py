"""Maps are in the order in which COLMAP reads them; the end-to-end test sees that its fusion finds the same normals."""

from pathlib import Path

import numpy as np
import pycolmap

from mvs_backends.colmap_maps import write_map
from tests.reference.colmap_maps import read_map


def test_colmap_reads_the_depths(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).random((3, 5), dtype=np.float32)
    write_map(tmp_path / "depth.bin", depth)
    read = pycolmap.DepthMap()
    read.read(tmp_path / "depth.bin")
    np.testing.assert_array_equal(read.to_array(), depth)


def test_normals_are_three_planes(tmp_path: Path) -> None:
    normal = np.random.default_rng(0).random((3, 5, 3), dtype=np.float32)
    write_map(tmp_path / "normal.bin", normal)
    np.testing.assert_array_equal(read_map(tmp_path / "normal.bin"), normal)
    assert (tmp_path / "normal.bin").read_bytes().endswith(normal[..., 2].tobytes())
