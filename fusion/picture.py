"""Pictures of clouds, drawn without a graphics library: points are splatted into a depth buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.cloud import PointCloud
from fusion.errors import FusionError

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]

_SUPERSAMPLING = 2
_MAX_SPLAT_PX = 13
_FILL_ROUNDS = 2
_FIELD_OF_VIEW = 0.6
_FIT_SAMPLES, _OUTLIERS_PERCENT = 200_000, 0.5
_MARGIN = 1.04
_SHADING = 1.6
_BACKGROUND = (28, 24, 22)
_TEXT = (235, 235, 235)
_TITLE_PX, _LEGEND_PX = 34, 46


class View(StrEnum):
    """Where a picture is taken from."""

    TOP = "top"
    """Straight from above, parallel; x to the right, y up."""
    OBLIQUE = "oblique"
    """From the south-west and above, in perspective."""


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """How a picture looks."""

    width_px: int = 1200
    height_px: int = 800
    azimuth_deg: float = 235.0
    """Direction from the scene to the eye for oblique views, counter-clockwise from east."""
    elevation_deg: float = 38.0
    """Height of the eye above the horizon for oblique views."""
    shading: bool = True
    """Darken points that lie behind their neighbours in the picture, which shows shape."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("width_px", "height_px"):
            if getattr(self, name) < 16:
                raise ValueError(f"{name} must be at least 16")
        if not 0 < self.elevation_deg < 90:
            raise ValueError("elevation_deg must lie between 0 and 90")


@dataclass(frozen=True)
class Projection:
    """Maps the world into a picture; shared by pictures that are to be compared."""

    axes: Floats
    """(3, 3) rows: right, down, forward."""
    eye: Floats
    """(3,) where the view is from; for a parallel view only its direction matters."""
    scale_px: float
    """Pixels per metre for a parallel view; focal length in pixels for a perspective one."""
    perspective: bool
    center_px: tuple[float, float]

    def project(self, points: NDArray[np.float32]) -> tuple[Floats, Floats, Floats]:
        """Return x, y (pixel centres at .5) and depth, each (N,); depth is not positive behind the eye."""
        local = (points.astype(np.float64) - self.eye) @ self.axes.T
        depth = local[:, 2]
        factor = self.scale_px / np.where(depth > 0, depth, np.inf) if self.perspective else self.scale_px
        return self.center_px[0] + factor * local[:, 0], self.center_px[1] + factor * local[:, 1], depth


def fit_projection(points: NDArray[np.float32], view: View, options: PictureOptions) -> Projection:
    """Place the eye so that all but a few outlying points fill the picture."""
    if len(points) == 0:
        raise FusionError("a cloud without points can't be drawn")
    azimuth, elevation = np.radians([options.azimuth_deg, options.elevation_deg])
    if view is View.TOP:
        axes = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    else:
        back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        axes = np.stack([right, np.cross(-back, right), -back])
    size = np.array([options.width_px, options.height_px], dtype=np.float64)
    center = (float(size[0]) / 2, float(size[1]) / 2)
    local = points[:: max(1, len(points) // _FIT_SAMPLES)].astype(np.float64) @ axes.T
    low, high = np.percentile(local, [_OUTLIERS_PERCENT, 100 - _OUTLIERS_PERCENT], axis=0)
    middle = (low + high) / 2
    local -= middle
    if view is View.TOP:
        reach = np.maximum(high - low, 0.1)[:2] * _MARGIN
        eye = middle + [0.0, 0.0, local[:, 2].min() - 1.0]
        return Projection(axes, eye @ axes, float((size / reach).min()), False, center)
    focal = float(size[0]) / _FIELD_OF_VIEW
    needed = (focal * np.abs(local[:, :2]) * _MARGIN / (size / 2)).max(axis=1) - local[:, 2]
    distance = max(float(np.percentile(needed, 100 - _OUTLIERS_PERCENT)), 0.5)
    return Projection(axes, (middle - [0.0, 0.0, distance]) @ axes, focal, True, center)


def _spacing_m(points: NDArray[np.float32]) -> float:
    """Typical distance between neighbours: from the area of voxels that hold several points each."""
    step = max(1, len(points) // _FIT_SAMPLES)
    samples = points[::step].astype(np.float64)
    low, high = np.percentile(samples, [1, 99], axis=0)
    extent = max(float(np.linalg.norm(high - low)), 1e-6)
    voxel = extent / 500
    while True:
        cells = np.floor((samples - low) / voxel).astype(np.int64)
        occupied = len(np.unique((cells[:, 0] * 73856093) ^ (cells[:, 1] * 19349663) ^ (cells[:, 2] * 83492791)))
        if len(samples) >= 6 * occupied or voxel > extent / 8:
            return voxel * float(np.sqrt(occupied / len(points)))
        voxel *= 1.4


def splat(
    projection: Projection, points: NDArray[np.float32], shape: tuple[int, int], spacing_m: float
) -> tuple[NDArray[np.int64], Floats]:
    """Find which point each pixel shows.

    Args:
        projection: From world to pixels.
        points: (N, 3).
        shape: Height and width.
        spacing_m: Points are drawn as squares of about this size.

    Returns:
        Index of the nearest point, -1 for none, and its depth, infinite for none; both of the given shape.
    """
    x, y, depth = projection.project(points)
    size = spacing_m * projection.scale_px / (np.maximum(depth, 1e-9) if projection.perspective else 1.0)
    size = np.broadcast_to(np.clip(np.rint(size), 1, _MAX_SPLAT_PX), depth.shape).astype(np.int64)
    nearest = np.full(shape[0] * shape[1], np.iinfo(np.uint64).max, dtype=np.uint64)
    visible = np.flatnonzero((depth > 0) & (x > -8) & (y > -8) & (x < shape[1] + 8) & (y < shape[0] + 8))
    bits = depth[visible].astype(np.float32).view(np.uint32).astype(np.uint64)
    packed = (bits << np.uint64(32)) | visible.astype(np.uint64)
    for side in np.unique(size[visible]):
        mine = size[visible] == side
        here, values = visible[mine], packed[mine]
        left = np.floor(x[here] - (side - 1) / 2).astype(np.int64)
        top = np.floor(y[here] - (side - 1) / 2).astype(np.int64)
        for step_y in range(side):
            for step_x in range(side):
                column, row = left + step_x, top + step_y
                inside = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
                np.minimum.at(nearest, row[inside] * shape[1] + column[inside], values[inside])
    hit = nearest != np.iinfo(np.uint64).max
    index = np.where(hit, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64), -1)
    distance = np.where(hit, (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32), np.inf)
    return index.reshape(shape), distance.astype(np.float64).reshape(shape)


def _fill_holes(color: NDArray[np.float32], depth: NDArray[np.float32]) -> None:
    """Give empty pixels that are mostly surrounded the mean of their neighbours, in place."""
    kernel = np.ones((3, 3), dtype=np.float32)
    for _ in range(_FILL_ROUNDS):
        filled = np.isfinite(depth).astype(np.float32)
        count = cv2.filter2D(filled, -1, kernel, borderType=cv2.BORDER_CONSTANT)
        holes = (filled == 0) & (count >= 5)
        if not holes.any():
            return
        for channel in range(3):
            total = cv2.filter2D(color[..., channel] * filled, -1, kernel, borderType=cv2.BORDER_CONSTANT)
            color[..., channel][holes] = (total / np.maximum(count, 1))[holes]
        total = cv2.filter2D(np.where(filled > 0, depth, 0), -1, kernel, borderType=cv2.BORDER_CONSTANT)
        depth[holes] = (total / np.maximum(count, 1))[holes]


def _shade(depth: NDArray[np.float32], scale_m: float) -> NDArray[np.float32]:
    """Factor 0..1 per pixel: darker where neighbours are nearer to the eye (eye-dome lighting)."""
    solid = np.where(np.isfinite(depth), depth, np.float32(1e9))
    darkness = np.zeros(depth.shape, dtype=np.float32)
    for step_y, step_x in ((0, 2), (2, 0), (0, -2), (-2, 0)):
        moved = np.roll(solid, (step_y, step_x), axis=(0, 1))
        darkness += np.clip((solid - moved) / scale_m, 0, 1.5)
    return np.exp(-_SHADING * darkness / 8)


def _colors_of(cloud: PointCloud) -> Image:
    """The cloud's colours or, without, colours by height; (N, 3) red, green, blue."""
    if cloud.colors is not None:
        return cloud.colors
    z = cloud.points[:, 2]
    low, high = np.percentile(z, [1, 99])
    level = np.rint(255 * np.clip((z - low) / max(float(high - low), 1e-6), 0, 1)).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(level[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1])


def render_cloud(
    cloud: PointCloud,
    *,
    view: View = View.OBLIQUE,
    projection: Projection | None = None,
    options: PictureOptions | None = None,
) -> Image:
    """Draw a cloud.

    Args:
        cloud: What to draw; without colours it is coloured by height.
        view: From where, unless a projection is given.
        projection: From `fit_projection` with the same options, to draw several clouds alike.
        options: Size and look.

    Returns:
        (H, W, 3) image, blue-green-red as OpenCV keeps it.

    Raises:
        FusionError: The cloud has no points.
    """
    options = options or PictureOptions()
    if len(cloud) == 0:
        raise FusionError("a cloud without points can't be drawn")
    chosen = projection or fit_projection(cloud.points, view, options)
    fine = Projection(
        chosen.axes,
        chosen.eye,
        chosen.scale_px * _SUPERSAMPLING,
        chosen.perspective,
        (chosen.center_px[0] * _SUPERSAMPLING, chosen.center_px[1] * _SUPERSAMPLING),
    )
    shape = (options.height_px * _SUPERSAMPLING, options.width_px * _SUPERSAMPLING)
    spacing = _spacing_m(cloud.points)
    index, distance = splat(fine, cloud.points, shape, 1.25 * spacing)
    color = np.empty((*shape, 3), dtype=np.float32)
    color[:] = _BACKGROUND
    hit = index >= 0
    color[hit] = _colors_of(cloud)[index[hit]][:, ::-1]
    depth = distance.astype(np.float32)
    _fill_holes(color, depth)
    if options.shading and np.isfinite(depth).any():
        typical = float(np.median(depth[np.isfinite(depth)]))
        metres_per_px = typical / fine.scale_px if fine.perspective else 1 / fine.scale_px
        solid = np.isfinite(depth)
        color[solid] *= _shade(depth, 12 * metres_per_px)[solid, None]
    small = cv2.resize(color, (options.width_px, options.height_px), interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(np.clip(small, 0, 255)), dtype=np.uint8)


def _with_title(image: Image, title: str) -> Image:
    """Put a line of text above an image."""
    bar = np.full((_TITLE_PX, image.shape[1], 3), _BACKGROUND, dtype=np.uint8)
    plain = title.encode("ascii", errors="replace").decode("ascii")
    cv2.putText(bar, plain, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.65, _TEXT, 1, cv2.LINE_AA)
    return np.concatenate([bar, image])


def _write_png(path: Path, image: Image) -> None:
    """Write an image as PNG, whatever the file's name."""
    _, data = cv2.imencode(".png", image)
    path.write_bytes(data.tobytes())


def draw_side_by_side(
    path: Path,
    clouds: Sequence[tuple[str, PointCloud]],
    *,
    views: Sequence[View] = (View.OBLIQUE, View.TOP),
    options: PictureOptions | None = None,
) -> None:
    """Write a PNG with one column per titled cloud and one row per view; all are drawn from where the first fits.

    Raises:
        FusionError: One of the clouds has no points.
        OSError: The file can't be written.
    """
    options = options or PictureOptions()
    rows: list[Image] = []
    for view in views:
        projection = fit_projection(clouds[0][1].points, view, options)
        cells = [render_cloud(cloud, projection=projection, options=options) for _, cloud in clouds]
        gap = np.full((options.height_px, 6, 3), 255, dtype=np.uint8)
        if not rows:
            cells = [_with_title(cell, title) for cell, (title, _) in zip(cells, clouds, strict=True)]
            gap = np.full((options.height_px + _TITLE_PX, 6, 3), 255, dtype=np.uint8)
        rows.append(np.concatenate([part for cell in cells for part in (gap, cell)][1:], axis=1))
    _write_png(path, np.concatenate(rows))


def error_colors(distances_m: NDArray[np.float32], max_error_m: float) -> Image:
    """Colours (N, 3) red, green, blue for distances (N,): from blue for none to red at the maximum and beyond."""
    level = np.rint(255 * (0.1 + 0.85 * np.clip(distances_m / max_error_m, 0, 1))).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1])


def draw_errors(
    path: Path,
    cloud: PointCloud,
    distances_m: NDArray[np.float32],
    *,
    max_error_m: float = 0.20,
    title: str = "distance to the reference",
    view: View = View.OBLIQUE,
    options: PictureOptions | None = None,
) -> None:
    """Write a PNG of a cloud coloured by each point's distance (N,) from a reference, with a legend.

    Raises:
        FusionError: The cloud has no points.
        OSError: The file can't be written.
    """
    options = options or PictureOptions()
    colored = PointCloud(cloud.points, None, error_colors(distances_m, max_error_m))
    image = render_cloud(colored, view=view, options=options)
    legend = np.full((_LEGEND_PX, options.width_px, 3), _BACKGROUND, dtype=np.uint8)
    left, right = options.width_px // 10, options.width_px * 9 // 10
    ramp = error_colors(np.linspace(0, max_error_m, right - left).astype(np.float32), max_error_m)
    legend[6:18, left:right] = ramp[None, :, ::-1]
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = int(left + share * (right - left))
        text = f"{100 * share * max_error_m:g} cm" + (" or more" if share == 1.0 else "")
        cv2.putText(legend, text, (x - 20, 38), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    _write_png(path, np.concatenate([_with_title(image, title), legend]))
