"""One reference view's search at one level: from a start to a map of plane hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsJob
from mvs_backends.depth_range import depth_range
from mvs_backends.patchmatch.cost.kernels import PADDING, Reference, Sources, Window, new_scratch
from mvs_backends.patchmatch.geometry import LevelCamera, level_camera, warp
from mvs_backends.patchmatch.images import ImageCache
from mvs_backends.patchmatch.kernels import Search, State, initialise_rows, sweep_rows
from mvs_backends.patchmatch.maps.kernels import credible_rows, parallax_rates, smooth_rows, upsample
from mvs_backends.patchmatch.options import PatchMatchOptions
from mvs_backends.patchmatch.prior import even_regions, region_planes

_ROWS_PER_TASK = 8
_MIN_SPARSE_POINTS = 20
# Of a plane that no texture confirms: worse than a credible pixel's, good enough to be kept.
_PLANE_COST = np.float32(0.4)


@dataclass(frozen=True, kw_only=True)
class Hypotheses:
    """A map of plane hypotheses at some level."""

    plane: NDArray[np.float32]
    """(H, W, 3) inverse depth and its slopes along x and y; 0 where nothing is searched."""
    cost: NDArray[np.float32]
    """(H, W)"""
    view: NDArray[np.int8]
    """(H, W) most important source view."""


def window(options: PatchMatchOptions) -> Window:
    """The matching window, every second pixel of 11 x 11 without the corners, and its bilateral weights."""
    offsets = [(x, y) for y in range(-5, 6, 2) for x in range(-5, 6, 2) if abs(x) + abs(y) < 10]
    dx, dy = np.array(offsets, np.float32).T.copy()
    grey = np.arange(256, dtype=np.float32)
    return Window(
        dx=dx,
        dy=dy,
        column=dx.astype(np.int64),
        row=dy.astype(np.int64),
        space_weight=np.exp(-(dx**2 + dy**2) / np.float32(2 * options.sigma_space_px**2)),
        grey_weight=np.maximum(np.exp(-(grey**2) / np.float32(2 * options.sigma_grey**2)), np.float32(1e-9)),
    )


def sparse_points_in_image(
    job: MvsJob, view: int, camera: LevelCamera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(P, 2) pixels and (P,) inverse depths of the sparse points that a view observes."""
    points = job.points_in_world[job.point_views[view]]
    in_camera = points @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
    in_camera = in_camera[in_camera[:, 2] > 0]
    pixels = in_camera @ camera.calibration.T
    return (pixels[:, :2] / pixels[:, 2:]).astype(np.float32), (1 / in_camera[:, 2]).astype(np.float32)


def inverse_range(
    job: MvsJob, view: int, camera: LevelCamera, mask: NDArray[np.bool_] | None, share_before: float = 0.0
) -> NDArray[np.float32]:
    """Where each pixel's ray passes through the region, not nearer than the view's sparse points allow.

    Args:
        job: the cluster.
        view: the reference view.
        camera: the view at the level being searched.
        mask: (H, W) pixels that are wanted; all if there is none.
        share_before: of the way to the region, how much is added before it.

    Returns:
        (H, W, 2) smallest and largest inverse depth; 0, 0 where nothing is wanted.
    """
    entry, leave = depth_range(job.views[view], job.boxes_in_world, camera.width, camera.height)
    _, inverse_depths = sparse_points_in_image(job, view, camera)
    if len(inverse_depths) >= _MIN_SPARSE_POINTS:
        nearest = 0.5 / float(np.percentile(inverse_depths, 99))
    else:
        # Nearer than the nearest source view, a pixel's match is hardly ever in its image.
        centers = [level_camera(job.views[s], 0).center_in_world for s in job.sources[view]]
        nearest = 0.5 * min((float(np.linalg.norm(c - camera.center_in_world)) for c in centers), default=0.0)
    entry = np.maximum((1 - share_before) * entry, nearest)
    wanted = (leave > entry) & (entry > 0)
    if mask is not None:
        wanted &= mask
    result = np.zeros((camera.height, camera.width, 2), np.float32)
    result[wanted, 0] = 1 / leave[wanted]
    result[wanted, 1] = 1 / entry[wanted]
    return result


def gather_sources(job: MvsJob, view: int, sources: Sequence[int], level: int, images: ImageCache) -> Sources:
    """Images and cameras of the source views as flat arrays for the kernels, without hypotheses.

    Args:
        job: the cluster.
        view: the reference view.
        sources: its source views.
        level: how often all images are halved.
        images: where images come from.
    """
    reference = level_camera(job.views[view], level)
    cameras = [level_camera(job.views[s], level) for s in sources]
    packed = [images.get(s, level)[1] for s in sources]
    return Sources(
        warp=np.stack([warp(c, reference) for c in cameras]),
        texels=np.concatenate(packed),
        first=np.cumsum([0, *(p.size for p in packed[:-1])]).astype(np.uint64),
        width=np.array([c.width for c in cameras], np.int32),
        height=np.array([c.height for c in cameras], np.int32),
        limit=np.array([(c.width - 1.01, c.height - 1.01) for c in cameras], np.float32),
        planes=np.zeros((0, 3), np.float32),
        warp_back=np.stack([warp(reference, c) for c in cameras]),
    )


@dataclass(frozen=True, kw_only=True)
class LevelSearch:
    """What a search at one level works on."""

    reference: Reference
    sources: Sources
    window: Window
    options: PatchMatchOptions
    seed: int
    executor: Executor

    def with_maps(self, maps: Iterable[NDArray[np.float32]]) -> LevelSearch:
        """The same search with the hypotheses of its source views, (H, W, 3) each, in their order."""
        planes = np.empty((len(self.sources.texels), 3), np.float32)
        # One after the other: two copies of all would not fit beside large images.
        for first, plane in zip(self.sources.first.astype(np.int64), maps, strict=True):
            planes[first : first + plane.shape[0] * plane.shape[1]] = plane.reshape(-1, 3)
        return replace(self, sources=self.sources._replace(planes=planes))

    def _over_bands(self, kernel: Callable[..., None], mode: int, state: State, search: Search) -> None:
        """Run a kernel over the image, bands of rows in parallel."""

        def run(first_row: int) -> None:
            last_row = min(first_row + _ROWS_PER_TASK, self.reference.inverse_range.shape[0])
            scratch = new_scratch(len(self.sources.width))
            kernel(first_row, last_row, mode, state, self.reference, self.sources, self.window, search, scratch)

        for _ in self.executor.map(run, range(0, self.reference.inverse_range.shape[0], _ROWS_PER_TASK)):
            pass

    def _search(self, iteration: int, random_depth: bool) -> Search:
        options = self.options
        geometric = len(self.sources.planes) > 0
        # Wide at first, below a tenth of a pixel at last.
        shrink = 0.5 ** (iteration if random_depth else iteration + 1)
        return Search(
            seed=self.seed,
            iteration=iteration,
            max_views=options.max_cost_views,
            geometric_weight=np.float32(options.geometric_weight if geometric else 0.0),
            max_geometric_px=np.float32(options.max_geometric_error_px),
            perturbation_px=np.float32(max(2.0 * shrink, 0.3)),
            normal_perturbation=np.float32(max(0.5 * shrink, 0.06)),
            random_depth=int(random_depth),
        )

    def start(self, sparse: NDArray[np.float32]) -> Hypotheses:
        """The best of planes between sparse points, (H, W, 3) as of `interpolated_planes`, and random ones."""
        state = State(
            plane=sparse.copy(),
            cost=np.empty(sparse.shape[:2], np.float32),
            best_view=np.empty(sparse.shape[:2], np.int8),
        )
        search = self._search(0, True)
        self._over_bands(initialise_rows, self.options.num_random, state, search)
        return Hypotheses(plane=state.plane, cost=state.cost, view=state.best_view)

    def sweep(self, start: Hypotheses, iterations: range, random_depth: bool) -> Hypotheses:
        """Improve hypotheses by sweeps over the image.

        Args:
            start: what to improve; it stays as it is.
            iterations: numbers of the sweeps of this level; later ones search less widely.
            random_depth: whether to try depths from the whole interval as well.
        """
        state = State(plane=start.plane.copy(), cost=start.cost.copy(), best_view=start.view.copy())
        for iteration in iterations:
            search = self._search(iteration, random_depth)
            for colour in (0, 1):
                self._over_bands(sweep_rows, colour, state, search)
        return Hypotheses(plane=state.plane, cost=state.cost, view=state.best_view)

    def smoothed(self, found: Hypotheses, radius_px: int) -> Hypotheses:
        """Hypotheses averaged over those of the neighbourhood that agree."""
        result = np.empty_like(found.plane)

        def run(first_row: int) -> None:
            last_row = min(first_row + _ROWS_PER_TASK, len(result))
            smooth_rows(first_row, last_row, radius_px, found.plane, self.reference, self.sources, result)

        for _ in self.executor.map(run, range(0, len(result), _ROWS_PER_TASK)):
            pass
        return Hypotheses(plane=result, cost=found.cost, view=found.view)

    def credible(self, found: Hypotheses) -> NDArray[np.bool_]:
        """(H, W) pixels of evenly coloured regions whose depth the source views' maps confirm."""
        wanted = self._regions()[0] >= 0
        result = np.zeros(wanted.shape, np.bool_)
        max_cost = np.float32(self.options.max_prior_cost)
        views = self.reference, self.sources, self.window

        def run(first_row: int) -> None:
            last_row = min(first_row + _ROWS_PER_TASK, len(wanted))
            scratch = new_scratch(len(self.sources.width))
            credible_rows(first_row, last_row, wanted, found.plane, max_cost, *views, scratch, result)

        for _ in self.executor.map(run, range(0, len(wanted), _ROWS_PER_TASK)):
            pass
        return result

    def with_planes(self, found: Hypotheses, credible: NDArray[np.bool_], points: NDArray[np.float32]) -> Hypotheses:
        """Hypotheses with the planes of evenly coloured regions where they are not credible by themselves.

        Args:
            found: what to change; it stays as it is.
            credible: (H, W) pixels that keep their hypotheses.
            points: (P, 3) credible points of this view and others, as of `region_planes`.
        """
        rate = np.empty(len(points), np.float32)
        parallax_rates(points, self.sources, rate)
        planes = region_planes(*self._regions(), points, rate, self.executor)
        low, high = np.moveaxis(self.reference.inverse_range, -1, 0)
        taken = (planes[..., 0] > 0) & (planes[..., 0] >= low) & (planes[..., 0] <= high) & ~credible
        return Hypotheses(
            plane=np.where(taken[..., None], planes, found.plane),
            cost=np.where(taken, np.minimum(found.cost, _PLANE_COST), found.cost),
            view=found.view,
        )

    def _regions(self) -> tuple[NDArray[np.int32], list[tuple[slice, slice]]]:
        return even_regions(self.reference.padded_grey[PADDING:-PADDING, PADDING:-PADDING])


def upsampled(coarse: Hypotheses, coarse_grey: NDArray[np.uint8], reference: Reference) -> Hypotheses:
    """Hypotheses of a coarser level as the start of a finer one."""
    shape = reference.inverse_range.shape[:2]
    state = State(
        plane=np.empty((*shape, 3), np.float32), cost=np.empty(shape, np.float32), best_view=np.empty(shape, np.int8)
    )
    scale_y, scale_x = (np.float32(c / f) for c, f in zip(coarse_grey.shape, shape, strict=True))
    upsample(coarse.plane, coarse.cost, coarse.view, coarse_grey, scale_x, scale_y, state, reference)
    return Hypotheses(plane=state.plane, cost=state.cost, view=state.best_view)
