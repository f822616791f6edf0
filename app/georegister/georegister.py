"""The georegister stage: turn, scale and move a model until z is up and its unit a metre, in ENU if there is GPS."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.capture.inventory import Inventory
from app.errors import CityReconError, InputError
from app.georegister.alignment import PlanarFit, fit_planar, fit_spatial, robust_line_sigma
from app.georegister.frames import ModelFrames, model_frames
from app.georegister.georeference import (
    Georeference,
    GravitySource,
    Residuals,
    ScaleCandidate,
    ScaleSource,
)
from app.georegister.gravity import (
    GroundPlane,
    UpTerm,
    angle_deg,
    direction_term,
    find_ground,
    ground_term,
    heights_term,
    solve_up,
    up_from_cameras,
)
from app.georegister.options import GeoregisterOptions
from app.georegister.scale import frame_spacing, scale_from_rig
from app.scene.posed_scene import PosedScene
from app.scene.read_model import read_posed_scene

logger = logging.getLogger(__name__)

ENU_CRS = "ENU at origin (EPSG:4979)"
LOCAL_CRS = "local"
_CAMERA_HEIGHT_SIGMA = 0.05
_MAX_SCALE_SIGMA = 0.25
_MAX_TRUSTED_TILT_SIGMA_DEG = 5.0
_MAX_DISAGREEMENT_DEG = 15.0
_MIN_GPS_FRAMES = 3
_MIN_HEIGHTS = 5
_CONFLICT_SIGMAS = 4.0
_MIN_SHARE = 0.1
_MIN_FITTING = 0.7
_MAX_OUTLIER_NAMES = 100


@dataclass(frozen=True, kw_only=True)
class _Gps:
    """GPS of the model's frames in ENU. G frames."""

    rows: NDArray[np.int64]
    """(G,) frames with GPS."""
    enu_m: NDArray[np.float64]
    """(G, 3), height NaN where unknown."""
    origin_deg_m: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class _Up:
    """The up direction in the model's frame."""

    direction: NDArray[np.float64]
    sigma_deg: float
    source: GravitySource
    ground: GroundPlane | None


def georegister(
    model_dir: Path,
    inventory: Inventory | None,
    output: Path,
    *,
    options: GeoregisterOptions,
    rig_file: Path | None = None,
) -> Georeference:
    """Write `output/model/` (COLMAP binary; z up, metres where the scale is known) and `output/georeference.json`.

    Up, scale and the rest are found one after the other, each from all sources there are, weighted by their
    uncertainty: up from GPS heights, the cameras' attitude and the ground under them; scale from the one source with
    the smallest uncertainty; yaw and translation from GPS. So a straight drive, about which GPS leaves the roll
    free, comes out level, and 0.3 m of noise over 20 m doesn't tilt a street.

    Args:
        model_dir: COLMAP model.
        inventory: frames with their GPS or known positions; None for a model without.
        output: the stage's folder.
        options: options.
        rig_file: COLMAP's rig_config.json with known extrinsics; the inventory's if None.

    Returns:
        What was found, as written.

    Raises:
        InputError: the model or the rig file can't be used.
        CityReconError: the result can't be written.
    """
    scene = read_posed_scene(model_dir)
    frames = model_frames(scene, inventory)
    gps = _gps(frames)
    up = _find_up(scene, frames, gps, options)
    planar = _level_axes(up.direction) if not options.z_is_up else np.eye(3)[:2]
    gps_fit = None
    if gps is not None:
        gps_fit = _fit_gps(frames, gps, planar, options)
        if gps_fit is None:
            logger.warning("the GPS positions fit no common track, or all lie in one place: GPS is not used")
            gps = None
    rig_path = rig_file if rig_file is not None else inventory.rig_file if inventory is not None else None
    candidates = _scale_candidates(scene, frames, gps_fit, up.ground, rig_path, options)
    spacing = frame_spacing(frames.positions_in_model)
    unscaled = 1.0 / spacing if spacing > 0.0 else 1.0
    scale = candidates[0].metres_per_model_unit if candidates else unscaled
    residuals: Residuals | None = None
    outliers: tuple[str, ...] = ()
    if gps is not None and gps_fit is not None and candidates:
        world_from_model, residuals, outliers = _onto_gps(frames, gps, up, planar, scale, gps_fit, options)
    else:
        gps = None
        world_from_model = _onto_ground(frames, up, planar, scale, options)
    georeference = Georeference(
        crs=ENU_CRS if gps is not None else LOCAL_CRS,
        origin_deg_m=gps.origin_deg_m if gps is not None else None,
        is_metric=bool(candidates),
        scale_source=candidates[0].source if candidates else ScaleSource.NONE,
        gravity_source=up.source,
        gravity_sigma_deg=up.sigma_deg,
        scale_candidates=tuple(candidates),
        world_from_model=tuple(world_from_model.reshape(-1).tolist()),
        camera_height=up.ground.height * scale if up.ground is not None else None,
        residuals=residuals,
        outlier_frames=outliers,
    )
    _log(georeference)
    _write(model_dir, output, world_from_model, georeference)
    return georeference


def _gps(frames: ModelFrames) -> _Gps | None:
    """GPS in metres east, north and up of an origin in its middle."""
    rows = np.array([row for row, frame in enumerate(frames.frames) if frame.gps is not None], dtype=np.int64)
    if not len(rows):
        return None
    if len(rows) < _MIN_GPS_FRAMES:
        logger.warning("only %d registered frames have GPS, at least %d are needed: it is not used", len(rows), 3)
        return None
    geodetic = np.array([frame.gps for frame in frames.frames if frame.gps is not None])
    has_height = np.isfinite(geodetic[:, 2])
    lon = geodetic[0, 1] + (geodetic[:, 1] - geodetic[0, 1] + 180.0) % 360.0 - 180.0
    origin = (
        float(np.median(geodetic[:, 0])),
        float((np.median(lon) + 180.0) % 360.0 - 180.0),
        float(np.median(geodetic[has_height, 2])) if has_height.any() else 0.0,
    )
    geodetic[~has_height, 2] = origin[2]
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    enu = np.array(transform.ellipsoid_to_enu(geodetic, *origin))
    enu[~has_height, 2] = np.nan
    return _Gps(rows=rows, enu_m=enu, origin_deg_m=origin)


def _fit_gps(
    frames: ModelFrames,
    gps: _Gps,
    planar: NDArray[np.float64],
    options: GeoregisterOptions,
    *,
    scale: float | None = None,
) -> PlanarFit | None:
    """Yaw, scale and place of the track, seen from above: ``planar`` is (2, 3), the model's level axes."""
    right = frames.right_in_model[gps.rows] @ planar.T if frames.right_in_model is not None else None
    positions = frames.positions_in_model[gps.rows] @ planar.T
    return fit_planar(positions, gps.enu_m[:, :2], seed=options.seed, right=right, scale=scale)


def _find_up(scene: PosedScene, frames: ModelFrames, gps: _Gps | None, options: GeoregisterOptions) -> _Up:
    if options.z_is_up:
        up = np.array([0.0, 0.0, 1.0])
        ground = find_ground(scene, up, seed=options.seed)
        return _Up(direction=up, sigma_deg=0.0, source=GravitySource.MODEL, ground=ground)
    overruled = _up_from_gps_alone(frames, gps, options)
    cameras = up_from_cameras(frames.upright_from_world, frames.image_cameras)
    source = GravitySource.CAMERAS
    if cameras is not None:
        up, term = cameras
    if overruled is not None and (
        cameras is None or angle_deg(up, overruled[0]) > max(_MAX_DISAGREEMENT_DEG, 4.0 * overruled[1])
    ):
        if cameras is not None:
            logger.warning(
                "the cameras' up direction is %.0f degrees off the one that GPS gives: GPS is used",
                angle_deg(up, overruled[0]),
            )
        up, term = overruled[0], direction_term(*overruled)
        source = GravitySource.GPS
    elif cameras is None:
        return _Up(direction=np.array([0.0, 0.0, 1.0]), sigma_deg=90.0, source=GravitySource.NONE, ground=None)
    ground = find_ground(scene, up, seed=options.seed)
    if ground is not None:
        term = term + ground_term(ground)
        source = GravitySource.CAMERAS_AND_GROUND if source is GravitySource.CAMERAS else source
    up, sigma_deg = solve_up(term, up)
    if gps is not None:
        up, sigma_deg, source = _add_heights(frames, gps, term, up, sigma_deg, source, options)
    # Once more with the better up direction, for the height of the cameras.
    refined = find_ground(scene, up, seed=options.seed) if ground is not None else None
    return _Up(direction=up, sigma_deg=sigma_deg, source=source, ground=refined if refined is not None else ground)


def _up_from_gps_alone(
    frames: ModelFrames, gps: _Gps | None, options: GeoregisterOptions
) -> tuple[NDArray[np.float64], float] | None:
    """Up in the model's frame and its standard deviation in degrees, if the GPS track determines it."""
    if gps is None:
        return None
    known = np.isfinite(gps.enu_m[:, 2])
    fit = fit_spatial(frames.positions_in_model[gps.rows[known]], gps.enu_m[known], seed=options.seed)
    if fit is None or fit.tilt_sigma_deg > _MAX_TRUSTED_TILT_SIGMA_DEG:
        return None
    return fit.rotation.T @ np.array([0.0, 0.0, 1.0]), fit.tilt_sigma_deg


def _add_heights(
    frames: ModelFrames,
    gps: _Gps,
    term: UpTerm,
    up: NDArray[np.float64],
    sigma_deg: float,
    source: GravitySource,
    options: GeoregisterOptions,
) -> tuple[NDArray[np.float64], float, GravitySource]:
    """Weigh in the GPS heights: they tell the tilt along the path well, and across a straight path not at all."""
    known = np.isfinite(gps.enu_m[:, 2])
    if known.sum() < _MIN_HEIGHTS:
        return up, sigma_deg, source
    total = term
    for _ in range(3):
        planar = _level_axes(up)
        positions = frames.positions_in_model[gps.rows]
        fit = _fit_gps(frames, gps, planar, options)
        if fit is None or fit.scale_relative_sigma > _MAX_SCALE_SIGMA:
            return up, sigma_deg, source
        usable = known & fit.inliers
        if usable.sum() < _MIN_HEIGHTS:
            return up, sigma_deg, source
        scaled = positions[usable] * fit.scale
        heights = gps.enu_m[usable, 2]
        inliers, sigma_m = robust_line_sigma(scaled @ planar.T, heights - scaled @ up)
        sigma_m = max(sigma_m, fit.sigma_m)
        total = term + heights_term(scaled, heights, inliers.astype(np.float64), sigma_m)
        up, sigma_deg = solve_up(total, up)
    planar = _level_axes(up)
    others = np.linalg.solve(planar @ total.matrix @ planar.T, planar @ term.matrix @ planar.T)
    share = 1.0 - float(np.trace(others)) / 2.0
    if share > 1.0 - _MIN_SHARE:
        source = GravitySource.GPS
    elif share > _MIN_SHARE and source is not GravitySource.GPS:
        source = GravitySource.GPS_AND_CAMERAS
    return up, sigma_deg, source


def _scale_candidates(
    scene: PosedScene,
    frames: ModelFrames,
    gps_fit: PlanarFit | None,
    ground: GroundPlane | None,
    rig_file: Path | None,
    options: GeoregisterOptions,
) -> list[ScaleCandidate]:
    """All usable sources of scale, the most certain first."""
    found = []
    if options.scale is not None:
        found.append(ScaleCandidate(source=ScaleSource.OPTION, metres_per_model_unit=options.scale, relative_sigma=0.0))
    if gps_fit is not None:
        found.append(
            ScaleCandidate(
                source=ScaleSource.GPS,
                metres_per_model_unit=gps_fit.scale,
                relative_sigma=gps_fit.scale_relative_sigma,
            )
        )
    rig = scale_from_rig(scene, frames, rig_file) if rig_file is not None else None
    if rig is not None:
        found.append(rig)
    known = np.array([row for row, frame in enumerate(frames.frames) if frame.position_m is not None], dtype=np.int64)
    if len(known):
        positions = np.array([frame.position_m for frame in frames.frames if frame.position_m is not None])
        fit = fit_spatial(frames.positions_in_model[known], positions, seed=options.seed)
        if fit is not None:
            found.append(
                ScaleCandidate(
                    source=ScaleSource.POSES,
                    metres_per_model_unit=fit.scale,
                    relative_sigma=fit.scale_relative_sigma,
                )
            )
    if options.camera_height_m is not None:
        if ground is None:
            logger.warning("no ground plane found under the cameras, so the camera height gives no scale")
        else:
            found.append(
                ScaleCandidate(
                    source=ScaleSource.CAMERA_HEIGHT,
                    metres_per_model_unit=options.camera_height_m / ground.height,
                    relative_sigma=_CAMERA_HEIGHT_SIGMA,
                )
            )
    usable = [candidate for candidate in found if candidate.relative_sigma <= _MAX_SCALE_SIGMA]
    return sorted(usable, key=lambda candidate: candidate.relative_sigma)


def _onto_gps(
    frames: ModelFrames,
    gps: _Gps,
    up: _Up,
    planar: NDArray[np.float64],
    scale: float,
    free_fit: PlanarFit,
    options: GeoregisterOptions,
) -> tuple[NDArray[np.float64], Residuals, tuple[str, ...]]:
    """(3, 4) world_from_model onto ENU for a given up direction and scale, its residuals and the outliers' names."""
    positions = frames.positions_in_model[gps.rows]
    fit = free_fit
    if scale != free_fit.scale:
        fixed = _fit_gps(frames, gps, planar, options, scale=scale)
        fit = fixed if fixed is not None else free_fit
    cos, sin = math.cos(fit.yaw_rad), math.sin(fit.yaw_rad)
    rotation = np.vstack((np.array([[cos, -sin], [sin, cos]]) @ planar, up.direction))
    heights = scale * positions @ up.direction
    usable = fit.inliers & np.isfinite(gps.enu_m[:, 2])
    known_heights = bool(usable.any())
    shift = _robust_mean(gps.enu_m[usable, 2] - heights[usable]) if known_heights else -float(np.median(heights))
    vertical = np.abs(gps.enu_m[usable, 2] - heights[usable] - shift)
    transform = np.column_stack((scale * rotation, (fit.offset_m.real, fit.offset_m.imag, shift)))
    horizontal = fit.residuals_m[fit.inliers]
    if fit.lever_m:
        right, ahead = _parts(fit.lever_m)
        logger.info(
            "the GPS antenna is %.2f m %s and %.2f m %s the camera",
            abs(right),
            "right" if right >= 0 else "left",
            abs(ahead),
            "in front of" if ahead >= 0 else "behind",
        )
    residuals = Residuals(
        num_frames=len(gps.rows),
        num_inliers=int(fit.inliers.sum()),
        horizontal_rms_m=float(np.sqrt((horizontal**2).mean())),
        horizontal_median_m=float(np.median(horizontal)),
        horizontal_max_m=float(horizontal.max()),
        vertical_rms_m=float(np.sqrt((vertical**2).mean())) if known_heights else None,
        vertical_median_m=float(np.median(vertical)) if known_heights else None,
        vertical_max_m=float(vertical.max()) if known_heights else None,
        antenna_m=_parts(fit.lever_m) if fit.lever_m else None,
    )
    names = [frames.frames[row].name for row in gps.rows[~fit.inliers]]
    return transform, residuals, tuple(names[:_MAX_OUTLIER_NAMES])


def _onto_ground(
    frames: ModelFrames, up: _Up, planar: NDArray[np.float64], scale: float, options: GeoregisterOptions
) -> NDArray[np.float64]:
    """(3, 4) world_from_model without GPS: first frame over the origin, farthest one along x, ground at z = 0."""
    if options.z_is_up or up.source is GravitySource.NONE:
        return np.column_stack((scale * np.eye(3), np.zeros(3)))
    first = frames.positions_in_model[0]
    track = (frames.positions_in_model - first) @ planar.T
    farthest = track[int(np.argmax(np.linalg.norm(track, axis=1)))]
    length = float(np.linalg.norm(farthest))
    cos, sin = farthest / length if length > 0.0 else (1.0, 0.0)
    rotation = np.vstack((np.array([[cos, sin], [-sin, cos]]) @ planar, up.direction))
    translation = -scale * rotation @ first
    if up.ground is not None:
        translation[2] += scale * up.ground.height
    return np.column_stack((scale * rotation, translation))


def _robust_mean(values: NDArray[np.float64]) -> float:
    """Mean of the values within 3 standard deviations of the median."""
    inliers, _ = robust_line_sigma(np.empty((len(values), 0)), values)
    return float(values[inliers].mean())


def _parts(number: complex) -> tuple[float, float]:
    return number.real, number.imag


def _level_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 3) horizontal axes that make a right-handed frame with ``up``."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = np.cross(helper, up)
    first = first / np.linalg.norm(first)
    return np.stack((first, np.cross(up, first)))


def _log(georeference: Georeference) -> None:
    if georeference.residuals is not None:
        found = georeference.residuals
        logger.info(
            "GPS: %d of %d frames fit, horizontal rms %.2f m, vertical rms %s",
            found.num_inliers,
            found.num_frames,
            found.horizontal_rms_m,
            "unknown" if found.vertical_rms_m is None else f"{found.vertical_rms_m:.2f} m",
        )
        if found.num_inliers < _MIN_FITTING * found.num_frames:
            logger.warning(
                "only %d of %d GPS positions fit the model: one of the two is wrong in places; check the poses before "
                "trusting the cloud",
                found.num_inliers,
                found.num_frames,
            )
    logger.info("up from %s, within about %.1f degrees", georeference.gravity_source, georeference.gravity_sigma_deg)
    for candidate in georeference.scale_candidates:
        logger.info(
            "scale from %s: %.6g m per unit, within about %.1f %%",
            candidate.source,
            candidate.metres_per_model_unit,
            100.0 * candidate.relative_sigma,
        )
    for other in georeference.scale_candidates[1:]:
        used = georeference.scale_candidates[0]
        ratio = other.metres_per_model_unit / used.metres_per_model_unit
        if abs(ratio - 1.0) > _CONFLICT_SIGMAS * math.hypot(used.relative_sigma, other.relative_sigma):
            logger.warning(
                "the scale from %s is %.3f times the one from %s, which is used", other.source, ratio, used.source
            )
    if not georeference.is_metric:
        logger.warning(
            "no GPS, rig baseline, camera height or scale: the model is unscaled; its unit, and that of all sizes, is "
            "the median distance between consecutive frames"
        )
    if georeference.gravity_sigma_deg > _MAX_TRUSTED_TILT_SIGMA_DEG:
        logger.warning(
            "the up direction is uncertain (about %.0f degrees, from %s): blocks may lean",
            georeference.gravity_sigma_deg,
            georeference.gravity_source,
        )


def _write(model_dir: Path, output: Path, world_from_model: NDArray[np.float64], georeference: Georeference) -> None:
    try:
        reconstruction = pycolmap.Reconstruction(model_dir)
    except (OSError, ValueError, RuntimeError, IndexError) as error:
        raise InputError(f"COLMAP can't read the model in {model_dir}: {' '.join(str(error).split())}") from error
    reconstruction.transform(pycolmap.Sim3d(world_from_model))
    try:
        (output / "model").mkdir(parents=True, exist_ok=True)
        reconstruction.write_binary(output / "model")
        georeference.write(output / "georeference.json")
    except (OSError, RuntimeError, ValueError) as error:
        raise CityReconError(f"cannot write {output}: {error}; free some space or choose another workspace") from error
