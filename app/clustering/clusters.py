"""Clusters of images with common visibility, and the file that keeps them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from app.clustering.association import DroppedBlock, DropReason, associate
from app.clustering.grid import Cell, GroundGrid
from app.clustering.merging import merge_small_blocks
from app.clustering.options import ClusteringOptions
from app.errors import InputError
from app.scene.posed_scene import PosedScene
from fusion.region import GroundRegion

FILE_NAME = "clusters.jsonl"
FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A piece of ground and the images that see it."""

    name: str
    """From its first cell: `x0003_y0012`."""
    grid: GroundGrid
    cells: tuple[Cell, ...]
    """Sorted."""
    z_range_m: tuple[float, float]
    """Robust range of heights of what is to be reconstructed."""
    num_keypoints: int
    """In the cells, without the overlap."""
    is_small: bool
    """It has fewer images than wanted, and no neighbour to merge with."""
    image_names: tuple[str, ...]
    """Sorted."""

    def region(self) -> GroundRegion:
        """The ground that this cluster alone contributes to the city, with its padding."""
        return self.grid.region(self.cells, self.z_range_m)


@dataclass(frozen=True, kw_only=True)
class Clustering:
    """All clusters of a scene, and what none of them holds."""

    grid: GroundGrid
    clusters: tuple[Cluster, ...]
    """In the order of their first cells."""
    dropped: tuple[DroppedBlock, ...] = ()
    num_far_keypoints: int = 0
    """Keypoints too far from all cameras for any block there to have an image."""

    def write(self, folder: Path) -> None:
        """Write ``clusters.jsonl``: a first line on the whole, then one line per cluster."""
        header = {
            "format_version": FORMAT_VERSION,
            "grid": asdict(self.grid),
            "num_far_keypoints": self.num_far_keypoints,
            "dropped": [asdict(block) for block in self.dropped],
        }
        with (folder / FILE_NAME).open("w", encoding="utf-8") as file:
            file.write(json.dumps(header) + "\n")
            for cluster in self.clusters:
                record = asdict(cluster)
                del record["grid"]
                file.write(json.dumps(record) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Clustering:
        """Read what :meth:`write` wrote.

        Raises:
            InputError: absent, damaged, or written by another version.
        """
        path = folder / FILE_NAME
        try:
            with path.open(encoding="utf-8") as file:
                header = json.loads(file.readline())
                if header["format_version"] != FORMAT_VERSION:
                    raise InputError(f"{path} is of another version of cityrecon; run `cityrecon cluster` again")
                grid = GroundGrid(
                    origin_m=tuple(header["grid"]["origin_m"]),
                    block_size_m=tuple(header["grid"]["block_size_m"]),
                    overlap_m=header["grid"]["overlap_m"],
                    sample_spacing_m=header["grid"]["sample_spacing_m"],
                )
                return cls(
                    grid=grid,
                    clusters=tuple(_cluster(grid, json.loads(line)) for line in file),
                    dropped=tuple(_dropped_block(record) for record in header["dropped"]),
                    num_far_keypoints=header["num_far_keypoints"],
                )
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}; run `cityrecon cluster` first") from error
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is damaged; remove its folder and run `cityrecon cluster` again") from error


def _dropped_block(record: dict[str, Any]) -> DroppedBlock:
    i, j = record["cell"]
    return DroppedBlock(cell=(i, j), num_keypoints=record["num_keypoints"], reason=DropReason(record["reason"]))


def _cluster(grid: GroundGrid, record: dict[str, Any]) -> Cluster:
    return Cluster(
        name=record["name"],
        grid=grid,
        cells=tuple((i, j) for i, j in record["cells"]),
        z_range_m=(record["z_range_m"][0], record["z_range_m"][1]),
        num_keypoints=record["num_keypoints"],
        is_small=record["is_small"],
        image_names=tuple(record["image_names"]),
    )


def cluster_views(scene: PosedScene, options: ClusteringOptions) -> Clustering:
    """Cut a scene into overlapping clusters of views, [O] section 3.

    Needs no pairwise relation between cameras; time grows with the number of blocks times the cameras near each. The
    result doesn't depend on the order of images and points.

    Args:
        scene: A model with z up.
        options: Lengths in units of the model.
    """
    blocks = associate(scene, options)
    clusters = [
        Cluster(
            name=f"x{block.cells[0][0]:04d}_y{block.cells[0][1]:04d}",
            grid=blocks.grid,
            cells=block.cells,
            z_range_m=block.z_range_m,
            num_keypoints=block.num_keypoints,
            is_small=len(block.image_rows) < options.min_cameras_per_cluster,
            image_names=tuple(scene.image_names[row] for row in block.image_rows),
        )
        for block in merge_small_blocks(blocks.kept, options.min_cameras_per_cluster)
    ]
    return Clustering(
        grid=blocks.grid,
        clusters=tuple(clusters),
        dropped=tuple(blocks.dropped),
        num_far_keypoints=blocks.num_far_keypoints,
    )
