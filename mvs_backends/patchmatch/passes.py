"""The passes over the views of a cluster; what each finds is kept in files until all are done."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvs_backends.base import MvsJob
from mvs_backends.colmap_maps import has_maps, write_maps
from mvs_backends.masks import read_mask
from mvs_backends.patchmatch.averaging import averaged_planes
from mvs_backends.patchmatch.cost.kernels import PADDING, Reference
from mvs_backends.patchmatch.geometry import LevelCamera, depth_and_normal, level_camera
from mvs_backends.patchmatch.images import ImageCache
from mvs_backends.patchmatch.options import PatchMatchOptions
from mvs_backends.patchmatch.prior import interpolated_planes, points_in_image
from mvs_backends.patchmatch.search import (
    Hypotheses,
    LevelSearch,
    gather_sources,
    inverse_range,
    sparse_points_in_image,
    upsampled,
    window,
)

Arrays = dict[str, NDArray[Any]]
_PLANED, _FINISHED = "planed", "finished"
# What hides the region from a pixel is found as well, as there would else be a depth within the region all the same.
_SHARE_BEFORE_REGION = 0.6


@dataclass(frozen=True, kw_only=True)
class Pass:
    """One pass over all views."""

    share: float
    """Of the time of all passes, roughly."""
    is_done: Callable[[int], bool]
    """Whether the result for a view is there."""
    run: Callable[[int], None]
    """Leave the result for a view."""


@dataclass(frozen=True, kw_only=True)
class _Search:
    """One search over all views."""

    level: int
    sweeps: range
    """Numbered on over the searches of a level."""
    is_geometric: bool
    """Goes on at the level of the search before, with the maps of all views that it left."""


@dataclass(frozen=True, kw_only=True)
class Passes:
    """All passes of a job. Each reads what earlier ones left for all views, so the order of views doesn't matter."""

    job: MvsJob
    options: PatchMatchOptions
    seed: int
    images: ImageCache
    folder: Path
    """Where results are kept."""
    executor: Executor

    def in_order(self) -> Sequence[Pass]:
        """What there is to do, one after the other.

        Coarse to fine, each level is searched, the finest once more with the maps of all views in the cost; after each
        search (for the planar prior) its credible pixels are found, which needs the maps of all views as well. The maps
        that the last search begins with have planes; those that it leaves get planes and are smoothed, and at last
        averaged and written.
        """
        prior = self.options.planar_prior
        passes = []
        for number, search in enumerate(self._searches):
            cost = len(search.sweeps) / 4.0**search.level
            if prior and search.is_geometric:
                passes.append(self._kept_pass(_PLANED, cost / 20, self._give_planes))
            passes.append(self._kept_pass(_searched(number), cost, partial(self._search, number)))
            if prior:
                passes.append(self._kept_pass(_credible(number), cost / 10, partial(self._find_credible, number)))
        passes.append(self._kept_pass(_FINISHED, cost / 10, self._finish))
        passes.append(Pass(share=cost / 10, is_done=partial(has_maps, self.job), run=self._write))
        total = sum(part.share for part in passes)
        return [replace(part, share=part.share / total) for part in passes]

    @property
    def _searches(self) -> Sequence[_Search]:
        options = self.options
        coarsest = options.finest_level + len(options.iterations) - 1
        searches = [
            _Search(level=coarsest - number, sweeps=range(count), is_geometric=False)
            for number, count in enumerate(options.iterations)
        ]
        if options.geometric_iterations:
            first = options.iterations[-1]
            sweeps = range(first, first + options.geometric_iterations)
            searches.append(_Search(level=options.finest_level, sweeps=sweeps, is_geometric=True))
        return searches

    def _kept_pass(self, name: str, share: float, find: Callable[[int], Arrays]) -> Pass:
        def run(view: int) -> None:
            folder = self._kept_in(name, view)
            partly = folder.with_name(f".{folder.name}.partial")
            shutil.rmtree(partly, ignore_errors=True)
            partly.mkdir()
            for field, values in find(view).items():
                np.save(partly / f"{field}.npy", values)
            partly.replace(folder)

        return Pass(share=share, is_done=lambda view: self._kept_in(name, view).exists(), run=run)

    def _search(self, number: int, view: int) -> Arrays:
        """Hypotheses of a search, from random ones or from those of the search before."""
        this = self._searches[number]
        search = self._level_search(view, number)
        camera = level_camera(self.job.views[view], this.level)
        if search is None:
            return _arrays(_nothing(camera))
        if number == 0:
            points, inverse_depths = sparse_points_in_image(self.job, view, camera)
            start = search.start(interpolated_planes(points, inverse_depths, camera.width, camera.height))
        elif this.is_geometric:
            before = _PLANED if self.options.planar_prior else _searched(number - 1)
            start = self._hypotheses(before, view)
            search = search.with_maps(self._maps_of_sources(before, view))
        else:
            coarse_grey, _ = self.images.get(view, self._level(number - 1))
            start = upsampled(self._hypotheses(_searched(number - 1), view), coarse_grey, search.reference)
            if self.options.planar_prior:
                start = self._with_planes(search, start, view, this.level, number - 1)
        return _arrays(search.sweep(start, this.sweeps, random_depth=number == 0))

    def _give_planes(self, view: int) -> Arrays:
        """Hypotheses of the last photometric search with planes."""
        number = len(self.options.iterations) - 1
        search, found = self._level_search(view, number), self._hypotheses(_searched(number), view)
        if search is None:
            return _arrays(found)
        return _arrays(self._with_planes(search, found, view, self.options.finest_level, number))

    def _find_credible(self, number: int, view: int) -> Arrays:
        """Pixels whose depth is to be relied upon."""
        search = self._level_search(view, number)
        found = self._hypotheses(_searched(number), view)
        if search is None:
            return {"credible": np.zeros(found.cost.shape, np.bool_)}
        return {"credible": search.with_maps(self._maps_of_sources(_searched(number), view)).credible(found)}

    def _finish(self, view: int) -> Arrays:
        """The last hypotheses with planes, smoothed, those of high cost removed."""
        last = len(self._searches) - 1
        found = self._hypotheses(_searched(last), view)
        search = self._level_search(view, last)
        if search is None:
            return _arrays(found)
        if self.options.planar_prior:
            found = self._with_planes(search, found, view, self.options.finest_level, last)
        if self.options.smoothing_radius_px > 0:
            found = search.smoothed(found, self.options.smoothing_radius_px)
        found.plane[~(found.cost <= self.options.max_cost)] = 0.0
        return _arrays(found)

    def _write(self, view: int) -> None:
        """Leave the maps of a view, averaged with those of the other views, as COLMAP's."""
        options, level = self.options, self.options.finest_level
        found = self._hypotheses(_FINISHED, view)
        if options.average_views:
            others = [
                (level_camera(self.job.views[other], level), partial(self._kept, _FINISHED, other, "plane"))
                for other in sorted(self.job.sources[view])
            ]
            plane = averaged_planes(found.plane, level_camera(self.job.views[view], level), others, self.executor)
            found = replace(found, plane=plane)
        if level > 0:
            found = upsampled(found, self.images.get(view, level)[0], self._reference(view, 0))
        camera = level_camera(self.job.views[view], 0)
        mask = read_mask(self.job, view, camera.width, camera.height)
        low, high = np.moveaxis(inverse_range(self.job, view, camera, mask), -1, 0)
        w = found.plane[..., 0]
        wanted = (w >= low) & (w <= high) & (found.cost <= options.max_cost)
        plane = np.where(wanted[..., None], found.plane, np.float32(0))
        plane[_speckles(plane[..., 0], options.min_speckle_px)] = 0.0
        depth, normal = depth_and_normal(plane, camera.calibration)
        write_maps(self.job, view, depth, normal)

    def _with_planes(self, search: LevelSearch, found: Hypotheses, view: int, level: int, number: int) -> Hypotheses:
        """Hypotheses with planes through the credible points that a level's search found in the view and in others.

        Args:
            search: of the view.
            found: what to change.
            view: the reference view.
            level: of both.
            number: of the search that the credible points are from.
        """
        camera = level_camera(self.job.views[view], level)
        points = [
            points_in_image(
                self._kept(_searched(number), other, "plane"),
                self._kept(_credible(number), other, "credible"),
                level_camera(self.job.views[other], self._level(number)),
                camera,
            )
            for other in (view, *sorted(self.job.sources[view]))
        ]
        credible = self._kept(_credible(number), view, "credible").astype(np.uint8)
        size = camera.width, camera.height
        here = cv2.resize(credible, size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
        return search.with_planes(found, here, np.concatenate(points))

    def _level_search(self, view: int, number: int) -> LevelSearch | None:
        """A search of a view; None if there is nothing to search."""
        level, sources = self._level(number), self._sources(view)
        if not sources:
            return None
        reference = self._reference(view, level)
        if not (reference.inverse_range[..., 1] > 0).any():
            return None
        return LevelSearch(
            reference=reference,
            sources=gather_sources(self.job, view, sources, level, self.images),
            window=window(self.options),
            options=self.options,
            seed=self.seed + 1000003 * view + 7919 * number,
            executor=self.executor,
        )

    def _maps_of_sources(self, name: str, view: int) -> Iterator[NDArray[np.float32]]:
        """What a pass left for the source views of a view."""
        return (self._kept(name, source, "plane") for source in self._sources(view))

    def _sources(self, view: int) -> list[int]:
        # By index: nothing depends on the order in which a job names them.
        return sorted(self.job.sources[view][: self.options.num_source_views])

    def _reference(self, view: int, level: int) -> Reference:
        camera = level_camera(self.job.views[view], level)
        grey, _ = self.images.get(view, level)
        mask = read_mask(self.job, view, camera.width, camera.height)
        calibration = camera.calibration
        return Reference(
            padded_grey=np.pad(grey, PADDING, mode="edge"),
            inverse_range=inverse_range(self.job, view, camera, mask, _SHARE_BEFORE_REGION),
            intrinsics=np.array(
                [calibration[0, 0], calibration[1, 1], calibration[0, 2], calibration[1, 2]], np.float32
            ),
        )

    def _level(self, number: int) -> int:
        return self._searches[number].level

    def _kept_in(self, name: str, view: int) -> Path:
        return self.folder / f"{name}_view{view:05d}"

    def _kept(self, name: str, view: int, field: str) -> NDArray[Any]:
        kept: NDArray[Any] = np.load(self._kept_in(name, view) / f"{field}.npy")
        return kept

    def _hypotheses(self, name: str, view: int) -> Hypotheses:
        plane, cost, best = (self._kept(name, view, field) for field in ("plane", "cost", "view"))
        return Hypotheses(plane=plane, cost=cost, view=best)


def _searched(number: int) -> str:
    return f"pass{number}"


def _credible(number: int) -> str:
    return f"credible{number}"


def _arrays(found: Hypotheses) -> Arrays:
    return {"plane": found.plane, "cost": found.cost, "view": found.view}


def _nothing(camera: LevelCamera) -> Hypotheses:
    shape = camera.height, camera.width
    return Hypotheses(
        plane=np.zeros((*shape, 3), np.float32), cost=np.full(shape, 2, np.float32), view=np.full(shape, -1, np.int8)
    )


def _speckles(inverse_depth: NDArray[np.float32], min_speckle_px: int) -> NDArray[np.bool_]:
    """Pixels of connected pieces of fewer pixels, where neighbours of like depth (2 %) connect."""
    known = inverse_depth > 0
    steps = np.zeros(inverse_depth.shape, np.int16)
    if known.any():
        logs = np.log(inverse_depth[known])
        steps[known] = 1 + np.minimum((logs - logs.min()) / 0.002, 32000).astype(np.int16)
    cv2.filterSpeckles(steps, 0, min_speckle_px - 1, 10)
    removed: NDArray[np.bool_] = known & (steps == 0)
    return removed
