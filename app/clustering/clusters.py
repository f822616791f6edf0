"""Clusters of images with common visibility, and the file that keeps them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from app.clustering.association import Block, Blocks, DroppedBlock, DropReason, associate
from app.clustering.grid import Cell, GroundGrid
from app.clustering.merging import merge_small_blocks
from app.clustering.options import ClusteringOptions
from app.errors import InputError
from app.scene.posed_scene import PosedScene
from fusion.region import GroundRegion

FILE_NAME = "clusters.jsonl"
SCENE_FOLDER = "scene"
"""The model as arrays, beside that file."""
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


class LazyClusters(Sequence[Cluster]):
    """Clusters that are made when they are looked at: the names of all their images would fill the memory."""

    def __init__(self, length: int, make: Callable[[int], Cluster]) -> None:
        """So many clusters, each made by its number."""
        self._length, self._make = length, make

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, number: int) -> Cluster: ...
    @overload
    def __getitem__(self, number: slice) -> LazyClusters: ...
    def __getitem__(self, number: int | slice) -> Cluster | LazyClusters:
        chosen = range(self._length)[number]
        if isinstance(chosen, range):
            return LazyClusters(len(chosen), lambda k: self._make(chosen[k]))
        return self._make(chosen)

    def __iter__(self) -> Iterator[Cluster]:
        return map(self._make, range(self._length))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, kw_only=True)
class Clustering:
    """All clusters of a scene, and what none of them holds."""

    grid: GroundGrid
    clusters: Sequence[Cluster]
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
                record = {name: value for name, value in vars(cluster).items() if name != "grid"}
                file.write(json.dumps(record) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Clustering:
        """Read what :meth:`write` wrote.

        Raises:
            InputError: absent, damaged, or written by another version.
        """
        path = folder / FILE_NAME
        try:
            with path.open("rb") as file:
                header = json.loads(file.readline())
                starts = np.cumsum([file.tell(), *(len(line) for line in file)])
            if header["format_version"] != FORMAT_VERSION:
                raise InputError(f"{path} is of another version of cityrecon; run `cityrecon cluster` again")
            grid = GroundGrid(
                origin_m=tuple(header["grid"]["origin_m"]),
                block_size_m=tuple(header["grid"]["block_size_m"]),
                overlap_m=header["grid"]["overlap_m"],
                sample_spacing_m=header["grid"]["sample_spacing_m"],
            )
            dropped = tuple(_dropped_block(record) for record in header["dropped"])
            num_far_keypoints = int(header["num_far_keypoints"])
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}; run `cityrecon cluster` first") from error
        except (ValueError, KeyError, TypeError) as error:
            raise _damaged(path) from error

        def cluster(number: int) -> Cluster:
            try:
                with path.open("rb") as file:
                    file.seek(starts[number])
                    return _cluster(grid, json.loads(file.readline()))
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise _damaged(path) from error

        return cls(
            grid=grid,
            clusters=LazyClusters(len(starts) - 1, cluster),
            dropped=dropped,
            num_far_keypoints=num_far_keypoints,
        )


def _damaged(path: Path) -> InputError:
    return InputError(f"{path} is damaged; remove its folder and run `cityrecon cluster` again")


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


def cluster_views(scene: PosedScene, options: ClusteringOptions, num_threads: int = 1) -> Clustering:
    """Cut a scene into overlapping clusters of views, [O] section 3.

    Needs no pairwise relation between cameras; time grows with the number of blocks times the cameras near each. The
    result doesn't depend on the order of images and points.

    Args:
        scene: A model with z up.
        options: Lengths in units of the model.
        num_threads: Of the search for what hides blocks from images.
    """
    return name_clusters(scene, find_blocks(scene, options, num_threads), options)


def find_blocks(scene: PosedScene, options: ClusteringOptions, num_threads: int = 1) -> Blocks:
    """The blocks of all clusters: cells with keypoints and images, merged where they have few."""
    blocks = associate(scene, options, num_threads)
    return replace(blocks, kept=merge_small_blocks(blocks.kept, options.min_cameras_per_cluster))


def cluster_name(block: Block) -> str:
    """From its first cell: `x0003_y0012`."""
    i, j = block.cells[0]
    return f"x{i:04d}_y{j:04d}"


def name_clusters(scene: PosedScene, blocks: Blocks, options: ClusteringOptions) -> Clustering:
    """The clusters of blocks, with names in place of the scene's rows."""

    def cluster(number: int) -> Cluster:
        block = blocks.kept[number]
        return Cluster(
            name=cluster_name(block),
            grid=blocks.grid,
            cells=block.cells,
            z_range_m=block.z_range_m,
            num_keypoints=block.num_keypoints,
            is_small=len(block.image_rows) < options.min_cameras_per_cluster,
            image_names=scene.image_names.take(block.image_rows),
        )

    return Clustering(
        grid=blocks.grid,
        clusters=LazyClusters(len(blocks.kept), cluster),
        dropped=tuple(blocks.dropped),
        num_far_keypoints=blocks.num_far_keypoints,
    )
