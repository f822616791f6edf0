"""COLMAP model -> a scene as a folder of arrays, its points in the order of the ground: a block's lie together.

Written in pieces and mapped into memory, so that the memory in use follows what is looked at, not the city.
"""

from __future__ import annotations

import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import InputError
from app.scene.kernels import gather_tracks
from app.scene.model_pieces import binary_model, read_images, read_points
from app.scene.point_index import TileCounts, tile_keys
from app.scene.posed_scene import ImageNames, PosedScene

_PIECE_POINTS = 1 << 20
_COLUMNS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "point_ids": (np.int64, ()),
    "points_in_world": (np.float64, (3,)),
    "point_colors": (np.uint8, (3,)),
    "point_normals": (np.float32, (3,)),
    "track_lengths": (np.int64, ()),
}


def store_scene(model_dir: Path, scene_dir: Path) -> None:
    """Read a COLMAP model once and store what clustering, selection and dense jobs need of it.

    A point counts once per image, and only with observations in at least two registered images. The points are stored
    in the order of their tiles on the ground, and of their IDs within a tile, whatever their order in the model.

    Args:
        model_dir: Folder with ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.
        scene_dir: Created if need be.

    Raises:
        InputError: the model is absent, cut off, holds poses or points that aren't finite, or unusable names.
    """
    scene_dir.mkdir(parents=True, exist_ok=True)
    with binary_model(model_dir) as binary_dir, tempfile.TemporaryDirectory(dir=scene_dir) as scratch:
        images = read_images(binary_dir, model_dir)
        for field in fields(images):
            value = getattr(images, field.name)
            _save(scene_dir, field.name, value.encoded if isinstance(value, ImageNames) else value)

        raw = Path(scratch)
        tiles, last_id, ascending = TileCounts(), -1, True
        with (raw / "tracks").open("wb") as track_file:
            columns = {name: (raw / name).open("wb") for name in _COLUMNS}
            for piece in read_points(binary_dir, model_dir, images):
                for name, file in columns.items():
                    getattr(piece, name).tofile(file)
                piece.track_images.tofile(track_file)
                tiles.add(tile_keys(piece.points_in_world))
                ids = np.concatenate([[last_id], piece.point_ids])
                ascending = ascending and bool(np.all(ids[1:] > ids[:-1]))
                last_id = int(ids[-1])
            for file in columns.values():
                file.close()
        _store_in_order(raw, scene_dir, tiles, ids_ascend=ascending, model_dir=model_dir)


def open_scene(scene_dir: Path, *, in_memory: bool = False) -> PosedScene:
    """Open what :func:`store_scene` wrote; arrays are mapped from their files unless they are wanted in memory.

    Raises:
        InputError: it isn't there.
    """
    try:
        arrays: dict[str, Any] = {
            field.name: np.asarray(np.load(scene_dir / f"{field.name}.npy", mmap_mode=None if in_memory else "r"))
            for field in fields(PosedScene)
        }
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {scene_dir}: {error}; run `cityrecon cluster` first") from error
    return PosedScene(**arrays | {"image_names": ImageNames(arrays["image_names"])})


def read_posed_scene(model_dir: Path) -> PosedScene:
    """Read a COLMAP model into memory; see :func:`store_scene`."""
    with tempfile.TemporaryDirectory() as scene_dir:
        store_scene(model_dir, Path(scene_dir))
        return open_scene(Path(scene_dir), in_memory=True)


def _save(scene_dir: Path, name: str, array: NDArray[Any]) -> None:
    np.save(scene_dir / f"{name}.npy", array)


def _store_in_order(raw: Path, scene_dir: Path, tiles: TileCounts, *, ids_ascend: bool, model_dir: Path) -> None:
    """Write the point arrays of a scene from raw columns in the order of the model."""
    keys, counts = tiles.total()
    num_points = int(counts.sum())
    columns = {name: _map(raw / name, dtype, (num_points, *shape)) for name, (dtype, shape) in _COLUMNS.items()}
    if not ids_ascend and len(np.unique(columns["point_ids"])) != num_points:
        raise InputError(f"two points in {model_dir} have the same ID; IDs must be unique")
    order = _ground_order(columns, keys, counts, ids_ascend=ids_ascend, path=raw / "order")
    for name in ("point_ids", "points_in_world", "point_colors", "point_normals"):
        out = np.lib.format.open_memmap(
            scene_dir / f"{name}.npy", mode="w+", dtype=columns[name].dtype, shape=columns[name].shape
        )
        for piece in _pieces(num_points):
            out[piece] = columns[name][order[piece]]
    offsets = np.lib.format.open_memmap(scene_dir / "track_offsets.npy", "w+", np.int64, (num_points + 1,))
    raw_offsets = _map(raw / "offsets", np.int64, (num_points + 1,))
    for piece in _pieces(num_points):
        after = slice(piece.start + 1, piece.stop + 1)
        raw_offsets[after] = raw_offsets[piece.start] + np.cumsum(columns["track_lengths"][piece])
        offsets[after] = offsets[piece.start] + np.cumsum(columns["track_lengths"][order[piece]])
    num_elements = int(offsets[-1])
    raw_tracks = _map(raw / "tracks", np.int32, (num_elements,))
    tracks = np.lib.format.open_memmap(scene_dir / "track_images.npy", "w+", np.int32, (num_elements,))
    for piece in _pieces(num_points):
        tracks[offsets[piece.start] : offsets[piece.stop]] = gather_tracks(raw_offsets, raw_tracks, order[piece])


def _ground_order(
    columns: dict[str, NDArray[Any]],
    keys: NDArray[np.int64],
    counts: NDArray[np.int64],
    *,
    ids_ascend: bool,
    path: Path,
) -> NDArray[np.int64]:
    """(P,) rows of the raw columns in the order of tiles and IDs: a counting sort by tile, then a sort within each."""
    num_points = int(counts.sum())
    starts = np.concatenate([[0], np.cumsum(counts)])
    order = _map(path, np.int64, (num_points,))
    filled = starts[:-1].copy()
    for piece in _pieces(num_points):
        tile = np.searchsorted(keys, tile_keys(columns["points_in_world"][piece]))
        by_tile = np.argsort(tile, kind="stable")
        tile = tile[by_tile]
        order[filled[tile] + np.arange(len(tile)) - np.searchsorted(tile, tile)] = piece.start + by_tile
        filled += np.bincount(tile, minlength=len(keys))
    if not ids_ascend:
        for start, end in zip(starts[:-1], starts[1:], strict=True):
            rows = order[start:end]
            order[start:end] = rows[np.argsort(columns["point_ids"][rows])]
    return order


def _pieces(num_points: int) -> list[slice]:
    starts = range(0, num_points, _PIECE_POINTS)
    return [slice(start, min(start + _PIECE_POINTS, num_points)) for start in starts]


def _map(path: Path, dtype: type[np.generic], shape: tuple[int, ...]) -> NDArray[Any]:
    """A file as an array; made if there is none. Files can't be mapped where nothing is in them."""
    if 0 in shape:
        return np.empty(shape, dtype=dtype)
    return np.asarray(np.memmap(path, dtype=dtype, mode="r+" if path.exists() else "w+", shape=shape))
