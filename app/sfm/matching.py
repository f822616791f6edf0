"""Matching and geometric verification of image pairs, in batches so that it can be stopped and continued."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from app.sfm.database import open_database
from app.sfm.features import cuda_works
from app.sfm.options import SfmOptions
from app.sfm.pairs import Pair
from app.workspace import atomic_file

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_BATCH = 500
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
    with _plain_names(database_path, image_names) as plain_names:
        ids = _ids_by_name(database_path)
        with pycolmap.Database.open(database_path) as database:
            verified = set(database.read_two_view_geometry_num_inliers()[0])
        missing = [
            pair
            for pair in ((plain_names[first], plain_names[second]) for first, second in pairs)
            if pycolmap.image_pair_to_pair_id(ids[pair[0]], ids[pair[1]]) not in verified
        ]
        for start in range(0, len(missing), _BATCH):
            batch = missing[start : start + _BATCH]
            _match(database_path, batch, options)
            progress(len(pairs) - len(missing) + start + len(batch), len(pairs))


def _match(database_path: Path, pairs: Sequence[Pair], options: SfmOptions) -> None:
    pair_list = database_path.with_suffix(".pairs.txt")
    with atomic_file(pair_list) as path:
        path.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    gpu = cuda_works(options)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    pycolmap.match_image_pairs(
        database_path,
        matching_options=pycolmap.FeatureMatchingOptions(num_threads=options.threads, use_gpu=gpu),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pair_list),
        verification_options=verification,
        device=pycolmap.Device.cuda if gpu else pycolmap.Device.cpu,
    )
    pair_list.unlink()


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


def _ids_by_name(database_path: Path) -> dict[str, int]:
    with pycolmap.Database.open(database_path) as database:
        return {image.name: image.image_id for image in database.read_all_images()}
