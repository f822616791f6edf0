"""How close a cloud comes to a reference: accuracy, completeness, F-score and distances."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.cloud import PointCloud
from fusion.errors import CloudFormatError, FusionError
from fusion.open3d_import import import_open3d
from fusion.thinning import thin

_CHUNK_POINTS = 1_000_000
_SPACING_SAMPLES = 50_000


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """What counts when two clouds are compared."""

    thresholds_m: tuple[float, ...] = (0.02, 0.05, 0.10, 0.20, 0.50)
    """Distances up to which a point counts as right or as found."""
    voxel_m: float = 0.05
    """Both clouds are thinned to one point per voxel of this size, so that dense places do not outweigh sparse ones; 0
    compares all points."""
    bounds_m: tuple[float, float, float, float, float, float] | None = None
    """Only points inside this box (x, y, z of one corner, then of the other) are counted; distances from them may end
    outside."""

    def __post_init__(self) -> None:
        """Check ranges."""
        if not self.thresholds_m or not all(0 < value < np.inf for value in self.thresholds_m):
            raise ValueError("thresholds_m must hold at least one positive distance")
        if not 0 <= self.voxel_m < np.inf:
            raise ValueError("voxel_m must be positive, or 0 for no thinning")
        if self.bounds_m is not None and not all(
            a < b for a, b in zip(self.bounds_m[:3], self.bounds_m[3:], strict=True)
        ):
            raise ValueError("bounds_m must hold the lower corner and then the upper corner of a box")


@dataclass(frozen=True)
class CloudFacts:
    """Size of a cloud."""

    n_points: int
    n_compared: int
    """What is left after thinning and inside the bounds."""
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    spacing_m: float
    """Median distance from a point to its nearest neighbour, before thinning."""


@dataclass(frozen=True)
class DistanceStatistics:
    """Statistics, in metres, of the distances from all points of one side to the other side."""

    mean_m: float
    median_m: float
    rms_m: float
    p90_m: float
    p95_m: float
    max_m: float


@dataclass(frozen=True)
class Score:
    """Shares at one threshold, 0..1."""

    threshold_m: float
    accuracy: float
    """Share of the cloud's points within the threshold of the mesh or, without one, of the reference."""
    completeness: float
    """Share of the reference's points within the threshold of the cloud."""
    f_score: float
    """Harmonic mean of both."""


@dataclass(frozen=True)
class CloudComparison:
    """All that `compare_clouds` finds."""

    cloud: CloudFacts
    reference: CloudFacts
    scores: tuple[Score, ...]
    cloud_to_reference: DistanceStatistics
    reference_to_cloud: DistanceStatistics
    cloud_to_mesh: DistanceStatistics | None
    """None without a mesh; with one, accuracy is measured to it."""
    chamfer_m: float
    """Mean of the two mean distances between the clouds."""
    voxel_m: float

    def to_json(self) -> str:
        """Return everything as indented JSON."""
        return json.dumps(asdict(self), indent=2)


def cloud_distances(query: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distances (N,) from each of the points (N, 3) to the nearest of the points (M, 3).

    Raises:
        FusionError: Open3D can't be loaded.
    """
    o3d = import_open3d()
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(np.ascontiguousarray(target)))
    search.knn_index()
    distances = np.empty(len(query), dtype=np.float32)
    for start in range(0, len(query), _CHUNK_POINTS):
        chunk = np.ascontiguousarray(query[start : start + _CHUNK_POINTS])
        _, squared = search.knn_search(o3d.core.Tensor.from_numpy(chunk), 1)
        distances[start : start + len(chunk)] = np.sqrt(squared.numpy()[:, 0])
    return distances


def mesh_distances(query: NDArray[np.float32], mesh: Path) -> NDArray[np.float32]:
    """Distances (N,) from points (N, 3) to the nearest place on a triangle mesh.

    Raises:
        CloudFormatError: The file holds no triangles.
        FusionError: Open3D can't be loaded.
        OSError: The file can't be read.
    """
    # Here, since it takes as long to load as all else that every command loads.
    import trimesh

    with mesh.open("rb"):
        pass
    o3d = import_open3d()
    try:
        surface = trimesh.load_mesh(mesh, process=False)
    except (ValueError, KeyError, IndexError, NotImplementedError) as error:
        raise CloudFormatError(f"{mesh}: not a mesh that can be read; give PLY, OBJ, STL or GLB") from error
    faces = np.asarray(getattr(surface, "faces", ()), dtype=np.uint32)
    if len(faces) == 0:
        raise CloudFormatError(f"{mesh}: there are no triangles in this file; give a mesh")
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(np.asarray(surface.vertices, dtype=np.float32)), o3d.core.Tensor.from_numpy(faces)
    )
    distances = np.empty(len(query), dtype=np.float32)
    for start in range(0, len(query), _CHUNK_POINTS):
        chunk = np.ascontiguousarray(query[start : start + _CHUNK_POINTS])
        distances[start : start + len(chunk)] = scene.compute_distance(o3d.core.Tensor.from_numpy(chunk)).numpy()
    return distances


def _spacing_m(points: NDArray[np.float32]) -> float:
    """Median distance to the nearest other point, from evenly chosen samples."""
    if len(points) < 2:
        return 0.0
    o3d = import_open3d()
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    search.knn_index()
    samples = np.ascontiguousarray(points[:: -(-len(points) // _SPACING_SAMPLES)])
    _, squared = search.knn_search(o3d.core.Tensor.from_numpy(samples), 2)
    return float(np.median(np.sqrt(squared.numpy()[:, 1])))


def _facts(cloud: PointCloud, compared: NDArray[np.float32]) -> CloudFacts:
    low, high = cloud.points.min(axis=0).tolist(), cloud.points.max(axis=0).tolist()
    return CloudFacts(len(cloud), len(compared), tuple(low), tuple(high), _spacing_m(cloud.points))


def _statistics(distances: NDArray[np.float32]) -> DistanceStatistics:
    values = distances.astype(np.float64)
    median, p90, p95 = np.percentile(values, [50, 90, 95])
    return DistanceStatistics(
        mean_m=float(values.mean()),
        median_m=float(median),
        rms_m=float(np.sqrt((values**2).mean())),
        p90_m=float(p90),
        p95_m=float(p95),
        max_m=float(values.max()),
    )


def _score(threshold_m: float, to_reference: NDArray[np.float32], to_cloud: NDArray[np.float32]) -> Score:
    accuracy, completeness = float((to_reference <= threshold_m).mean()), float((to_cloud <= threshold_m).mean())
    total = accuracy + completeness
    return Score(threshold_m, accuracy, completeness, 2 * accuracy * completeness / total if total else 0.0)


def _within(points: NDArray[np.float32], options: CompareOptions) -> NDArray[np.float32]:
    """Points inside the bounds."""
    if options.bounds_m is None:
        return points
    low, high = np.reshape(options.bounds_m, (2, 3))
    return points[np.all((points >= low) & (points <= high), axis=1)]


def compare_clouds(
    cloud: PointCloud, reference: PointCloud, *, mesh: Path | None = None, options: CompareOptions | None = None
) -> CloudComparison:
    """Measure a cloud against a reference in the same coordinates.

    Args:
        cloud: What is judged.
        reference: Ground truth or another result.
        mesh: Triangle mesh of the true surface. Accuracy is then measured to it and not to the reference's samples,
            whose spacing would count as error.
        options: Thresholds, thinning, bounds.

    Raises:
        FusionError: One of the clouds is empty, or has no points inside the bounds; Open3D can't be loaded.
        CloudFormatError: The mesh holds no triangles.
    """
    options = options or CompareOptions()
    thinned: list[NDArray[np.float32]] = []
    compared: list[NDArray[np.float32]] = []
    for name, side in (("cloud", cloud), ("reference", reference)):
        if len(side) == 0:
            raise FusionError(f"the {name} has no points; nothing can be compared")
        thinned.append(thin(side, options.voxel_m).points if options.voxel_m > 0 else side.points)
        compared.append(_within(thinned[-1], options))
        if len(compared[-1]) == 0:
            raise FusionError(f"the {name} has no points inside the bounds; choose larger bounds")
    to_reference = cloud_distances(compared[0], thinned[1])
    to_cloud = cloud_distances(compared[1], thinned[0])
    to_mesh = None if mesh is None else mesh_distances(compared[0], mesh)
    forward, backward = _statistics(to_reference), _statistics(to_cloud)
    return CloudComparison(
        cloud=_facts(cloud, compared[0]),
        reference=_facts(reference, compared[1]),
        scores=tuple(
            _score(value, to_reference if to_mesh is None else to_mesh, to_cloud) for value in options.thresholds_m
        ),
        cloud_to_reference=forward,
        reference_to_cloud=backward,
        cloud_to_mesh=None if to_mesh is None else _statistics(to_mesh),
        chamfer_m=(forward.mean_m + backward.mean_m) / 2,
        voxel_m=options.voxel_m,
    )


def format_table(comparison: CloudComparison) -> str:
    """Return the comparison as text tables for a terminal."""
    target = "reference" if comparison.cloud_to_mesh is None else "mesh"
    lines = [f"{'':24}{'points':>12}{'compared':>12}{'spacing':>12}   extent x * y * z"]
    for name, facts in (("cloud", comparison.cloud), ("reference", comparison.reference)):
        extent = " * ".join(f"{high - low:.1f}" for low, high in zip(facts.low_m, facts.high_m, strict=True))
        spacing = f"{100 * facts.spacing_m:.1f} cm"
        lines.append(f"{name:24}{facts.n_points:>12,}{facts.n_compared:>12,}{spacing:>12}   {extent} m")
    lines += ["", f"{'within':24}" + "".join(f"{100 * score.threshold_m:>9g} cm" for score in comparison.scores)]
    for label, name in (
        (f"accuracy (to {target})", "accuracy"),
        ("completeness", "completeness"),
        ("F-score", "f_score"),
    ):
        lines.append(f"{label:24}" + "".join(f"{100 * getattr(score, name):>10.1f} %" for score in comparison.scores))
    lines += [
        "",
        f"{'distances in cm':24}" + "".join(f"{name:>12}" for name in ("mean", "median", "RMS", "90 %", "95 %")),
    ]
    rows = [
        ("cloud to reference", comparison.cloud_to_reference),
        ("reference to cloud", comparison.reference_to_cloud),
    ]
    if comparison.cloud_to_mesh is not None:
        rows.append(("cloud to mesh", comparison.cloud_to_mesh))
    for label, row in rows:
        values = (row.mean_m, row.median_m, row.rms_m, row.p90_m, row.p95_m)
        lines.append(f"{label:24}" + "".join(f"{100 * value:>12.2f}" for value in values))
    lines.append(f"{'Chamfer distance':24}{100 * comparison.chamfer_m:>12.2f}")
    return "\n".join(lines)
