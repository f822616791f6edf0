"""Judge a run on a rendered street by its exact ground truth: camera positions, then clouds.

    python -m benchmarks.ground_truth WORKSPACE TRUTH CLOUD.ply [CLOUD.ply ...]

TRUTH is a folder with `poses_gt.json`, `gt.ply`, `gt_mesh.ply` and, for errors in the world's own frame, `truth.json`,
as `sample_data.render_street` writes them. Clouds are scored as they are (georegistered, so the noise of the GPS
counts), after the rigid motion that fits the cameras best, and after the similarity that does, which leaves the
errors of stereo.
Both sides are thinned to 5 cm voxels; accuracy is measured to the mesh, completeness to the samples of `gt.ply`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pycolmap

from app.georegister.georeference import Georeference
from app.scene.read_model import read_posed_scene
from benchmarks.alignment import Motion, fit_rigid, fit_similarity, moved, position_errors
from benchmarks.machine import describe_machine
from fusion.cloud import read_ply
from fusion.compare import CompareOptions, compare_clouds


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("clouds", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print(describe_machine(), end="\n\n")
    scene = read_posed_scene(arguments.workspace / "georegister" / "model")
    truth = {
        entry["image"]: np.array(entry["C"])
        for entry in json.loads((arguments.truth / "poses_gt.json").read_text(encoding="utf-8"))
    }
    expected = np.array([truth[name] for name in scene.image_names])
    shift = _truth_from_world(arguments.workspace, arguments.truth)
    fitted = fit_rigid(scene.centers_in_world, expected)
    print(f"registered images      {len(scene.image_names)} of {len(truth)}")
    figures: dict[str, object] = {"registered": len(scene.image_names), "images": len(truth)}
    frames = {} if shift is None else {"as georegistered": shift}
    frames |= {"rigid fit": fitted, "similarity fit": fit_similarity(scene.centers_in_world, expected)}
    for frame, motion in frames.items():
        errors = 100 * position_errors(scene.centers_in_world, expected, motion)
        print(
            f"position error, {frame:18} median {np.median(errors):6.2f} cm, 95 % {np.percentile(errors, 95):6.2f} cm"
        )
        figures[f"median position error, {frame}, m"] = float(np.median(errors)) / 100
    reference = read_ply(arguments.truth / "gt.ply")
    print(f"\n{'cloud':24}{'frame':18}{'points':>12}" + "".join(f"{t:>20}" for t in ("5 cm", "10 cm", "20 cm")))
    for path in arguments.clouds:
        cloud = read_ply(path)
        for frame, motion in frames.items():
            comparison = compare_clouds(
                moved(cloud, motion),
                reference,
                mesh=arguments.truth / "gt_mesh.ply",
                options=CompareOptions(thresholds_m=(0.05, 0.1, 0.2)),
            )
            scores = "".join(
                f"{f'{100 * s.accuracy:.1f} / {100 * s.completeness:.1f} / {100 * s.f_score:.1f}':>20}"
                for s in comparison.scores
            )
            print(f"{path.name:24}{frame:18}{len(cloud):>12,}{scores}")
            figures[f"{path.name}, {frame}"] = json.loads(comparison.to_json())
    print("\naccuracy / completeness / F-score in %")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def _truth_from_world(workspace: Path, truth: Path) -> Motion | None:
    """Rotation and translation from the georegistered frame to the truth's, by the origins of both."""
    georeference = Georeference.read(workspace / "georegister" / "georeference.json")
    if georeference.origin_deg_m is None or not (truth / "truth.json").exists():
        return None
    origin = json.loads((truth / "truth.json").read_text(encoding="utf-8"))["origin_lat_lon_alt"]
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    corners = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]])
    geodetic = np.array(transform.enu_to_ellipsoid(corners, *georeference.origin_deg_m))
    moved = np.array(transform.ellipsoid_to_enu(geodetic, *origin))
    return (moved[1:] - moved[0]).T / 100, moved[0]


if __name__ == "__main__":
    main()
