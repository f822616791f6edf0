"""Which images see what, judged by viewing frustum alone and with occlusion, against rendered truth.

    python -m benchmarks.visibility --paths loop,corner --richness 1,0 --seeds 1,2

For each town a sparse model is made (`benchmarks.sparse_street`), clustered and cut into problems as the program does.

First table: precision / recall in % of the pairs (image of a cluster, place in the image), where the place is a
keypoint, a sample, or a spot on a surface that some image of the drive sees; true is what a ray from the image reaches.

Second table: clusters made and views selected with either visibility. An image rightly belongs to a cluster if it truly
sees a spot in it. Covered are the spots that two selected views of their cluster truly see, in % of those that any two
of its images by frustum do.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict

import numpy as np
from numpy.typing import NDArray

from app.clustering.clusters import Cluster, cluster_views
from app.clustering.grid import Cell
from app.clustering.options import BlockVisibility, ClusteringOptions
from app.occlusion.solid_columns import SolidColumns
from app.scene.kernels import frustum_bits
from app.view_selection.options import SelectionOptions, Visibility
from app.view_selection.problem import ProblemCutter, ViewProblem
from app.view_selection.selection import select_views
from app.view_selection.visibility import unpack_rows
from benchmarks.machine import describe_machine
from benchmarks.sparse_street import SparseStreet, sparse_street
from sample_data.render_street import StreetOptions, StreetTruth, build_street
from sample_data.street_camera import Pose
from sample_data.street_path import PathKind

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]

SURFACE_SPACING_M = 0.5
TOLERANCE_M = {"keypoints": 0.1, "samples": 0.001, "surface": 0.1}
"""How far before a place a ray may end and still reach it; edges of surfaces make it larger than rounding."""
NUM_FRAMES = {PathKind.LOOP: 37, PathKind.CORNER: 24, PathKind.ROUNDABOUT: 30, PathKind.STRAIGHT: 24}
FRAME_SPACING_M = 4.5
CHOICES = (
    (BlockVisibility.FRUSTUM, Visibility.FRUSTUM),
    (BlockVisibility.FRUSTUM, Visibility.OCCLUDED),
    (BlockVisibility.OCCLUDED, Visibility.OCCLUDED),
)


class Town:
    """A rendered town with its sparse model, and sums over its clusters."""

    def __init__(self, path: PathKind, richness: float, seed: int) -> None:
        """Build the town and its model."""
        self.name = f"{path}, richness {richness:g}, seed {seed}"
        self.truth: StreetTruth = build_street(
            StreetOptions(
                path=path,
                seed=seed,
                richness=richness,
                n_frames=NUM_FRAMES[path],
                frame_spacing_m=FRAME_SPACING_M,
                n_cameras=4,
                width=320,
                height=200,
                truth_voxel_m=SURFACE_SPACING_M,
            )
        )
        self.poses = dict(self.truth.images())
        self.street: SparseStreet = sparse_street(self.truth, seed)
        self.surface = self.truth.seen_surface().points.astype(np.float64)
        self.counts = Counter[str]()
        self.seen_in_cell: defaultdict[Cell, set[str]] = defaultdict(set)
        """Images of the clusters by frustum that truly see a spot in a cell."""

    def measure(self, blocks: BlockVisibility) -> None:
        """Cluster, and add up what there is to compare."""
        scene, counts = self.street.scene, self.counts
        clusters = cluster_views(scene, ClusteringOptions(visibility=blocks)).clusters
        cutter = ProblemCutter(scene)
        for cluster in clusters:
            problem = cutter.problem(cluster, Visibility.OCCLUDED)
            names = np.array(problem.image_names)
            cells = cluster.grid.cells_of(self.surface)
            in_cells = np.array([(int(i), int(j)) in cluster.cells for i, j in cells], dtype=np.bool_)
            spots, cells = self.surface[in_cells], cells[in_cells]
            reached = self.reached(problem, spots, TOLERANCE_M["surface"])
            counts[f"{blocks} clusters"] += 1
            counts[f"{blocks} images"] += len(names)
            counts[f"{blocks} rightly"] += int(reached.any(axis=1).sum())
            for cell in cluster.cells:
                seeing = set(names[reached[:, np.all(cells == cell, axis=1)].any(axis=1)].tolist())
                if blocks is BlockVisibility.FRUSTUM:
                    self.seen_in_cell[cell] = seeing
                counts[f"{blocks} kept"] += len(self.seen_in_cell[cell] & seeing)
            coverable = reached.sum(axis=0) >= 2
            counts[f"{blocks} coverable"] += int(coverable.sum())
            for views in (selection for chosen, selection in CHOICES if chosen is blocks):
                chosen_names = select_views(problem, SelectionOptions(visibility=views)).image_names
                rows = np.isin(names, chosen_names)
                counts[f"{blocks} {views} selected"] += len(chosen_names)
                counts[f"{blocks} {views} covered"] += int((reached[rows].sum(axis=0) >= 2).sum())
            if blocks is BlockVisibility.FRUSTUM:
                self._compare(problem, cluster, spots)

    def _compare(self, problem: ViewProblem, cluster: Cluster, spots: Floats) -> None:
        """Add up the pairs that are right and that are said, with either visibility."""
        true_of = dict(
            zip(map(tuple, self.street.scene.points_in_world.tolist()), self.street.true_points, strict=True)
        )
        true_keypoints = np.array([true_of[tuple(p)] for p in problem.keypoints_in_world.tolist()]).reshape(-1, 3)
        known = np.isfinite(true_keypoints[:, 0])
        places = {
            "keypoints": (problem.keypoints_in_world[known], true_keypoints[known]),
            "samples": (problem.samples_in_world, problem.samples_in_world),
            "surface": (spots, spots),
        }
        solid = problem.solid
        assert isinstance(solid, SolidColumns)
        for kind, (positions, true_positions) in places.items():
            bits = frustum_bits(np.ascontiguousarray(positions.T), problem.image_from_world, problem.sizes_px)
            started = time.process_time()
            left = solid.remove_hidden(bits, problem.centers_in_world, positions)
            self.counts["walk_us"] += round(1e6 * (time.process_time() - started)) * (kind != "surface")
            in_image = unpack_rows(bits, len(positions))
            right = in_image & self.reached(problem, true_positions, TOLERANCE_M[kind])
            for views, said in (
                (Visibility.FRUSTUM, in_image),
                (Visibility.OCCLUDED, unpack_rows(left, len(positions))),
            ):
                self.counts[f"{views} {kind} right"] += int((said & right).sum())
                self.counts[f"{views} {kind} said"] += int(said.sum())

    def reached(self, problem: ViewProblem, positions: Floats, tolerance_m: float) -> Bools:
        """(N_c, n) which positions in each view's image a ray from it reaches."""
        bits = frustum_bits(np.ascontiguousarray(positions.T), problem.image_from_world, problem.sizes_px)
        in_image = unpack_rows(bits, len(positions))
        for name, row in zip(problem.image_names, in_image, strict=True):
            row[row] = _is_reached(self.truth, self.poses[name], positions[row], tolerance_m)
        return in_image


def _is_reached(truth: StreetTruth, pose: Pose, positions: Floats, tolerance_m: float) -> Bools:
    """(n,) whether a ray from a camera reaches positions in front of it."""
    in_camera = positions @ pose.rotation.T + pose.translation
    depths = in_camera[:, 2]
    hits = truth.renderer.cast(pose, (in_camera / depths[:, None]).astype(np.float32))
    reached: Bools = hits["depth"] > depths - tolerance_m
    return reached


def main() -> None:
    """Print one row per town and visibility."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", default="loop,corner")
    parser.add_argument("--richness", default="1,0")
    parser.add_argument("--seeds", default="1,2")
    arguments = parser.parse_args()
    print(describe_machine(), end="\n\n")
    first = ["| town | images | keypoints | visibility | keypoints | samples | surface | CPU-ms |", "|---" * 8 + "|"]
    second = [
        "| town | clusters by | number | images | rightly | selection by | selected | covered |",
        "|---" * 8 + "|",
    ]
    for path in arguments.paths.split(","):
        for richness in arguments.richness.split(","):
            for seed in arguments.seeds.split(","):
                town = Town(PathKind(path), float(richness), int(seed))
                for blocks in BlockVisibility:
                    town.measure(blocks)
                first += _pair_rows(town)
                second += _choice_rows(town)
    print("\n".join([*first, "", *second]))


def _pair_rows(town: Town) -> list[str]:
    counts, scene = town.counts, town.street.scene
    rows = []
    for views in (Visibility.FRUSTUM, Visibility.OCCLUDED):
        scores = []
        for kind in TOLERANCE_M:
            right = counts[f"{views} {kind} right"]
            precision, recall = right / counts[f"{views} {kind} said"], right / counts[f"frustum {kind} right"]
            scores.append(f"{100 * precision:.1f} / {100 * recall:.1f}")
        walk_ms = counts["walk_us"] / 1000 / counts["frustum clusters"] if views is Visibility.OCCLUDED else 0
        size = f"{len(scene.image_names)} | {len(scene.point_ids):,}"
        rows.append(f"| {town.name} | {size} | {views} | {' | '.join(scores)} | {walk_ms:.0f} |")
    return rows


def _choice_rows(town: Town) -> list[str]:
    counts = town.counts
    rows = []
    for blocks, views in CHOICES:
        number = counts[f"{blocks} clusters"]
        rightly = counts[f"{blocks} rightly"] / counts[f"{blocks} images"]
        kept = counts[f"{blocks} kept"] / counts["frustum kept"]
        cells = [
            town.name,
            blocks.value,
            f"{number}",
            f"{counts[f'{blocks} images'] / number:.1f}",
            f"{100 * rightly:.1f} / {100 * kept:.1f}",
            views.value,
            f"{counts[f'{blocks} {views} selected'] / number:.1f}",
            f"{100 * counts[f'{blocks} {views} covered'] / counts['frustum coverable']:.1f}",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


if __name__ == "__main__":
    main()
