"""Matching and geometric verification of image pairs, in batches so that it can be stopped and continued."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from app.sfm.database import open_database
from app.sfm.descriptors import Matches, match_descriptors
from app.sfm.features import cuda_works
from app.sfm.options import SfmOptions
from app.sfm.pairs import Pair
from app.workspace import atomic_file

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_BATCH = 200
"""Pairs between two reports of progress."""


def match_pairs(
    database_path: Path, image_names: Sequence[str], pairs: Sequence[Pair], options: SfmOptions, progress: Progress
) -> None:
    """Match and verify the pairs that have not been verified yet.

    Args:
        database_path: with features.
        image_names: all images in the database.
        pairs: names of the images to match.
        options: seed, threads, GPU.
        progress: called with pairs done and pairs in all.
    """
    if not cuda_works(options):
        _match_missing(_match, database_path, pairs, options, progress)
        return
    with _plain_names(database_path, image_names) as plain:
        plain_pairs = [(plain[first], plain[second]) for first, second in pairs]
        _match_missing(_match_on_gpu, database_path, plain_pairs, options, progress)


def _match_missing(
    match: Callable[[Path, Sequence[Pair], SfmOptions], None],
    database_path: Path,
    pairs: Sequence[Pair],
    options: SfmOptions,
    progress: Progress,
) -> None:
    with pycolmap.Database.open(database_path) as database:
        ids = _pair_ids(database, pairs)
        missing = [pair for pair, key in zip(pairs, ids, strict=True) if not database.exists_two_view_geometry(*key)]
    for start in range(0, len(missing), _BATCH):
        batch = missing[start : start + _BATCH]
        match(database_path, batch, options)
        progress(len(pairs) - len(missing) + start + len(batch), len(pairs))


def _match(database_path: Path, pairs: Sequence[Pair], options: SfmOptions) -> None:
    verification = _verification(options)
    with pycolmap.Database.open(database_path) as database, ThreadPoolExecutor(options.threads) as pool:
        ids = _pair_ids(database, pairs)
        images = {image_id: database.read_image(image_id) for image_id in sorted({i for pair in ids for i in pair})}
        cameras = {image_id: database.read_camera(image.camera_id) for image_id, image in images.items()}
        points = {i: np.asarray(database.read_keypoints(i), np.float64)[:, :2] for i in images}
        descriptors = {i: np.asarray(database.read_descriptors(i).data, np.uint8) for i in images}

        def work(pair: tuple[int, int]) -> tuple[Matches, pycolmap.TwoViewGeometry]:
            first, second = pair
            matches = match_descriptors(descriptors[first], descriptors[second])
            geometry = pycolmap.estimate_two_view_geometry(
                cameras[first], points[first], cameras[second], points[second], matches, verification
            )
            return matches, geometry

        found = list(pool.map(work, ids))
        with pycolmap.DatabaseTransaction(database):
            for (first, second), (matches, geometry) in zip(ids, found, strict=True):
                if database.exists_matches(first, second):
                    database.delete_matches(first, second)
                database.write_matches(first, second, matches)
                database.write_two_view_geometry(first, second, geometry)


def _match_on_gpu(database_path: Path, pairs: Sequence[Pair], options: SfmOptions) -> None:
    pair_list = database_path.with_suffix(".pairs.txt")
    with atomic_file(pair_list) as path:
        path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    pycolmap.match_image_pairs(
        database_path,
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=options.threads, use_gpu=True),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pair_list),
        verification_options=_verification(options),
        device=pycolmap.Device.cuda,
    )
    pair_list.unlink()


def _verification(options: SfmOptions) -> pycolmap.TwoViewGeometryOptions:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    return verification


def _pair_ids(database: pycolmap.Database, pairs: Sequence[Pair]) -> list[tuple[int, int]]:
    ids = {image.name: image.image_id for image in database.read_all_images()}
    return [(ids[first], ids[second]) for first, second in pairs]


@contextmanager
def _plain_names(database_path: Path, image_names: Sequence[str]) -> Iterator[dict[str, str]]:
    """Give images other names in the database for a while if COLMAP could not read the names from a list of pairs.

    Lists of pairs are split at spaces. Yields the name in the database of each image.
    """
    names = sorted(image_names)
    plain = {name: name for name in names}
    if any(character.isspace() for name in names for character in name) or any(name.startswith("#") for name in names):
        plain = {name: f"image{index}" for index, name in enumerate(names)}
    _rename(database_path, plain)
    try:
        yield plain
    finally:
        _rename(database_path, {alias: name for name, alias in plain.items()})


def _rename(database_path: Path, new_names: dict[str, str]) -> None:
    """Rename images; those that a killed run left with their new names stay."""
    with open_database(database_path) as database, pycolmap.DatabaseTransaction(database):
        for image in database.read_all_images():
            if new_names.get(image.name, image.name) != image.name:
                image.name = new_names[image.name]
                database.update_image(image)
