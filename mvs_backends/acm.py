"""ACMP and its kin (Xu & Tao 2019, 2020; Xu et al. 2022) as subprocesses on a CUDA GPU: `acmh acmm acmp acmmp`.

All read a folder with `images/%08d.jpg`, `cams/%08d_cam.txt` and `pair.txt`, and leave `depths_geom.dmb` and
`normals.dmb` in `PROGRAM/2333_%08d/`. Written from their sources (github.com/GhiXu, `main.cpp` and `ACM*.cpp`):

- ACMP and ACMH go over all images at one scale, ACMM and ACMMP first at smaller ones (halved until they have at most
  1,000 pixels); each pass overwrites the files of the one before, and says of each image when it is done.
- Image numbers are positions in `pair.txt`, so those with source views are numbered without gaps.
- The centre of the top-left pixel is (0, 0), where COLMAP's is (0.5, 0.5).
- Depths are searched from 0.6 times the least to 1.2 times the greatest of the camera file.
- Normals come out in the world's frame; COLMAP wants the camera's.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import Availability, MvsBackend, MvsError, MvsJob, MvsOptions, Progress
from mvs_backends.colmap_maps import has_maps, write_empty_maps, write_wanted_maps
from mvs_backends.depth_range import usable_views, view_depth_range
from mvs_backends.hardware import chosen_gpus, gpu_environment
from mvs_backends.process import find_program, run_subprocess

_MAX_IMAGE_SIZE_PX = 3200
_NUM_SOURCES = 8
_SEARCHED_FROM, _SEARCHED_TO = 0.6, 1.2
_NUM_DEPTHS = 192
_PASSES = {"ACMP": 3, "ACMH": 2, "ACMM": 3, "ACMMP": 3}
"""Photometric and geometric, over all images, at each scale."""
_MULTI_SCALE = ("ACMM", "ACMMP")
_COARSEST_SIZE_PX = 1000


class Acm(MvsBackend):
    """One of the programs: ACMP, ACMH, ACMM or ACMMP."""

    uses_gpu = True

    def __init__(self, program: str) -> None:
        self._program = program

    def availability(self, options: MvsOptions) -> Availability:
        """Whether the executable is there; it says itself if it finds no GPU."""
        found = find_program(self._program, options.acmp_path)
        if found is not None:
            return Availability(ok=True, reason=f"{found} (whether it finds a GPU shows when it runs)")
        where = f"at {options.acmp_path}" if options.acmp_path else "on PATH"
        return Availability(
            ok=False, reason=f"no executable {self._program} {where}; build it and set --acmp-path, or use patchmatch"
        )

    def estimate(self, *, job: MvsJob, options: MvsOptions, num_threads: int, progress: Progress | None = None) -> None:
        """See `MvsBackend.estimate`."""
        executable = find_program(self._program, options.acmp_path)
        if executable is None:
            raise MvsError(self.availability(options).reason)
        usable = usable_views(job)
        for view in range(len(job.views)):
            if view not in usable:
                write_empty_maps(job, view)
        if all(has_maps(job, view) for view in usable):
            return
        folder = job.workspace / "stereo" / self._program.lower()
        shutil.rmtree(folder, ignore_errors=True)
        num_sources = options.num_source_views or _NUM_SOURCES
        write_folder(folder, job, {view: sources[:num_sources] for view, sources in usable.items()})

        log_file = job.workspace / "stereo" / f"{self._program.lower()}.log"
        size_px = max(max(view.width, view.height) for view in job.views)
        log_start = log_file.stat().st_size if log_file.exists() else 0

        def count() -> None:
            if progress is not None:
                with log_file.open("rb") as log:
                    log.seek(log_start)
                    num_done = sum(line.rstrip().endswith(b"done!") for line in log)
                progress(int(share_done(self._program, size_px, num_done, len(usable)) * len(usable)), len(usable))

        run_subprocess(
            [executable, folder],
            log_file=log_file,
            environment=gpu_environment(chosen_gpus(options.gpu_index)[:1]),
            timeout_s=options.program_timeout_s,
            on_wait=count,
        )
        for number, view in enumerate(usable):
            result = folder / self._program / f"2333_{number:08d}"
            depth = read_dmb(result / "depths_geom.dmb", job.views[view].height, job.views[view].width, 1)[..., 0]
            normal = read_dmb(result / "normals.dmb", job.views[view].height, job.views[view].width, 3)
            write_wanted_maps(job, view, depth, normal @ job.views[view].cam_from_world[:, :3].T.astype(np.float32))
        shutil.rmtree(folder)


def share_done(program: str, size_px: int, num_done: int, num_views: int) -> float:
    """Share of a program's work that is over.

    Args:
        program: its name.
        size_px: longer side of the largest image.
        num_done: images that it called done, in all passes together.
        num_views: images.
    """
    num_scales = 1
    while program in _MULTI_SCALE and size_px > _COARSEST_SIZE_PX:
        size_px, num_scales = size_px // 2, num_scales + 1
    weights = [4.0**scale for scale in range(num_scales) for _ in range(_PASSES[program])]
    over, within = divmod(min(num_done, num_views * len(weights)), num_views)
    return (sum(weights[:over]) + (weights[over] * within / num_views if within else 0.0)) / sum(weights)


def write_folder(folder: Path, job: MvsJob, sources: Mapping[int, Sequence[int]]) -> None:
    """Write a job as the programs read it.

    Args:
        folder: to create.
        job: the job.
        sources: source views of each reference view, in the order of their numbers.

    Raises:
        MvsError: images are larger than the programs work on.
    """
    number = {view: row for row, view in enumerate(sources)}
    for name in ("images", "cams"):
        (folder / name).mkdir(parents=True)
    pairs = [f"{len(sources)}\n"]
    for view in sources:
        camera = job.views[view]
        if max(camera.width, camera.height) > _MAX_IMAGE_SIZE_PX:
            raise MvsError(
                f"{camera.name} has {camera.width}x{camera.height} pixels, ACMP works on {_MAX_IMAGE_SIZE_PX} at most; "
                f"set --max-image-size-px {_MAX_IMAGE_SIZE_PX}"
            )
        # OpenCV, which reads them there, goes by the content of a file and not by its suffix.
        (folder / "images" / f"{number[view]:08d}.jpg").symlink_to(job.image_path(view).absolute())
        found = view_depth_range(job, view)
        if found is None:
            raise MvsError(f"{camera.name} doesn't see the region; leave it out of the reference views")
        (folder / "cams" / f"{number[view]:08d}_cam.txt").write_text(_camera_text(job, view, *found), encoding="ascii")
        count = len(sources[view])
        scores = "".join(f" {number[source]} {count - rank}" for rank, source in enumerate(sources[view]))
        pairs.append(f"{number[view]}\n{count}{scores}\n")
    (folder / "pair.txt").write_text("".join(pairs), encoding="ascii")


def _camera_text(job: MvsJob, view: int, near: float, far: float) -> str:
    camera = job.views[view]
    extrinsic = np.vstack([camera.cam_from_world, [0.0, 0.0, 0.0, 1.0]])
    intrinsic = camera.calibration.copy()
    intrinsic[:2, 2] -= 0.5
    low, high = near / _SEARCHED_FROM, max(far / _SEARCHED_TO, 1.01 * near / _SEARCHED_FROM)
    interval = (high - low) / (_NUM_DEPTHS - 1)
    depths = f"{low:.9g} {interval:.9g} {_NUM_DEPTHS} {high:.9g}"
    return f"extrinsic\n{_rows(extrinsic)}\nintrinsic\n{_rows(intrinsic)}\n{depths}\n"


def _rows(matrix: NDArray[np.float64]) -> str:
    return "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in matrix)


def read_dmb(path: Path, height: int, width: int, channels: int) -> NDArray[np.float32]:
    """Read a map: int32 type (1: float32), height, width, channels; then the values row by row.

    Returns:
        (height, width, channels)

    Raises:
        MvsError: missing, or not of this shape.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MvsError(f"{path} was not written: {error.strerror}; see the log beside its folder") from error
    header = tuple(np.frombuffer(data[:16], "<i4").tolist()) if len(data) >= 16 else ()
    if header != (1, height, width, channels) or len(data) != 16 + 4 * height * width * channels:
        raise MvsError(f"{path} is no map of {width}x{height} pixels with {channels} channels; see the log beside it")
    return np.frombuffer(data, "<f4", offset=16).reshape(height, width, channels)
