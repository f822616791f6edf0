"""The sparse model that Structure-from-Motion would make of a rendered street, from the truth instead of by matching.

Keypoints are those that SIFT finds in the rendered images, so plain walls have none. A track joins detections of
different images that lie within a pixel of the projection of the same spot, where it is visible and seen at a similar
angle and scale, as a descriptor needs it. Points get the error that triangulation from pixels with noise has, and some
are wrong matches: anywhere along a ray.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.scene.posed_scene import PosedScene
from app.scene.read_model import read_posed_scene
from sample_data.render_street import StreetTruth
from sample_data.street_camera import Camera, Pose

Floats = NDArray[np.float64]

NUM_FEATURES = 1000
CONTRAST_THRESHOLD = 0.02
MATCH_RADIUS_PX = 1.0
DEPTH_TOLERANCE = 0.02
MAX_ANGLE_DEG = 40.0
MAX_SCALE_RATIO = 2.0
MATCHED_SHARE = 0.8
PIXEL_NOISE_PX = 0.5
MIN_TRIANGULATION_ANGLE_DEG = 1.5
OUTLIER_SHARE = 0.01


@dataclass(frozen=True, kw_only=True)
class SparseStreet:
    """A sparse model and the truth behind it."""

    scene: PosedScene
    true_points: Floats
    """(P, 3) where the points really are; not a number for wrong matches."""


@dataclass
class _Points:
    """Spots on surfaces with their first view."""

    positions: Floats
    towards: Floats
    """Unit vectors to the camera that saw them first."""
    distances: Floats


def sparse_street(truth: StreetTruth, seed: int) -> SparseStreet:
    """Make a sparse model.

    Args:
        truth: A drive through a town.
        seed: Of the noise; the keypoints follow from the images.
    """
    rng = np.random.default_rng([seed, 3])
    names_and_poses = sorted(truth.images())
    names, poses = tuple(name for name, _ in names_and_poses), [pose for _, pose in names_and_poses]
    points = _Points(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    observed: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for row in sorted(range(len(names)), key=lambda row: (names[row].split("/")[1], names[row])):
        found = _match(points, truth, poses[row], rng)
        observed.append((found, np.full(len(found), row)))
    point_rows, image_rows = (np.concatenate(parts) for parts in zip(*observed, strict=True))
    centers = np.stack([pose.center for pose in poses])
    pairs = np.unique(np.stack([point_rows, image_rows], axis=1), axis=0)
    noisy, true, pairs = _triangulated(points.positions, pairs, centers, truth.camera.focal_px, rng)
    with tempfile.TemporaryDirectory() as folder:
        _write_model(Path(folder), names, poses, truth.camera, noisy, pairs)
        scene = read_posed_scene(Path(folder))
    return SparseStreet(scene=scene, true_points=true[scene.point_ids - 1])


def _match(points: _Points, truth: StreetTruth, pose: Pose, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of the points that an image observes; spots that no image before has seen are added to them."""
    camera = truth.camera
    depth, _ = truth.renderer.depth_map(camera, pose)
    pixels = _detect(truth.renderer.image(camera, pose))
    column, line = pixels[:, 0].astype(int), pixels[:, 1].astype(int)
    low, high = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    on_surface = (low[line, column] > 0) & (high[line, column] < 1.05 * low[line, column])
    pixels, column, line = pixels[on_surface], column[on_surface], line[on_surface]
    ahead = np.column_stack([(pixels - (camera.width / 2, camera.height / 2)) / camera.focal_px, np.ones(len(pixels))])
    spots = (ahead * depth[line, column, None] - pose.translation) @ pose.rotation

    candidates = _candidates(points, camera, pose, depth)
    found = np.full(len(spots), -1)
    if len(candidates) and len(pixels):
        projected = _project(points.positions[candidates], camera, pose)[:, :2]
        distances = np.linalg.norm(projected[:, None] - pixels[None], axis=2)
        nearest = distances.argmin(axis=1)
        distance = distances[np.arange(len(candidates)), nearest]
        matched = (distance < MATCH_RADIUS_PX) & (rng.random(len(candidates)) < MATCHED_SHARE)
        # The closest one comes last and stays.
        order = np.argsort(-distance, kind="stable")
        order = order[matched[order]]
        found[nearest[order]] = candidates[order]
    new = found < 0
    found[new] = len(points.positions) + np.arange(new.sum())
    towards = pose.center - spots[new]
    lengths = np.linalg.norm(towards, axis=1)
    points.positions = np.concatenate([points.positions, spots[new]])
    points.towards = np.concatenate([points.towards, towards / lengths[:, None]])
    points.distances = np.concatenate([points.distances, lengths])
    return np.asarray(found, dtype=np.int64)


def _detect(image: NDArray[np.uint8]) -> Floats:
    """(n, 2) keypoints, the centre of the top-left pixel at (0.5, 0.5)."""
    keypoints = cv2.SIFT_create(NUM_FEATURES, contrastThreshold=CONTRAST_THRESHOLD).detect(image)
    pixels = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2) + 0.5
    inside = np.all((pixels >= 0) & (pixels < (image.shape[1], image.shape[0])), axis=1)
    return np.unique(pixels[inside], axis=0)


def _project(positions: Floats, camera: Camera, pose: Pose) -> Floats:
    """(n, 3) pixels and depths."""
    in_camera = positions @ pose.rotation.T + pose.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = camera.focal_px * in_camera[:, :2] / in_camera[:, 2:] + (camera.width / 2, camera.height / 2)
    return np.column_stack([pixels, in_camera[:, 2]])


def _candidates(points: _Points, camera: Camera, pose: Pose, depth: NDArray[np.float32]) -> NDArray[np.int64]:
    """Rows of the points that are visible in an image at a similar angle and scale as where they were seen first."""
    projected = _project(points.positions, camera, pose)
    inside = (projected[:, 2] > 0.1) & np.all(projected[:, :2] >= 0, axis=1)
    inside &= (projected[:, 0] < camera.width) & (projected[:, 1] < camera.height)
    rows = np.flatnonzero(inside)
    column, line = projected[rows, 0].astype(int), projected[rows, 1].astype(int)
    seen = np.abs(depth[line, column] - projected[rows, 2]) < DEPTH_TOLERANCE * projected[rows, 2]
    rows = rows[seen]
    towards = pose.center - points.positions[rows]
    distances = np.linalg.norm(towards, axis=1)
    cosine = np.einsum("ij,ij->i", towards, points.towards[rows]) / distances
    ratio = np.maximum(distances / points.distances[rows], points.distances[rows] / distances)
    return rows[(cosine > np.cos(np.radians(MAX_ANGLE_DEG))) & (ratio < MAX_SCALE_RATIO)]


def _triangulated(
    positions: Floats, pairs: NDArray[np.int64], centers: Floats, focal_px: float, rng: np.random.Generator
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Positions with noise, true positions, and observations (point, image) of the points that can be triangulated.

    The noise has the covariance of the least squares of all rays: a pixel's noise across each ray, none along it.
    """
    rays = positions[pairs[:, 0]] - centers[pairs[:, 1]]
    distances = np.linalg.norm(rays, axis=1)
    rays /= distances[:, None]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    information = np.zeros((len(positions), 3, 3))
    np.add.at(information, pairs[:, 0], across * (focal_px / (PIXEL_NOISE_PX * distances))[:, None, None] ** 2)
    mean_ray = np.zeros((len(positions), 3))
    np.add.at(mean_ray, pairs[:, 0], rays)
    mean_ray /= np.maximum(np.linalg.norm(mean_ray, axis=1, keepdims=True), 1e-12)
    widest = np.zeros(len(positions))
    np.maximum.at(widest, pairs[:, 0], np.arccos(np.clip(np.einsum("ij,ij->i", rays, mean_ray[pairs[:, 0]]), -1, 1)))
    is_wide = 2 * np.degrees(widest) > MIN_TRIANGULATION_ANGLE_DEG
    kept = is_wide & (np.bincount(pairs[:, 0], minlength=len(positions)) >= 2)
    pairs, number = pairs[kept[pairs[:, 0]]], np.cumsum(kept) - 1
    true = positions[kept].copy()
    variance, axes = np.linalg.eigh(information[kept])
    noise = np.einsum("nij,nj->ni", axes, rng.standard_normal(true.shape) / np.sqrt(variance))
    noisy = true + noise
    pairs[:, 0] = number[pairs[:, 0]]
    wrong = np.flatnonzero(rng.random(len(true)) < OUTLIER_SHARE)
    first = np.searchsorted(pairs[:, 0], wrong)
    center = centers[pairs[first, 1]]
    noisy[wrong] = center + (true[wrong] - center) * np.exp(rng.uniform(-0.7, 0.7, (len(wrong), 1)))
    true[wrong] = np.nan
    rank = np.arange(len(pairs)) - np.searchsorted(pairs[:, 0], pairs[:, 0])
    pairs = pairs[~np.isin(pairs[:, 0], wrong) | (rank < 2)]
    return noisy, true, pairs


def _write_model(
    folder: Path, names: tuple[str, ...], poses: list[Pose], camera: Camera, positions: Floats, pairs: NDArray[np.int64]
) -> None:
    """Write a COLMAP model whose points have their row + 1 as ID; observations have no pixels, which nobody reads."""
    model = pycolmap.Reconstruction()
    intrinsics = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=camera.width, height=camera.height, params=list(camera.params)
    )
    model.add_camera_with_trivial_rig(intrinsics)
    slots = np.empty(len(pairs), dtype=np.int64)
    for row, (name, pose) in enumerate(zip(names, poses, strict=True)):
        here = np.flatnonzero(pairs[:, 1] == row)
        slots[here] = np.arange(len(here))
        image = pycolmap.Image(name, np.zeros((len(here), 2)), 1, row + 1)
        rotation = pycolmap.Rotation3d(pose.rotation)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, pose.translation))
    bounds = np.searchsorted(pairs[:, 0], np.arange(len(positions) + 1)).tolist()
    images = (pairs[:, 1] + 1).tolist()
    for row, position in enumerate(positions):
        track = pycolmap.Track()
        for element in range(bounds[row], bounds[row + 1]):
            track.add_element(images[element], int(slots[element]))
        color = np.full(3, 128, dtype=np.uint8)
        model.add_point3D_with_id(row + 1, pycolmap.Point3D(xyz=position, color=color, track=track))
    model.write_binary(folder)
