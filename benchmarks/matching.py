"""Compare our matching of descriptors with COLMAP's on a CPU: time and inliers on the same features and pairs.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.matching IMAGES [--max-pairs 400]

Both run on one thread, and verify what they match.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from app.capture.capture import capture
from app.capture.options import CaptureOptions
from app.sfm.database import remove_database
from app.sfm.descriptors import match_descriptors
from app.sfm.features import extract_features
from app.sfm.matching import match_pairs
from app.sfm.options import SfmOptions
from app.sfm.pairs import image_pairs
from benchmarks.machine import describe_machine


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path)
    parser.add_argument("--max-pairs", type=int, default=400)
    arguments = parser.parse_args()
    options = SfmOptions(num_threads=1, use_gpu=False)
    with tempfile.TemporaryDirectory() as folder:
        inventory = capture(arguments.images, Path(folder), options=CaptureOptions())
        database_path = Path(folder) / "database.db"
        extract_features(inventory, database_path, options, lambda done, total: None)
        pairs = image_pairs(inventory, options)
        pairs = pairs[:: max(len(pairs) // arguments.max_pairs, 1)]
        print(f"{describe_machine()}\n{arguments.images}: {len(inventory.images)} images, {len(pairs)} pairs")
        with pycolmap.Database.open(database_path) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            data = {name: np.asarray(database.read_descriptors(i).data, np.uint8) for name, i in ids.items()}
        print(f"features per image   {np.mean([len(rows) for rows in data.values()]):.0f}")
        start = time.process_time()
        for first, second in pairs:
            match_descriptors(data[first], data[second])
        print(f"match_descriptors    {(time.process_time() - start) / len(pairs):.4f} CPU-s per pair, unverified")
        start = time.process_time()
        match_pairs(database_path, list(ids), pairs, options, lambda done, total: None)
        _report("ours, verified", database_path, len(pairs), time.process_time() - start)
        with pycolmap.Database.open(database_path) as database:
            database.clear_matches()
            database.clear_two_view_geometries()
        pair_list = Path(folder) / "pairs.txt"
        pair_list.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = options.seed
        start = time.process_time()
        pycolmap.match_image_pairs(
            database_path,
            matching_options=pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False),
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=pair_list),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        _report("COLMAP's, verified", database_path, len(pairs), time.process_time() - start)
        remove_database(database_path)


def _report(label: str, database_path: Path, num_pairs: int, seconds: float) -> None:
    with pycolmap.Database.open(database_path) as database:
        inliers = database.read_two_view_geometry_num_inliers()[1]
    print(f"{label:<20} {seconds / num_pairs:.4f} CPU-s per pair, {sum(inliers):,} inliers")


if __name__ == "__main__":
    main()
