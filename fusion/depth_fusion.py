"""Depth and normal maps of one COLMAP dense workspace -> one coloured cloud with normals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.cloud import PointCloud, read_ply
from fusion.errors import FusionError


@dataclass(frozen=True, kw_only=True)
class FusionOptions:
    """When depth maps of several views agree on a point; names as in COLMAP's stereo fusion."""

    min_num_pixels: int = 2
    """Views that must agree on a point. Two, since selection leaves little redundancy and the maps are filtered
    already: on the sample street, three gain 3 points of accuracy at 5 cm, and lose 9 of completeness and 6 of F."""
    max_reproj_error_px: float = 1.0
    """Largest distance between a pixel and the reprojection of its neighbour view's point. COLMAP's 2 merges
    neighbouring pixels: on the sample street it halves the points, and costs 2 of F at 5 cm."""
    max_depth_error: float = 0.005
    """Largest relative difference of depths. COLMAP's 0.01, with 15 degrees between normals, costs 4 points of F at
    5 cm where poses are exact; much less than this loses points where they aren't."""
    max_normal_error_deg: float = 10.0
    """Largest angle between normals."""
    voxel_m: float = 0.0
    """Keep one point in each voxel of this size, the one nearest its centre: fewer points, and a density that depends
    less on which views a cluster has. 0: keep all."""

    def __post_init__(self) -> None:
        if self.min_num_pixels < 1:
            raise ValueError(f"min_num_pixels must be at least 1, not {self.min_num_pixels}")
        for name in ("max_reproj_error_px", "max_depth_error", "max_normal_error_deg"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be greater than 0, not {getattr(self, name)}")
        if not 0 <= self.voxel_m < float("inf"):
            raise ValueError(f"voxel_m must be at least 0, not {self.voxel_m}")


def fuse_depth_maps(
    workspace: Path, output: Path, *, options: FusionOptions, bounds: NDArray[np.float64]
) -> PointCloud:
    """Fuse all depth maps of a workspace by COLMAP's stereo fusion (Schoenberger et al. 2016, section 4.6).

    One thread: with more, COLMAP's order of points depends on timing.

    Args:
        workspace: COLMAP dense workspace with `stereo/fusion.cfg` and `geometric` maps.
        output: scratch PLY file.
        options: agreement of views.
        bounds: (2, 3) minimum and maximum corner of the region of interest, world frame.

    Returns:
        The cloud; empty if the views agree on no point.

    Raises:
        FusionError: a map is missing, or the workspace is unreadable.
    """
    import pycolmap  # here, as those who only want to know the options needn't wait for it

    # COLMAP leaves out views without maps.
    for name in (workspace / "stereo" / "fusion.cfg").read_text(encoding="utf-8").rstrip("\n").split("\n"):
        for kind in ("depth_maps", "normal_maps"):
            path = workspace / "stereo" / kind / f"{name}.geometric.bin"
            if not path.exists():
                raise FusionError(f"{path} is missing; remove {workspace} and run densify again")
    fusion = pycolmap.StereoFusionOptions()
    fusion.num_threads = 1
    fusion.min_num_pixels = options.min_num_pixels
    fusion.max_reproj_error = options.max_reproj_error_px
    fusion.max_depth_error = options.max_depth_error
    fusion.max_normal_error = options.max_normal_error_deg
    fusion.bounding_box = (bounds[0], bounds[1])
    try:
        fused = pycolmap.stereo_fusion(
            str(output), str(workspace), input_type="geometric", options=fusion, output_type="PLY"
        )
    except (ValueError, RuntimeError) as error:
        raise FusionError(f"{workspace}: stereo fusion failed: {error}") from error
    if fused.num_points3D() == 0:
        nothing = np.empty((0, 3), dtype=np.float32)
        return PointCloud(nothing, nothing, np.empty((0, 3), dtype=np.uint8))
    return read_ply(output)
