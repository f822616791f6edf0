"""[O]'s table 1 beside the same rows of the program, on simulated drives with [O]'s numbers of views and keypoints.

python -m benchmarks.drives seq1 MODELS/seq1        (and seq2 ... seq5)
python -m benchmarks.paper_table MODELS [--sequences seq1 seq5] [--repeats 3] [--max-pictures 0]
                                        [--reference] [--every 4]

[O]'s times are those of its paper: C++ on an Intel Core i5-5300U. With ``--reference`` the plain reference
(benchmarks/reference) clusters each drive too, and selects for every so many of its clusters, on one thread.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from app.clustering.clusters import SCENE_FOLDER, Clustering, find_blocks, name_clusters
from app.clustering.options import ClusteringOptions
from app.scene.posed_scene import PosedScene
from app.scene.read_model import open_scene
from app.view_selection.options import SelectionMethod, SelectionOptions
from app.view_selection.problem import ProblemCutter
from app.view_selection.selection import Selection, read_selections, select_views
from benchmarks.machine import describe_machine
from benchmarks.reference.clustering import PlainCluster, plain_clusters
from benchmarks.reference.quality import plain_quality
from benchmarks.reference.selection import best_quality, meets_all, plain_program, solve
from benchmarks.stage_run import MAX_PICTURES, StageRun, median_run, run_stages

PAPER = {
    "views N": (5131, 6782, 8477, 9912, 11956),
    "keypoints P": (389621, 321696, 349616, 372434, 393246),
    "clusters C": (156, 173, 200, 261, 324),
    "N after clustering": (27103, 32757, 39014, 49758, 58364),
    "K after clustering": (5.28, 4.83, 4.60, 5.02, 4.88),
    "N_c after clustering": (173.75, 189.34, 195.07, 190.64, 180.13),
    "t_clustering, s": (22.35, 28.52, 32.7, 37.32, 40.89),
    "N after selection": (4951, 5842, 6266, 8411, 10138),
    "K after selection": (0.96, 0.86, 0.74, 0.84, 0.85),
    "N_c after selection": (31.73, 33.76, 31.33, 32.22, 31.29),
    "t_selection, s": (50.54, 76.13, 92.4, 124.85, 144.02),
    "t_tot, s": (72.89, 104.65, 125.1, 162.17, 184.91),
}
"""Table 1 of [O], sequences 1 to 5."""
_SOLVER_TOLERANCE = 1e-6
SEQUENCES = ("seq1", "seq2", "seq3", "seq4", "seq5")


def main() -> None:
    """Print the table, and what the reference says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path)
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, default=SEQUENCES)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=1, help="runs of each drive, of which medians are printed")
    parser.add_argument("--max-pictures", type=int, default=MAX_PICTURES, help="of clusters")
    parser.add_argument("--reference", action="store_true")
    parser.add_argument("--every", type=int, default=1, help="the reference selects for every so many clusters")
    arguments = parser.parse_args()
    print(describe_machine())
    with tempfile.TemporaryDirectory() as scratch:
        run_stages(arguments.models / arguments.sequences[0], Path(scratch), SelectionMethod.OPTIMAL, arguments.workers)
        print("kernels compiled before; times are CPU-s of all processes (wall s), reading and writing included;")
        print(f"at most {arguments.max_pictures} pictures of clusters; medians of {arguments.repeats} runs\n")
        columns, runs = [], {}
        for name in arguments.sequences:
            for method in SelectionMethod:
                folder = Path(scratch) / name / method
                runs[name, method] = median_run(
                    [
                        run_stages(arguments.models / name, folder, method, arguments.workers, arguments.max_pictures)
                        for _ in range(arguments.repeats)
                    ]
                )
            columns.append(_column(Path(scratch) / name, [runs[name, method] for method in SelectionMethod]))
        _print_table(arguments.sequences, columns)
        if arguments.reference:
            for name in arguments.sequences:
                _compare(name, Path(scratch) / name, runs[name, SelectionMethod.PAPER], arguments.every)


def _column(folder: Path, runs: list[StageRun]) -> dict[str, str]:
    """The rows of one sequence; where selection decides, `paper` / `optimal`."""
    clusters = json.loads((folder / SelectionMethod.PAPER / "clusters" / "report.json").read_text())
    selected = [json.loads((folder / method / "selection" / "report.json").read_text()) for method in SelectionMethod]

    def both(values: list[str]) -> str:
        return " / ".join(values)

    return {
        "views N": f"{clusters['num_images']}",
        "keypoints P": f"{clusters['num_keypoints']}",
        "clusters C": f"{clusters['num_clusters']}",
        "N after clustering": f"{clusters['num_images_after_clustering']}",
        "K after clustering": f"{clusters['clusters_per_image']:.2f}",
        "N_c after clustering": f"{clusters['images_per_cluster']:.2f}",
        "t_clustering, s": f"{runs[0].clustering.cpu_s:.2f} ({runs[0].clustering.wall_s:.2f})",
        "N after selection": both([f"{report['num_images_after_selection']}" for report in selected]),
        "K after selection": both([f"{report['clusters_per_image']:.2f}" for report in selected]),
        "N_c after selection": both([f"{report['images_per_cluster']:.2f}" for report in selected]),
        "t_selection, s": both([f"{run.selection.cpu_s:.2f} ({run.selection.wall_s:.2f})" for run in runs]),
        "t_tot, s": both([f"{run.cpu_s:.2f} ({run.wall_s:.2f})" for run in runs]),
    }


def _print_table(sequences: tuple[str, ...], columns: list[dict[str, str]]) -> None:
    print("| | " + " | ".join(f"{name}, [O] | {name}, paper / optimal" for name in sequences) + " |")
    print("|---" * (2 * len(sequences) + 1) + "|")
    for row, published in PAPER.items():
        cells = [
            f"{published[SEQUENCES.index(name)]} | {column[row]}"
            for name, column in zip(sequences, columns, strict=True)
        ]
        print(f"| {row} | " + " | ".join(cells) + " |")


def _compare(name: str, folder: Path, run: StageRun, every: int) -> None:
    """Run the reference on a sequence and print speed-up and agreement."""
    scene = open_scene(folder / SelectionMethod.PAPER / "clusters" / SCENE_FOLDER)
    options = ClusteringOptions()
    started = time.process_time()
    plain = plain_clusters(scene, options)
    clustering_s = time.process_time() - started
    same = _same_clusters(scene, Clustering.read(folder / SelectionMethod.PAPER / "clusters"), plain)
    print(
        f"\n{name}: reference clustering {clustering_s:.1f} CPU-s; clusters {'agree' if same else 'DIFFER'}", flush=True
    )

    found = {method: list(read_selections(folder / method / "selection")) for method in SelectionMethod}
    chosen = range(0, len(plain), every)
    spent_s = dict.fromkeys(SelectionMethod, 0.0)
    equal, allowed = dict.fromkeys(SelectionMethod, 0), dict.fromkeys(SelectionMethod, 0)
    num_best = 0
    for number in chosen:
        started = time.process_time()
        program = plain_program(scene, plain[number], options, SelectionOptions())
        built_s = time.process_time() - started
        for method in SelectionMethod:
            started = time.process_time()
            smallest = solve(program, force_best_views=method is SelectionMethod.PAPER)
            spent_s[method] += built_s + time.process_time() - started
            ours = _rows(scene, found[method][number])
            equal[method] += len(ours) == len(smallest)
            allowed[method] += meets_all(program, ours)
        quality = found[SelectionMethod.OPTIMAL][number].quality
        best = best_quality(program, *plain_quality(scene, program), len(smallest)) if program.usable.any() else 0.0
        num_best += abs(quality - best) <= _SOLVER_TOLERANCE * best
    for method in SelectionMethod:
        total_s = spent_s[method] * len(plain) / len(chosen)
        sampled = "" if every == 1 else f", extrapolated from {spent_s[method]:.1f} CPU-s"
        print(
            f"{name} {method}: reference selection {total_s:.0f} CPU-s for {len(plain)} clusters{sampled}; of "
            f"{len(chosen)} clusters compared, {equal[method]} have the same size, {allowed[method]} of the program's "
            "selections meet every constraint of the reference"
        )
    print(f"{name} optimal: {num_best} of {len(chosen)} have the total quality of the reference's optimum")
    total_s = clustering_s + spent_s[SelectionMethod.PAPER] * len(plain) / len(chosen)
    own_s = _program_s(scene)
    print(
        f"{name}: both stages as in [O], without reading and writing, on one thread: {total_s:.0f} CPU-s in the "
        f"reference, {own_s:.2f} in the program: {total_s / own_s:.0f} times. With reading, writing and pictures the "
        f"program's stages took {run.wall_s:.2f} s of wall time: {total_s / run.wall_s:.0f} times",
        flush=True,
    )


def _program_s(scene: PosedScene) -> float:
    """CPU-seconds of the program on one thread for what the reference does; kernels are loaded before."""
    options = SelectionOptions(method=SelectionMethod.PAPER)
    spent_s = []
    for last in (1, None):
        started = time.process_time()
        clusters = name_clusters(scene, find_blocks(scene, ClusteringOptions()), ClusteringOptions()).clusters
        cutter = ProblemCutter(scene)
        for cluster in clusters[:last]:
            select_views(cutter.problem(cluster, options.visibility), options)
        spent_s.append(time.process_time() - started)
    return spent_s[-1]


def _same_clusters(scene: PosedScene, clustering: Clustering, plain: list[PlainCluster]) -> bool:
    """Whether cells and images are the same, cluster by cluster."""
    shift = [round(origin / size) for origin, size in zip(*_grid(clustering), strict=True)]
    ours = [
        (tuple((i + shift[0], j + shift[1]) for i, j in cluster.cells), set(cluster.image_names))
        for cluster in clustering.clusters
    ]
    return ours == [(cluster.cells, {scene.image_names[row] for row in cluster.images}) for cluster in plain]


def _grid(clustering: Clustering) -> tuple[tuple[float, float], tuple[float, float]]:
    return clustering.grid.origin_m, clustering.grid.block_size_m


def _rows(scene: PosedScene, selection: Selection) -> frozenset[int]:
    return frozenset(scene.image_names.rows_of(selection.image_names).tolist())


if __name__ == "__main__":
    main()
