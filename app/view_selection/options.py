"""Options of view selection."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum


class SelectionMethod(StrEnum):
    """How the views of a cluster are chosen."""

    PAPER = "paper"
    """As [O] section 4 says: the N_min best-seeing views are forced, then as few more as the constraints need."""
    OPTIMAL = "optimal"
    """Among all smallest sets that meet the constraints, the one with the best total view quality."""


class Visibility(StrEnum):
    """Which images count as seeing a keypoint. With `tracks`, samples are seen by the images that they project into."""

    FRUSTUM = "frustum"
    """Those that it projects into."""
    OCCLUDED = "occluded"
    """Those that it projects into, unless something solid stands between; see `app.occlusion`."""
    TRACKS = "tracks"
    """Those in its track. Few images of a video observe the same keypoint, so nearly all of them become necessary."""


@dataclass(frozen=True, kw_only=True)
class SelectionOptions:
    """What a selection of views must provide, [O] section 4."""

    method: SelectionMethod = SelectionMethod.OPTIMAL
    """`paper` or `optimal`. On a simulated drive (7 cameras, 12,000 images) `optimal` takes 3 % fewer views, from 29
    instead of 14 viewpoints a cluster, with 90 instead of 67 % of the best resolution on the surface."""
    visibility: Visibility = Visibility.FRUSTUM
    """`frustum`, `occluded` or `tracks`: which images count as seeing a keypoint. `occluded` also judges samples, and
    leaves out those inside of what is solid and those that fewer than two views see. In rendered towns the selection by
    `frustum` leaves 3 to 6 % of the surface without two views that see it, that by `occluded` 1 to 3 %, with up to 12 %
    more views; it takes 0.2 s more for a cluster of 180 views."""
    n_vis: int = 2
    """Views that must see each point, N_vis; [O] section 4.1."""
    n_match: int = 2
    """Selected views that each selected view must match with, N_match; [O] section 4.1."""
    n_low: int = 10
    """Lower bound of N_min, N_low; [O] section 4.1."""
    n_high: int = 30
    """Upper bound of N_min, N_high; [O] section 4.1."""
    min_views_fraction: float = 0.5
    """N_min is this share of a cluster's views, f(N_c) = N_c / 2, clamped between N_low and N_high. [O] says only that
    it adapts; its clusters have 174 to 195 views on average and keep 31 to 34, so nearly all must reach N_high = 30.
    Where images are sparse, stereo needs most of the overlap that they have."""
    min_shared_points: int = 20
    """Two views match when they see at least this many common points (keypoints and samples)."""
    max_solver_nodes: int = 5_000
    """Limit of each solver call, in nodes of its search: a limit of time would give other results on other machines.
    Where it is reached, the gap to the best possible is reported."""
    max_pictures: int = 200
    """Clusters whose picture is drawn, spread evenly over all: as many as one may look through. `cityrecon explain`
    draws any others."""

    def __post_init__(self) -> None:
        for name in ("n_vis", "n_match", "n_low", "min_shared_points", "max_solver_nodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.max_pictures < 0:
            raise ValueError(f"max_pictures must be at least 0, not {self.max_pictures}")
        if self.n_high < self.n_low:
            raise ValueError(f"n_high must be at least n_low ({self.n_low}), not {self.n_high}")
        if not 0 <= self.min_views_fraction <= 1:
            raise ValueError(f"min_views_fraction must be between 0 and 1, not {self.min_views_fraction}")

    def min_views(self, num_views: int) -> int:
        """N_min for a cluster of ``num_views``, before it is limited by the views there are."""
        return min(max(math.ceil(self.min_views_fraction * num_views), self.n_low), self.n_high)
