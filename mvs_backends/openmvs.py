"""OpenMVS (github.com/cdcseacave/openMVS) as a subprocess: InterfaceCOLMAP, then DensifyPointCloud; needs no GPU.

OpenMVS takes the depths to search, and its source views, from the sparse points of the job, which lie in the region. It
could be given our source views, but then it searches all depths from 0.1 to 100. Maps are cut to the region afterwards.
"""

from __future__ import annotations

import logging
import shutil
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import Availability, MvsBackend, MvsError, MvsJob, MvsOptions, Preset, Progress
from mvs_backends.colmap_maps import has_maps, write_empty_maps, write_wanted_maps
from mvs_backends.process import find_program, run_subprocess

logger = logging.getLogger(__name__)

_PROGRAMS = ("InterfaceCOLMAP", "DensifyPointCloud")
_NUM_SOURCES = {Preset.PREVIEW: 4, Preset.NORMAL: 8, Preset.HIGH: 10}
_GEOMETRIC_PASSES = {Preset.PREVIEW: 0, Preset.NORMAL: 2, Preset.HIGH: 2}
_DEPTH, _NORMAL = 1, 2
_MAX_CENTER_ERROR = 1e-3
"""Of the distance of two views: a map that says its camera is farther off belongs to another job."""


class OpenMvs(MvsBackend):
    """OpenMVS's PatchMatch with its own view selection."""

    def availability(self, options: MvsOptions) -> Availability:
        """Whether both programs are there."""
        missing = [name for name in _PROGRAMS if find_program(name, options.openmvs_path) is None]
        if not missing:
            return Availability(ok=True, reason=f"{find_program(_PROGRAMS[1], options.openmvs_path)}")
        where = f"in {options.openmvs_path}" if options.openmvs_path else "on PATH"
        return Availability(
            ok=False,
            reason=f"no executable {' and '.join(missing)} {where}; build OpenMVS and set --openmvs-path to the folder "
            "of its programs, or use patchmatch",
        )

    def estimate(self, *, job: MvsJob, options: MvsOptions, num_threads: int, progress: Progress | None = None) -> None:
        """See `MvsBackend.estimate`."""
        views = range(len(job.views))
        if all(has_maps(job, view) for view in views):
            return
        found = [find_program(name, options.openmvs_path) for name in _PROGRAMS]
        programs = [program for program in found if program is not None]
        if len(programs) < len(_PROGRAMS):
            raise MvsError(self.availability(options).reason)
        folder = job.workspace / "stereo" / "openmvs"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        # Apart from our own `stereo/`, whose maps InterfaceCOLMAP would take for finished ones.
        for name in ("images", "sparse"):
            (folder / name).symlink_to((job.workspace / name).absolute())

        num_passes = 1 + _GEOMETRIC_PASSES[options.preset]
        num_written = num_geometric = 0

        def count() -> None:
            nonlocal num_written, num_geometric
            if progress is not None:
                # A geometric pass writes maps anew beside the old ones, and replaces these when all are there.
                before, num_geometric = num_geometric, len(list(folder.glob("depth*.geo.dmap")))
                num_written += max(num_geometric - before, 0)
                num_first = len(list(folder.glob("depth*.dmap"))) - num_geometric
                progress(min((num_first + num_written) // num_passes, len(job.views)), len(job.views))

        for program, arguments in zip(programs, _arguments(job, options, folder, num_threads), strict=True):
            run_subprocess(
                [program, "-w", folder, "--process-priority", "0", *arguments],
                log_file=job.workspace / "stereo" / "openmvs.log",
                timeout_s=options.program_timeout_s,
                on_wait=count,
            )
        maps = [read_dmap(path) for path in sorted(folder.glob("depth*.dmap"))]
        if not maps:
            raise MvsError(f"DensifyPointCloud left no depth maps; see {job.workspace / 'stereo' / 'openmvs.log'}")
        by_image = {(folder / found.image).resolve(): found for found in maps}
        for view in views:
            match = by_image.get(job.image_path(view).resolve())
            if match is None:
                logger.warning("OpenMVS found no depth for %s: too few neighbours", job.views[view].name)
                write_empty_maps(job, view)
            else:
                _check_camera(job, view, match)
                write_wanted_maps(job, view, match.depth, match.normal)
        shutil.rmtree(folder)


def _arguments(job: MvsJob, options: MvsOptions, folder: Path, num_threads: int) -> tuple[list[str], list[str]]:
    """Of both programs."""
    size = max(max(view.width, view.height) for view in job.views)
    densify = {
        "input-file": "scene.mvs",
        "output-file": "dense.mvs",
        "resolution-level": 0,
        "max-resolution": size,
        "min-resolution": size,
        "number-views": options.num_source_views or _NUM_SOURCES[options.preset],
        "geometric-iters": _GEOMETRIC_PASSES[options.preset],
        "fusion-mode": 1,
        "estimate-roi": 0,
        "crop-to-roi": 0,
        "tower-mode": 0,
        "max-threads": num_threads,
    }
    return (
        ["--input-file", str(folder), "--output-file", "scene.mvs", "--image-folder", f"{folder / 'images'}/"],
        [part for name, value in densify.items() for part in (f"--{name}", str(value))],
    )


@dataclass(frozen=True, kw_only=True)
class DepthData:
    """What a `.dmap` file holds."""

    image: str
    """Path, relative to OpenMVS's working folder or absolute."""
    center_in_world: NDArray[np.float64]
    """(3,)"""
    depth: NDArray[np.float32]
    """(H, W) camera z, 0 where unknown."""
    normal: NDArray[np.float32]
    """(H, W, 3) in the camera's frame."""


def read_dmap(path: Path) -> DepthData:
    """Read OpenMVS's depth data: header, image, neighbours, K R C, then the maps that the header names.

    Raises:
        MvsError: not whole, or without normals.
    """
    try:
        data = path.read_bytes()
        magic, kind, _, _, width, height, _, _ = struct.unpack_from("<2sBxIIIIff", data)
        offset = 28
        (length,) = struct.unpack_from("<H", data, offset)
        image = data[offset + 2 : offset + 2 + length].decode()
        offset += 2 + length
        (num_ids,) = struct.unpack_from("<I", data, offset)
        offset += 4 + 4 * num_ids
        center = np.frombuffer(data, "<f8", 3, offset + 8 * 18)
        offset += 8 * 21
        depth = np.frombuffer(data, "<f4", width * height, offset).reshape(height, width)
        offset += depth.nbytes
        normal = np.frombuffer(data, "<f4", 3 * width * height, offset).reshape(height, width, 3)
    except (OSError, struct.error, ValueError, OverflowError) as error:
        raise MvsError(f"{path} can't be read: {error}; see the log beside its folder") from error
    if magic != b"DR" or kind & (_DEPTH | _NORMAL) != _DEPTH | _NORMAL:
        raise MvsError(f"{path} holds no depth and normal map; see the log beside its folder")
    return DepthData(image=image, center_in_world=center, depth=depth, normal=normal)


def _check_camera(job: MvsJob, view: int, found: DepthData) -> None:
    centers = np.array([-camera.cam_from_world[:, :3].T @ camera.cam_from_world[:, 3] for camera in job.views])
    spacing = float(np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
    camera = job.views[view]
    if np.linalg.norm(found.center_in_world - centers[view]) > _MAX_CENTER_ERROR * max(spacing, 1e-6):
        raise MvsError(f"OpenMVS's map of {camera.name} was made with another pose")
