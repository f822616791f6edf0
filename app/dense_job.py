"""What one dense job needs, on disk: a self-contained folder from which any machine with the images can work.

``job.json`` holds the region and the cameras as they were before undistortion, ``sparse/`` the undistorted part of the
model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.errors import CityReconError
from app.options import DensifyOptions
from app.scene.point_index import PointIndex
from app.scene.posed_scene import PosedScene
from app.scene.submodel import write_submodel
from app.sky import find_sky, redness_limit, redness_of_sky
from app.workspace import atomic_file
from fusion.region import GroundRegion
from mvs_backends.base import MvsJob, MvsView
from mvs_backends.source_views import choose_source_views

_MAX_SOURCES = 20
"""Per reference view, best first; a back-end takes as many of them as it wants."""


@dataclass(frozen=True, kw_only=True)
class DistortedCamera:
    """A camera as the model has it."""

    model: str
    width: int
    height: int
    params: list[float]

    def camera(self) -> pycolmap.Camera:
        """As COLMAP's camera."""
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=self.params)


@dataclass(frozen=True, kw_only=True)
class JobImage:
    """An image to undistort."""

    name: str
    image_id: int
    camera_id: int
    digest: str
    """Of the image and its mask, so that a change is noticed."""


@dataclass(frozen=True, kw_only=True)
class DenseJob:
    """The images and the region of one dense reconstruction."""

    region: GroundRegion
    cameras: dict[int, DistortedCamera]
    images: tuple[JobImage, ...]

    @classmethod
    def read(cls, folder: Path) -> DenseJob:
        """Read what `write_dense_job` wrote."""
        data = json.loads((folder / "job.json").read_text(encoding="utf-8"))
        region = data["region"]
        region["cells"] = tuple((i, j) for i, j in region["cells"])
        for name in ("origin_m", "cell_size_m", "z_range_m"):
            region[name] = tuple(region[name])
        return cls(
            region=GroundRegion(**region),
            cameras={int(key): DistortedCamera(**camera) for key, camera in data["cameras"].items()},
            images=tuple(JobImage(**image) for image in data["images"]),
        )

    def largest_image_px(self, options: DensifyOptions) -> int:
        """Pixels of the largest of its images once they are reduced as the options say."""
        sizes = [(camera.width, camera.height) for camera in self.cameras.values()]
        limit = options.max_image_size_px
        scales = [min(1.0, limit / max(size)) if limit else 1.0 for size in sizes]
        return max(round(width * height * scale**2) for (width, height), scale in zip(sizes, scales, strict=True))


def write_dense_job(
    folder: Path,
    *,
    scene: PosedScene,
    points: PointIndex,
    image_rows: NDArray[np.int64],
    region: GroundRegion,
    cameras: Sequence[pycolmap.Camera],
    digests: Mapping[str, str],
) -> None:
    """Write a job folder.

    Args:
        folder: to create.
        scene: the posed model.
        points: finds the scene's points.
        image_rows: rows of the scene's images that take part.
        region: what to reconstruct.
        cameras: the model's cameras before undistortion, one per row of the scene's cameras.
        digests: of images and masks, by image name.
    """
    rows = np.sort(image_rows)
    low, high = region.padded_boxes()[:, 0].min(axis=0), region.padded_boxes()[:, 1].max(axis=0)
    point_rows = points.rows_between(low[:2], high[:2])
    heights = scene.points_in_world[point_rows, 2]
    point_rows = point_rows[(heights >= low[2]) & (heights <= high[2])]
    folder.mkdir(parents=True, exist_ok=True)
    write_submodel(scene, rows, point_rows, folder / "sparse")
    images = [
        JobImage(
            name=scene.image_names[row],
            image_id=int(scene.image_ids[row]),
            camera_id=int(scene.camera_index[row]) + 1,
            digest=digests.get(scene.image_names[row], ""),
        )
        for row in rows
    ]
    job = DenseJob(
        region=region,
        cameras={
            camera_id: DistortedCamera(
                model=cameras[camera_id - 1].model.name,
                width=cameras[camera_id - 1].width,
                height=cameras[camera_id - 1].height,
                params=[float(value) for value in cameras[camera_id - 1].params],
            )
            for camera_id in sorted({image.camera_id for image in images})
        },
        images=tuple(images),
    )
    with atomic_file(folder / "job.json") as path:
        path.write_text(json.dumps(asdict(job), indent=1) + "\n", encoding="utf-8")


def prepare_workspace(
    job_folder: Path, workspace: Path, *, image_root: Path, mask_root: Path | None, options: DensifyOptions
) -> MvsJob:
    """Make a COLMAP dense workspace of a job: undistorted images and masks, model, configuration.

    Images that are there already are kept.

    Raises:
        CityReconError: an image can't be read.
    """
    job = DenseJob.read(job_folder)
    undistortion = pycolmap.UndistortCameraOptions()
    undistortion.max_image_size = options.max_image_size_px or -1
    model = pycolmap.Reconstruction(str(job_folder / "sparse"))
    for camera_id, distorted in job.cameras.items():
        undistorted = pycolmap.undistort_camera(undistortion, distorted.camera())
        undistorted.camera_id = camera_id
        model.cameras[camera_id] = undistorted
    (workspace / "sparse").mkdir(parents=True, exist_ok=True)
    model.write_binary(str(workspace / "sparse"))
    mvs_job = _mvs_job(model, job, workspace, has_masks=mask_root is not None or options.skip_sky)
    row_of_name = {view.name: row for row, view in enumerate(mvs_job.views)}
    for image in job.images:
        camera = job.cameras[image.camera_id].camera()
        _undistort_image(image_root / image.name, workspace / "images" / image.name, camera, undistortion)
    redness = redness_limit([_redness_of_sky(mvs_job, row) for row in row_of_name.values()] if options.skip_sky else [])
    for image in job.images:
        camera = job.cameras[image.camera_id].camera()
        unwanted = _sky(mvs_job, row_of_name[image.name], redness)[1] if options.skip_sky else None
        given = mask_root / f"{image.name}.png" if mask_root is not None else None
        _write_mask(workspace / "masks" / f"{image.name}.png", given, unwanted, camera, undistortion)
    _write_stereo_folder(mvs_job)
    return mvs_job


def _undistort_image(
    source: Path, target: Path, camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions
) -> None:
    if target.exists():
        return
    bitmap = pycolmap.Bitmap.read(str(source), as_rgb=True)
    if bitmap is None:
        raise CityReconError(f"cannot read {source}; restore it and run the command again")
    undistorted, _ = pycolmap.undistort_image(options, bitmap, camera)
    _write_image(target, np.asarray(cv2.cvtColor(undistorted.to_array(), cv2.COLOR_RGB2BGR), dtype=np.uint8))


def _redness_of_sky(job: MvsJob, row: int) -> float:
    return redness_of_sky(*_sky(job, row, max_red_over_blue=255))


def _sky(job: MvsJob, row: int, max_red_over_blue: float) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """An undistorted image (H, W, 3), and (H, W) where it shows the sky."""
    view = job.views[row]
    in_camera = job.points_in_world[job.point_views[row]] @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    pixels = in_camera @ view.calibration.T
    read = cv2.imread(str(job.image_path(row)), cv2.IMREAD_COLOR)
    if read is None:
        raise CityReconError(f"cannot read {job.image_path(row)}; remove {job.workspace} and run the command again")
    image = np.asarray(read, dtype=np.uint8)
    return image, find_sky(
        image,
        calibration=view.calibration,
        cam_from_world=view.cam_from_world,
        keypoints_px=pixels[:, :2] / pixels[:, 2:],
        max_red_over_blue=max_red_over_blue,
    )


def _write_mask(
    target: Path,
    given: Path | None,
    unwanted: NDArray[np.bool_] | None,
    camera: pycolmap.Camera,
    options: pycolmap.UndistortCameraOptions,
) -> None:
    """Write what the user's mask, undistorted, and the unwanted pixels leave over: white where depth is wanted."""
    if target.exists():
        return
    masks = [] if unwanted is None else [unwanted]
    if given is not None and given.exists():
        mask = pycolmap.Bitmap.read(str(given), as_rgb=False)
        if mask is None:
            raise CityReconError(f"cannot read mask {given}; restore it and run the command again")
        undistorted, _ = pycolmap.undistort_image(options, mask, camera)
        masks.append(undistorted.to_array() <= 254)
    if masks:
        _write_image(target, np.where(np.any(masks, axis=0), 0, 255).astype(np.uint8))


def _write_image(path: Path, pixels: NDArray[np.uint8]) -> None:
    quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix.lower() in (".jpg", ".jpeg") else []
    ok, encoded = cv2.imencode(path.suffix, pixels, quality)
    if not ok:
        raise CityReconError(f"cannot encode {path}")
    with atomic_file(path) as partial:
        partial.write_bytes(encoded.tobytes())


def _mvs_job(model: pycolmap.Reconstruction, job: DenseJob, workspace: Path, *, has_masks: bool) -> MvsJob:
    point_ids = sorted(model.points3D)
    row_of_point = {point_id: row for row, point_id in enumerate(point_ids)}
    points = np.array([model.points3D[p].xyz for p in point_ids], dtype=np.float64).reshape(-1, 3)
    views, seen = [], []
    for image in sorted((model.images[image.image_id] for image in job.images), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        views.append(
            MvsView(
                name=image.name,
                width=camera.width,
                height=camera.height,
                calibration=np.asarray(camera.calibration_matrix(), dtype=np.float64),
                cam_from_world=np.asarray(image.cam_from_world().matrix(), dtype=np.float64),
            )
        )
        observed = {row_of_point[p.point3D_id] for p in image.points2D if p.has_point3D()}
        seen.append(np.array(sorted(observed), dtype=np.int64))
    boxes = job.region.padded_boxes()
    return MvsJob(
        workspace=workspace,
        views=tuple(views),
        sources=choose_source_views(
            views=views,
            points_in_world=points,
            point_views=seen,
            samples_in_world=_samples(job.region),
            max_sources=_MAX_SOURCES,
        ),
        boxes_in_world=boxes,
        points_in_world=points,
        point_views=tuple(seen),
        mask_dir=workspace / "masks" if has_masks else None,
    )


def _samples(region: GroundRegion) -> NDArray[np.float64]:
    """(S, 3) uniform samples of a region, where keypoints are few ([O] section 3); a tenth of a cell apart."""
    boxes = region.padded_boxes()
    spacing = min(region.cell_size_m) / 10
    grids = [
        np.stack(np.meshgrid(*(np.arange(a, b, spacing) for a, b in zip(*box, strict=True)), indexing="ij"), -1)
        for box in boxes
    ]
    return np.concatenate([grid.reshape(-1, 3) for grid in grids])


def _write_stereo_folder(job: MvsJob) -> None:
    """COLMAP's configuration: which views to match, and which maps to fuse."""
    stereo = job.workspace / "stereo"
    stereo.mkdir(parents=True, exist_ok=True)
    for row in range(len(job.views)):
        for path in (job.depth_map_path(row), job.normal_map_path(row)):
            path.parent.mkdir(parents=True, exist_ok=True)
    names = [view.name for view in job.views]
    (stereo / "fusion.cfg").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    lines = [
        f"{name}\n{', '.join(names[s] for s in sources)}\n" for name, sources in zip(names, job.sources, strict=True)
    ]
    (stereo / "patch-match.cfg").write_text("".join(lines), encoding="utf-8")
