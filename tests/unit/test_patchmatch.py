"""The embedded back-end on planes whose depth is known."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from fusion.cloud import read_ply
from mvs_backends import backend_names, get_backend
from mvs_backends.base import MvsError, MvsJob, MvsOptions, Preset
from mvs_backends.patchmatch.backend import estimate_maps
from mvs_backends.patchmatch.cost.kernels import Reference
from mvs_backends.patchmatch.images import ImageCache, kept_bytes
from mvs_backends.patchmatch.options import PRESETS, PatchMatchOptions, options_of_preset
from mvs_backends.patchmatch.search import Hypotheses, LevelSearch, gather_sources, window
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job, true_depth

ROOT = Path(__file__).resolve().parents[2]
OPTIONS = MvsOptions()
SLANTED = (0.35, -0.3, 1.0)
QUICK = PatchMatchOptions(num_source_views=3, max_cost_views=3, iterations=(3, 1), num_random=4)


def run(job: MvsJob, *, num_threads: int = 2, options: MvsOptions = OPTIONS) -> list[tuple[NDArray, NDArray]]:
    get_backend("patchmatch").estimate(job=job, options=options, num_threads=num_threads)
    return maps(job)


def maps(job: MvsJob) -> list[tuple[NDArray, NDArray]]:
    return [(read_map(job.depth_map_path(v)), read_map(job.normal_map_path(v))) for v in range(len(job.views))]


def map_bytes(job: MvsJob) -> list[bytes]:
    return [
        path.read_bytes() for v in range(len(job.views)) for path in (job.depth_map_path(v), job.normal_map_path(v))
    ]


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), SLANTED], ids=["fronto-parallel", "slanted"])
def test_depth_and_normal_of_a_textured_plane(tmp_path: Path, normal: tuple[float, float, float]) -> None:
    job = plane_job(tmp_path, normal=normal)
    direction = np.asarray(normal) / np.linalg.norm(normal)
    for view, (depth, normals) in zip(job.views, run(job), strict=True):
        known = depth > 0
        assert known.mean() > 0.75
        error = np.abs(depth / true_depth(view, direction, 5.0) - 1)[known]
        assert np.mean(error < 0.005) >= 0.95
        towards_camera = -view.cam_from_world[:, :3] @ direction
        angle = np.degrees(np.arccos(np.clip(normals[known] @ towards_camera, -1, 1)))
        assert np.median(angle) < 2.0
        assert np.mean(angle < 8.0) > 0.95
        np.testing.assert_allclose(np.linalg.norm(normals[known], axis=-1), 1.0, atol=1e-4)
        assert not normals[~known].any()


def test_a_wall_without_texture_gets_the_plane_of_its_edges(tmp_path: Path) -> None:
    found = {}
    for prior in (False, True):
        job = plane_job(tmp_path / str(prior), normal=SLANTED, bare=(1.2, 0.8))
        estimate_maps(job=job, options=PatchMatchOptions(planar_prior=prior), seed=0, num_threads=2)
        direction = np.asarray(SLANTED) / np.linalg.norm(SLANTED)
        depth = read_map(job.depth_map_path(1))
        grey = cv2.imread(str(job.image_path(1)), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        bare = cv2.erode((grey == 128).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        assert bare.sum() > 400
        right = (depth > 0) & (np.abs(depth / true_depth(job.views[1], direction, 5.0) - 1) < 0.01)
        found[prior] = right[bare].mean()
    assert found[True] > 0.95
    assert found[False] < 0.8


def test_a_bare_wall_gets_the_plane_of_the_edges_that_other_views_find(tmp_path: Path) -> None:
    """Of view 1 only the middle of the wall is wanted, where no window reaches its edges."""
    job = plane_job(tmp_path, normal=SLANTED, bare=(1.2, 0.8))
    grey = cv2.imread(str(job.image_path(1)), cv2.IMREAD_GRAYSCALE)
    middle = cv2.erode((grey == 128).astype(np.uint8), np.ones((15, 15), np.uint8))
    assert middle.sum() > 150
    (tmp_path / "masks" / "cam").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks" / f"{job.views[1].name}.png"), 255 * middle)
    job = dataclasses.replace(job, mask_dir=tmp_path / "masks")
    estimate_maps(job=job, options=dataclasses.replace(QUICK, iterations=(3,)), seed=0, num_threads=2)
    depth = read_map(job.depth_map_path(1))
    assert not depth[middle == 0].any()
    off = np.abs(depth / true_depth(job.views[1], np.asarray(SLANTED) / np.linalg.norm(SLANTED), 5.0) - 1)
    assert np.mean(off[middle > 0] < 0.01) > 0.95


def test_maps_of_other_views_remove_what_only_one_view_sees(tmp_path: Path) -> None:
    """Without what else removes outliers: ACMM's geometric consistency alone."""
    alone = dataclasses.replace(QUICK, planar_prior=False, average_views=False, smoothing_radius_px=0, min_speckle_px=0)
    direction = np.asarray(SLANTED) / np.linalg.norm(SLANTED)
    off = {}
    for weight in (0.0, 0.2):
        job = plane_job(tmp_path / str(weight), normal=SLANTED)
        estimate_maps(job=job, options=dataclasses.replace(alone, geometric_weight=weight), seed=0, num_threads=2)
        depths = np.stack([depth for depth, _ in maps(job)])
        truth = np.stack([true_depth(view, direction, 5.0) for view in job.views])
        off[weight] = np.abs(depths / truth - 1)[depths > 0]
    assert np.mean(off[0.2] > 0.03) < 0.3 * np.mean(off[0.0] > 0.03)
    assert np.median(off[0.2]) < np.median(off[0.0])


def test_searches_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse to fine, depths from the whole interval at the coarsest only, at last with the maps of the sources."""
    searches = []
    sweep = LevelSearch.sweep

    def recorded(self: LevelSearch, start: Hypotheses, iterations: range, random_depth: bool) -> Hypotheses:
        searches.append((start.cost.shape, iterations, random_depth, len(self.sources.planes)))
        return sweep(self, start, iterations, random_depth)

    monkeypatch.setattr(LevelSearch, "sweep", recorded)
    job = plane_job(tmp_path, normal=SLANTED, num_views=3)
    options = dataclasses.replace(QUICK, iterations=(3, 2, 1), geometric_iterations=2)
    estimate_maps(job=job, options=options, seed=0, num_threads=1)
    height, width = job.views[0].height, job.views[0].width
    coarse, middle, fine = ((height // 4, width // 4), (height // 2, width // 2), (height, width))
    once = [
        (coarse, range(3), True, 0),
        (middle, range(2), False, 0),
        (fine, range(1), False, 0),
        (fine, range(1, 3), False, 2 * height * width),
    ]
    assert searches == [search for search in once for _ in job.views]


def test_the_last_search_sees_planes_in_the_other_views_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a bare wall they hold anything else, which no plane would agree with."""
    maps_of_sources = []
    sweep = LevelSearch.sweep

    def recorded(self: LevelSearch, start: Hypotheses, iterations: range, random_depth: bool) -> Hypotheses:
        if len(self.sources.planes):
            maps_of_sources.append(self.sources.planes[:, 0])
        return sweep(self, start, iterations, random_depth)

    monkeypatch.setattr(LevelSearch, "sweep", recorded)
    job = plane_job(tmp_path, normal=SLANTED, bare=(1.2, 0.8))
    estimate_maps(job=job, options=PatchMatchOptions(), seed=0, num_threads=1)
    view = job.views[0]
    seen_by_last = maps_of_sources[-1][: view.height * view.width].reshape(view.height, view.width)
    grey = cv2.imread(str(job.image_path(0)), cv2.IMREAD_GRAYSCALE)
    bare = cv2.erode((grey == 128).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    off = np.abs(
        1 / seen_by_last[bare] / true_depth(view, np.asarray(SLANTED) / np.linalg.norm(SLANTED), 5.0)[bare] - 1
    )
    assert np.mean(off < 0.01) > 0.9


def test_each_source_view_has_its_pixels_and_its_map_in_the_same_place(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=SLANTED, num_views=3)
    small = dataclasses.replace(job.views[2], width=job.views[2].width - 10, height=job.views[2].height - 6)
    job = dataclasses.replace(job, views=(*job.views[:2], small))
    cv2.imwrite(str(job.image_path(2)), cv2.imread(str(job.image_path(2)))[: small.height, : small.width])
    images = ImageCache(job)
    sources = gather_sources(job, 0, [1, 2], 1, images)
    sizes = [(view.width // 2, view.height // 2) for view in job.views[1:]]
    assert list(zip(sources.width, sources.height, strict=True)) == sizes
    maps = [np.full((height, width, 3), number, np.float32) for number, (width, height) in enumerate(sizes)]
    with ThreadPoolExecutor(1) as executor:
        options = PatchMatchOptions()
        reference = Reference(np.zeros((0, 0), np.uint8), np.zeros((0, 0, 2), np.float32), np.ones(4, np.float32))
        search = LevelSearch(
            reference=reference, sources=sources, window=window(options), options=options, seed=0, executor=executor
        ).with_maps(maps)
    begins = [*sources.first.astype(int), len(sources.texels)]
    for number, (begin, end) in enumerate(itertools.pairwise(begins)):
        np.testing.assert_array_equal(sources.texels[begin:end], images.get(number + 1, 1)[1])
        assert (search.sources.planes[begin:end] == number).all()


def test_seed_changes_the_search_and_not_the_surface(tmp_path: Path) -> None:
    one, two = (plane_job(tmp_path / name, normal=SLANTED) for name in ("one", "two"))
    first, second = run(one), run(two, options=MvsOptions(seed=5))
    assert map_bytes(one) != map_bytes(two)
    both = (first[1][0] > 0) & (second[1][0] > 0)
    assert np.median(np.abs(first[1][0][both] / second[1][0][both] - 1)) < 0.002


class _StoppedError(Exception):
    pass


@pytest.mark.parametrize("stop_after", [1, 5, 8, 12, 15, 17])
def test_stopped_job_continues_to_the_same_bytes(tmp_path: Path, stop_after: int) -> None:
    whole, stopped = (plane_job(tmp_path / name, normal=SLANTED, num_views=3) for name in ("whole", "stopped"))
    estimate_maps(job=whole, options=QUICK, seed=0, num_threads=1)
    calls = 0

    def stop(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls == stop_after:
            raise _StoppedError

    with pytest.raises(_StoppedError):
        estimate_maps(job=stopped, options=QUICK, seed=0, num_threads=1, progress=stop)
    kept = {path: path.stat().st_mtime_ns for path in (stopped.workspace / "stereo").rglob("*view*")}
    assert kept
    estimate_maps(job=stopped, options=QUICK, seed=0, num_threads=1)
    assert map_bytes(whole) == map_bytes(stopped)
    assert not list((stopped.workspace / "stereo").rglob("*view*"))


def test_other_options_do_not_reuse_kept_passes(tmp_path: Path) -> None:
    fresh, changed = (plane_job(tmp_path / name, normal=SLANTED, num_views=3) for name in ("fresh", "changed"))

    def stop(done: int, total: int) -> None:
        raise _StoppedError

    with pytest.raises(_StoppedError):
        estimate_maps(job=changed, options=QUICK, seed=1, num_threads=1, progress=stop)
    estimate_maps(job=changed, options=QUICK, seed=0, num_threads=1)
    estimate_maps(job=fresh, options=QUICK, seed=0, num_threads=1)
    assert map_bytes(fresh) == map_bytes(changed)


def test_masked_pixels_and_rays_beside_the_region_get_no_depth(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=(0.0, 0.0, 1.0), num_views=3)
    mask = np.full((80, 112), 255, np.uint8)
    mask[:30, :40] = 0
    (tmp_path / "masks" / "cam").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks" / f"{job.views[1].name}.png"), mask)
    half = np.array([[[0.0, -8.0, 2.0], [8.0, 8.0, 12.0]]])
    job = dataclasses.replace(job, mask_dir=tmp_path / "masks", boxes_in_world=half)
    estimate_maps(job=job, options=QUICK, seed=0, num_threads=1)
    depths = [depth for depth, _ in maps(job)]
    assert not depths[1][:30, :40].any()
    # The middle camera looks along z from x = 0: its left half sees x < 0 only.
    assert not depths[1][:, :55].any()
    assert (depths[1][:, 60:] > 0).mean() > 0.8


def test_nothing_is_found_behind_what_hides_the_region(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=(0.0, 0.0, 1.0), num_views=3)
    behind = np.array([[[-20.0, -20.0, 5.15], [20.0, 20.0, 12.0]]])
    estimate_maps(job=dataclasses.replace(job, boxes_in_world=behind), options=QUICK, seed=0, num_threads=1)
    assert np.mean([depth > 0 for depth, _ in maps(job)]) < 0.01


def test_colmap_fuses_the_maps(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=SLANTED)
    run(job)
    model = pycolmap.Reconstruction()
    for i, view in enumerate(job.views, start=1):
        params = [view.calibration[0, 0], view.calibration[1, 1], view.calibration[0, 2], view.calibration[1, 2]]
        camera = pycolmap.Camera(camera_id=i, model="PINHOLE", width=view.width, height=view.height, params=params)
        model.add_camera_with_trivial_rig(camera)
        pixels = (job.points_in_world @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]) @ view.calibration.T
        keypoints = pixels[:, :2] / pixels[:, 2:]
        image = pycolmap.Image(image_id=i, camera_id=i, name=view.name, keypoints=keypoints)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world))
    # Fusion compares images that share sparse points.
    for row, point in enumerate(job.points_in_world):
        track = pycolmap.Track([pycolmap.TrackElement(i, row) for i in range(1, len(job.views) + 1)])
        model.add_point3D(point, track)
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    (tmp_path / "stereo" / "fusion.cfg").write_text("".join(f"{view.name}\n" for view in job.views))
    options = pycolmap.StereoFusionOptions(min_num_pixels=3)
    fused = pycolmap.stereo_fusion(
        output_path=tmp_path / "fused.ply", workspace_path=tmp_path, options=options, output_type="ply"
    )
    points = np.array([point.xyz for point in fused.points3D.values()])
    assert len(points) > 800
    direction = np.asarray(SLANTED) / np.linalg.norm(SLANTED)
    assert np.percentile(np.abs(points @ direction - 5.0), 90) < 0.02
    normals = read_ply(tmp_path / "fused.ply").normals
    assert normals is not None
    assert np.median(-normals @ direction) > 0.99


def test_view_without_sources_gets_an_empty_map(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=SLANTED, num_views=3)
    job = dataclasses.replace(job, sources=((), (2,), (1,)))
    estimate_maps(job=job, options=QUICK, seed=0, num_threads=1)
    depths = [depth for depth, _ in maps(job)]
    assert not depths[0].any()
    assert depths[1].any()


def test_kept_images_take_as_many_bytes_as_is_said(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=SLANTED, num_views=3)
    cache = ImageCache(job)
    kept = sum(part.nbytes for view in range(3) for level in range(6) for part in cache.get(view, level))
    assert kept_bytes(3, 112 * 80) == pytest.approx(kept, rel=0.05)
    assert kept_bytes(1000, 10**9) == kept_bytes(2000, 10**9)


def test_unreadable_image_is_named(tmp_path: Path) -> None:
    job = plane_job(tmp_path, normal=SLANTED, num_views=3)
    job.image_path(1).write_bytes(b"not an image")
    with pytest.raises(MvsError, match="001.png"):
        estimate_maps(job=job, options=QUICK, seed=0, num_threads=1)


def test_unknown_backend_lists_the_valid_ones() -> None:
    with pytest.raises(ValueError, match=", ".join(backend_names())):
        get_backend("nonsense")
    assert get_backend("patchmatch").availability(MvsOptions()).ok


@pytest.mark.parametrize("preset", list(Preset))
def test_every_preset_fills_whole_size_maps(tmp_path: Path, preset: Preset) -> None:
    job = plane_job(tmp_path, normal=(0.0, 0.0, 1.0), num_views=3)
    for depth, normal in run(job, options=MvsOptions(preset=preset)):
        assert depth.shape == (80, 112)
        assert normal.shape == (80, 112, 3)
        assert (depth > 0).mean() > 0.7


@pytest.mark.parametrize("field", ["geometric_iterations", "geometric_weight", "smoothing_radius_px"])
def test_negative_options_are_refused(field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} must be at least 0, not -1"):
        dataclasses.replace(PatchMatchOptions(), **{field: -1})


def test_a_number_of_source_views_replaces_that_of_the_preset_only() -> None:
    asked = options_of_preset(MvsOptions(preset=Preset.HIGH, num_source_views=3))
    assert asked == dataclasses.replace(PRESETS[Preset.HIGH], num_source_views=3)
    assert options_of_preset(MvsOptions(preset=Preset.HIGH)) == PRESETS[Preset.HIGH]


@pytest.mark.parametrize("field", ["num_source_views", "max_cost", "sigma_grey", "iterations"])
def test_invalid_options_name_the_field(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        dataclasses.replace(PatchMatchOptions(), **{field: () if field == "iterations" else 0})


def test_the_tiny_job_compiles_every_kernel(tmp_path: Path) -> None:
    """In a process that has used none yet: what a job needs beyond it, each of many jobs would compile for itself."""
    script = f"""
from pathlib import Path
from numba.core.registry import CPUDispatcher
import mvs_backends.patchmatch.cost.kernels as cost
import mvs_backends.patchmatch.kernels as search
import mvs_backends.patchmatch.maps.kernels as maps
import mvs_backends.patchmatch.planes.kernels as planes
from mvs_backends.patchmatch.tiny_job import tiny_job
from tests.unit.test_patchmatch import MvsOptions, SLANTED, plane_job, run
kernels = {{
    kernel
    for module in (cost, search, maps, planes)
    for kernel in vars(module).values()
    if isinstance(kernel, CPUDispatcher)
}}
run(tiny_job(Path({str(tmp_path)!r}) / "tiny"))
compiled = {{kernel: set(kernel.signatures) for kernel in kernels}}
assert all(compiled[kernel] for kernel in kernels if kernel.stats.cache_path)
for preset in ("preview", "normal"):
    job = plane_job(Path({str(tmp_path)!r}) / preset, normal=SLANTED, num_views=3)
    run(job, options=MvsOptions(preset=preset))
assert {{kernel: set(kernel.signatures) for kernel in kernels}} == compiled
"""
    result = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stderr
