"""Crop clouds to their cells and stream them into one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from fusion.cloud import PlyWriter, PointCloud, read_ply_chunks
from fusion.region import GroundRegion


def crop_cloud(cloud: PointCloud, region: GroundRegion) -> PointCloud:
    """The points in a region's cells. Cells tile the plane, so clouds cropped to disjoint regions don't overlap."""
    return cloud.select(region.contains(cloud.points))


def merge_clouds(clouds: Sequence[Path], output: Path, *, progress: Callable[[int, int], None] | None = None) -> int:
    """Write several clouds, all with normals and colours, into one PLY file, a piece at a time.

    Returns:
        Number of points written.

    Raises:
        CloudFormatError: a cloud can't be read.
    """
    with PlyWriter(output, has_normals=True, has_colors=True) as writer:
        for done, path in enumerate(clouds, start=1):
            for chunk in read_ply_chunks(path):
                writer.append(chunk)
            if progress is not None:
                progress(done, len(clouds))
    return writer.n_points
