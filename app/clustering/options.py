"""Options of view clustering."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum


class BlockVisibility(StrEnum):
    """Which images count as seeing a keypoint or sample of a block."""

    FRUSTUM = "frustum"
    """Those that it projects into."""
    OCCLUDED = "occluded"
    """Those that it projects into, unless something solid stands between; see `app.occlusion`."""


@dataclass(frozen=True, kw_only=True)
class ClusteringOptions:
    """How the ground is cut into blocks and which images belong to each, [O] section 3.

    Lengths are metres. A model without a known scale has the median distance between consecutive frames as its unit,
    which takes the place of a metre.
    """

    block_size_m: tuple[float, float] = (20.0, 20.0)
    """Block size (x_b, y_b); [O] section 4.1."""
    overlap_m: float = 2.0
    """How far a block's padded bounds reach over its border, d_overlap; [O] section 4.1."""
    sample_spacing_m: float = 1.0
    """Spacing r of the uniform samples in a block; [O] section 4.1."""
    min_keypoints_per_block: int = 5
    """Blocks with fewer keypoints are dropped; stray points come in ones and twos. [O] drops empty blocks only."""
    max_camera_distance_m: float = 38.0
    """Images taken farther than this from a block's centre, on the ground, don't join it.

    [O] gives no number. At 38 m five simulated drives with the numbers of images, keypoints and clusters of [O]'s
    table 1 come to its images per cluster (174 to 195) and clusters per image (4.6 to 5.3); 36 and 40 m give about 7 %
    fewer and more. The depth error grows with the distance squared: at 38 m, with a focal length of 1,500 px, a
    baseline of 2 m and matches good to half a pixel, it is 0.24 m. Also, what is farther away in a street is mostly
    hidden behind houses.
    """
    visibility: BlockVisibility = BlockVisibility.FRUSTUM
    """`frustum` or `occluded`: an image joins a block if it sees a keypoint or sample of it in this sense. `occluded`
    takes 1 to 4 % fewer images and 0.14 s a block of 180; the selection has about the same views and covers the same
    surface with either."""
    min_cameras_per_cluster: int = 10
    """Clusters with fewer images are merged into a neighbour; [O] section 3."""
    height_quantiles: tuple[float, float] = (0.01, 0.99)
    """Heights between these quantiles of the keypoints in a block and its neighbours count as its range of heights."""
    height_margin_m: float = 1.0
    """Added to the range of heights at both ends."""
    camera_height_m: float = 2.5
    """The range of heights reaches at least this far below the median camera in the block and beside it, so that a road
    without any keypoint is part of it."""

    def __post_init__(self) -> None:
        if not all(0 < size < math.inf for size in self.block_size_m):
            raise ValueError(f"block_size_m must be two positive lengths, not {self.block_size_m}")
        if not 0 <= self.overlap_m < min(self.block_size_m):
            raise ValueError(f"overlap_m must be at least 0 and less than the block size, not {self.overlap_m}")
        if not 0 < self.sample_spacing_m <= min(self.block_size_m):
            raise ValueError(f"sample_spacing_m must be positive and fit in a block, not {self.sample_spacing_m}")
        if self.min_keypoints_per_block < 1:
            raise ValueError(f"min_keypoints_per_block must be at least 1, not {self.min_keypoints_per_block}")
        if not 0 < self.max_camera_distance_m < math.inf:
            raise ValueError(f"max_camera_distance_m must be positive, not {self.max_camera_distance_m}")
        if self.min_cameras_per_cluster < 1:
            raise ValueError(f"min_cameras_per_cluster must be at least 1, not {self.min_cameras_per_cluster}")
        low, high = self.height_quantiles
        if not 0 <= low < high <= 1:
            raise ValueError(f"height_quantiles must ascend from 0 to 1, not {self.height_quantiles}")
        if not 0 <= self.height_margin_m < math.inf:
            raise ValueError(f"height_margin_m must be at least 0, not {self.height_margin_m}")
        if not 0 <= self.camera_height_m < math.inf:
            raise ValueError(f"camera_height_m must be at least 0, not {self.camera_height_m}")
