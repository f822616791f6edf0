"""What a dense multi-view stereo back-end is given and what it leaves behind."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Progress = Callable[[int, int], None]
"""Called with (reference views done, reference views in all)."""


class MvsError(Exception):
    """A back-end can't run, or its work failed. The message says what, where and what to do."""


class Preset(StrEnum):
    """How much time a depth map may cost."""

    PREVIEW = "preview"
    NORMAL = "normal"
    HIGH = "high"


@dataclass(frozen=True, kw_only=True)
class MvsView:
    """One undistorted pinhole image. Arrays are float64 and read-only by convention."""

    name: str
    """Name in the model, relative to the workspace's `images/`; may contain folders."""
    width: int
    height: int
    calibration: NDArray[np.float64]
    """(3, 3) K in pixels, COLMAP's origin: the centre of the top-left pixel is (0.5, 0.5)."""
    cam_from_world: NDArray[np.float64]
    """(3, 4) [R | t]; camera x right, y down, z forward."""


@dataclass(frozen=True, kw_only=True)
class MvsJob:
    """One cluster to reconstruct: a COLMAP dense workspace and the region of space that is wanted from it."""

    workspace: Path
    """COLMAP dense workspace: `images/` (already at the size to work at), `sparse/` (PINHOLE cameras), `stereo/`."""
    views: tuple[MvsView, ...]
    """Reference views, sorted by name."""
    sources: tuple[tuple[int, ...], ...]
    """Per reference view, indices into `views` of its source views, best first."""
    boxes_in_world: NDArray[np.float64]
    """(B, 2, 3) minimum and maximum corner of each axis-aligned box; their union is the padded region of interest."""
    points_in_world: NDArray[np.float64]
    """(P, 3) sparse points."""
    point_views: tuple[NDArray[np.int64], ...]
    """Per view, indices of the sparse points it observes."""
    mask_dir: Path | None = None
    """COLMAP's naming: `mask_dir/NAME.png`, already undistorted; black (0) pixels get no depth."""

    def image_path(self, view: int) -> Path:
        """Path of a view's undistorted image."""
        return self.workspace / "images" / self.views[view].name

    def depth_map_path(self, view: int) -> Path:
        """Where a back-end leaves the depth map (COLMAP `.bin`, camera z, 0 where unknown)."""
        return self.workspace / "stereo" / "depth_maps" / f"{self.views[view].name}.geometric.bin"

    def normal_map_path(self, view: int) -> Path:
        """Where a back-end leaves the normal map (COLMAP `.bin`, camera frame, unit length, facing the camera)."""
        return self.workspace / "stereo" / "normal_maps" / f"{self.views[view].name}.geometric.bin"


_ABOUT_MACHINE = ("acmp_path", "openmvs_path", "colmap_path", "gpu_index", "cache_gib", "program_timeout_s")


@dataclass(frozen=True, kw_only=True)
class MvsOptions:
    """Options that every back-end understands."""

    preset: Preset = Preset.NORMAL
    """Time against quality."""
    num_source_views: int = 0
    """Source views per reference view. 0: the preset's own number."""
    seed: int = 0
    """Seed of the random search; same seed, same bytes, for any number of threads."""
    acmp_path: str = ""
    """Executable of ACMP, ACMH, ACMM or ACMMP, or the folder that holds it. Empty: searched on PATH."""
    openmvs_path: str = ""
    """Folder that holds OpenMVS's programs. Empty: searched on PATH."""
    colmap_path: str = ""
    """COLMAP's executable built with CUDA, or its folder. Empty: pycolmap if it has CUDA, else searched on PATH."""
    gpu_index: str = "-1"
    """GPUs to use, counted from 0, comma-separated; -1: all."""
    cache_gib: float = 0.0
    """Memory that COLMAP may keep images and maps of one cluster in. 0: half of what is free, shared by the clusters
    that are worked on at a time."""
    program_timeout_s: float = 0.0
    """A back-end's program is stopped if it works longer than this on one cluster. 0: never."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"-1|\d+(,\d+)*", self.gpu_index):
            raise ValueError(f"gpu_index must be -1, or numbers with commas between, not {self.gpu_index!r}")
        if not self.cache_gib >= 0:
            raise ValueError(f"cache_gib must be at least 0, not {self.cache_gib}")
        if not self.program_timeout_s >= 0:
            raise ValueError(f"program_timeout_s must be at least 0, not {self.program_timeout_s}")
        if self.num_source_views < 0:
            raise ValueError(f"num_source_views must be at least 0, not {self.num_source_views}")

    def for_record(self) -> MvsOptions:
        """Those that maps depend on; the others, about programs and machine, with their defaults."""
        defaults = MvsOptions()
        return replace(self, **{name: getattr(defaults, name) for name in _ABOUT_MACHINE})


@dataclass(frozen=True, kw_only=True)
class Availability:
    """Whether a back-end can run here, and why (not)."""

    ok: bool
    reason: str


class MvsBackend(ABC):
    """A dense multi-view stereo method. Stateless: one instance serves any number of jobs."""

    uses_gpu: ClassVar[bool] = False
    """Then as many clusters are reconstructed side by side as there are GPUs, each seeing its own only."""

    @abstractmethod
    def availability(self, options: MvsOptions) -> Availability:
        """Whether this back-end can run on this machine."""

    def prepare(self) -> None:  # noqa: B027
        """Do once what parallel jobs would else all do at their start. Nothing by default."""

    def memory_gib(self, num_views: int, image_px: int) -> float:
        """What a job of so many views of so many pixels needs at least; 0 where a back-end can't say. By default 0."""
        return 0.0

    @abstractmethod
    def estimate(self, *, job: MvsJob, options: MvsOptions, num_threads: int, progress: Progress | None = None) -> None:
        """Leave one depth map and one normal map per reference view at the job's paths.

        A pair of maps appears whole or not at all, and maps already there are kept, so that a stopped job can be
        called again.

        Raises:
            MvsError: the back-end can't run here, or failed.
            OSError: a file can't be read or written.
        """
