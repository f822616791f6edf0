"""The part of each pixel's ray that lies in the region of interest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsJob, MvsView

_RANGE_MARGIN = 0.02


def depth_range(
    view: MvsView, boxes_in_world: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths at which each pixel's ray enters and leaves the region.

    Args:
        view: the camera.
        boxes_in_world: (B, 2, 3) minimum and maximum corners; the region is their union.
        width: columns of the result, which may be a reduced image of the view.
        height: rows of the result.

    Returns:
        Two (height, width) arrays of camera z, entry and exit, both 0 where the ray misses all boxes. Where it passes
        several boxes they are the first entry and the last exit. The entry is 0 for a camera inside a box.
    """
    columns = (np.arange(width) + 0.5) * (view.width / width)
    rows = (np.arange(height)[:, None] + 0.5) * (view.height / height)
    rotation, translation = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    # Scaled so that the ray parameter is camera z.
    ray_from_pixel = rotation.T @ np.linalg.inv(view.calibration)
    center = -rotation.T @ translation
    entry = np.full((height, width), np.inf)
    leave = np.zeros((height, width))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = [1.0 / (along_x * columns + (along_y * rows + rest)) for along_x, along_y, rest in ray_from_pixel]
        for box in boxes_in_world:
            near, far = np.zeros((height, width)), np.full((height, width), np.inf)
            for (low, high), per_depth in zip((box - center).T, inverse, strict=True):
                # A ray within a slab's face gives 0 * inf = NaN there, which fmin and fmax pass over.
                first, second = low * per_depth, high * per_depth
                np.fmax(near, np.fmin(first, second), out=near)
                np.fmin(far, np.fmax(first, second), out=far)
            hit = far > near
            np.minimum(entry, near, out=entry, where=hit)
            np.maximum(leave, far, out=leave, where=hit)
    entry[leave <= 0] = 0.0
    return entry, leave


def view_depth_range(job: MvsJob, view: int) -> tuple[float, float] | None:
    """Least and greatest depth at which a view can see the region.

    For a camera inside the region the least is half of that of the nearest sparse point, or a hundredth of the greatest
    without one.

    Returns:
        Camera z, or None where no ray meets the region.
    """
    camera = job.views[view]
    entry, leave = depth_range(camera, job.boxes_in_world, max(camera.width // 8, 1), max(camera.height // 8, 1))
    hit = leave > 0
    if not hit.any():
        return None
    far = float(leave[hit].max())
    near = float(entry[hit].min())
    if near <= 0.0:
        points = job.points_in_world[job.point_views[view]]
        depths = points @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        depths = depths[depths > 0.0]
        near = 0.5 * float(depths.min()) if len(depths) else 0.01 * far
    # A few rays stand for all.
    return (1 - _RANGE_MARGIN) * min(near, 0.5 * far), (1 + _RANGE_MARGIN) * far


def usable_views(job: MvsJob) -> dict[int, tuple[int, ...]]:
    """Views that can see the region and share something with another such view.

    Returns:
        Source views of each, best first, those that can't be used left out.
    """
    left = {view: s for view, s in enumerate(job.sources) if view_depth_range(job, view) is not None}
    usable: dict[int, tuple[int, ...]] = {}
    while left != usable:
        usable = left
        left = {view: tuple(source for source in sources if source in usable) for view, sources in usable.items()}
        left = {view: sources for view, sources in left.items() if sources}
    return usable
