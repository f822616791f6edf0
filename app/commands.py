"""The commands of `cityrecon`: one per stage, and `full`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.command_line import (
    ConfigOption,
    SetOption,
    VerboseOption,
    WorkspaceArgument,
    load_config,
    print_lines,
    run_safely,
    stage_command,
)
from app.config import format_config
from app.run import Run

app = typer.Typer(
    name="cityrecon",
    help="Dense, coloured, metric point clouds of towns from the images of a moving vehicle.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

ImagesArgument = Annotated[
    Path,
    typer.Argument(
        metavar="IMAGES", help="Folder of images, of camera folders or of videos (one per camera); or one video."
    ),
]
CloudArgument = Annotated[Path, typer.Argument(metavar="OUT.ply", help="Point cloud to write.")]
FolderOption = Annotated[
    Path | None, typer.Option("--workspace", metavar="DIR", help="Folder of the run. Default: beside OUT.")
]
GpsOption = Annotated[
    Path | None,
    typer.Option(
        "--gps",
        metavar="FILE",
        help="CSV with name or frame, lat, lon, alt; GPX (for videos); or TUM/KITTI poses as positions.",
    ),
]
RigOption = Annotated[
    Path | None, typer.Option("--rig", metavar="FILE", help="Calibration of the cameras: COLMAP's rig_config.json.")
]
MasksOption = Annotated[
    Path | None, typer.Option("--masks", metavar="DIR", help="Masks in COLMAP's naming, NAME.png; black is ignored.")
]
PosesOption = Annotated[
    Path | None,
    typer.Option("--poses", metavar="FILE", help="Known poses to triangulate with: COLMAP, TUM or KITTI format."),
]
ImportOption = Annotated[
    Path | None, typer.Option("--import", metavar="MODEL", help="Existing COLMAP model to use instead of mapping.")
]
CompareOption = Annotated[
    bool, typer.Option("--compare-batch", help="Also reconstruct the whole set at once, and compare.")
]
PartialOption = Annotated[
    bool, typer.Option("--allow-partial", help="Go on, and end with exit code 0, when some clusters fail.")
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")]


@stage_command(app, "densify", "stereo")
def full(
    run: Run,
    images: ImagesArgument,
    out: CloudArgument,
    workspace: FolderOption = None,
    gps: GpsOption = None,
    rig: RigOption = None,
    masks: MasksOption = None,
    poses: PosesOption = None,
    model: ImportOption = None,
    compare_batch: CompareOption = False,
    allow_partial: PartialOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Images in, point cloud out: all stages, each skipped if its work is done."""
    from app.pipeline import full_pipeline, plan_full
    from app.stages import CaptureSources

    sources = CaptureSources(images=images, gps=gps, rig=rig, masks=masks)
    if dry_run:
        plan_full(run, sources, out=out.absolute())
        return
    full_pipeline(
        run,
        sources,
        out=out.absolute(),
        poses=poses,
        model=model,
        compare_batch=compare_batch,
        allow_partial=allow_partial,
    )


@stage_command(app, "capture")
def capture(
    run: Run,
    images: ImagesArgument,
    workspace: WorkspaceArgument,
    gps: GpsOption = None,
    rig: RigOption = None,
    masks: MasksOption = None,
) -> None:
    """Take stock of images, or extract frames from videos."""
    from app.stages import CaptureSources, capture_stage

    capture_stage(run, CaptureSources(images=images, gps=gps, rig=rig, masks=masks))


@stage_command(app, "sfm")
def sfm(run: Run, poses: PosesOption = None, model: ImportOption = None, dry_run: DryRunOption = False) -> None:
    """Find poses and sparse points (Structure-from-Motion), or import them."""
    from app.stages import plan_sfm, sfm_stage

    if dry_run:
        plan_sfm(run)
    else:
        sfm_stage(run, model=model, poses=poses)


@stage_command(app, "georegister")
def georegister(run: Run) -> None:
    """Turn the model to z up, in metres, in ENU where GPS is known."""
    from app.stages import georegister_stage

    georegister_stage(run)


@stage_command(app, "clustering")
def cluster(run: Run) -> None:
    """Cut the model into overlapping clusters on a ground grid."""
    from app.stages import cluster_stage

    cluster_stage(run)


@stage_command(app, "selection")
def select(run: Run) -> None:
    """Select the smallest set of views of each cluster that sees and matches everything."""
    from app.stages import select_stage

    select_stage(run)


@stage_command(app, "densify", "stereo")
def densify(run: Run, allow_partial: PartialOption = False, dry_run: DryRunOption = False) -> None:
    """Estimate depth and normal maps of each cluster."""
    from app.dense_stages import cluster_jobs
    from app.pipeline import densify_clusters

    densify_clusters(run, cluster_jobs(run), allow_partial=allow_partial, dry_run=dry_run)


@stage_command(app, "fusion")
def fuse(
    run: Run,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="OUT.ply", help="Point cloud to write. Default: WORKSPACE/cloud.ply."),
    ] = None,
    allow_partial: PartialOption = False,
) -> None:
    """Fuse depth maps, crop each cluster to its cells, and merge all into one cloud."""
    from app.dense_stages import cluster_jobs
    from app.pipeline import fuse_clusters

    fuse_clusters(run, cluster_jobs(run), out=out or run.workspace.cloud_file, allow_partial=allow_partial)


@stage_command(app, "densify", "stereo", "fusion")
def batch(
    run: Run,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="OUT.ply", help="Point cloud to write. Default: WORKSPACE/batch/cloud.ply."),
    ] = None,
    dry_run: DryRunOption = False,
) -> None:
    """Reconstruct the whole set at once, with all views, to compare with."""
    from app.pipeline import batch_reconstruction

    batch_reconstruction(run, out=out or run.workspace.batch_cloud_file, dry_run=dry_run)


@app.command()
def compare(
    cloud: Annotated[Path, typer.Argument(metavar="A.ply", help="Cloud to judge.")],
    reference: Annotated[Path, typer.Argument(metavar="B.ply", help="Reference: another cloud, or ground truth.")],
    mesh: Annotated[
        Path | None, typer.Option("--mesh", metavar="GT.ply", help="Surface that accuracy is measured to.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all figures as JSON.")] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE.png", help="Draw both clouds side by side.")
    ] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Accuracy, completeness and F-score of a cloud against another, or against ground truth."""
    from app.comparison import compare_files

    def work() -> None:
        options = load_config(config, settings or []).compare
        typer.echo(compare_files(cloud, reference, mesh=mesh, json_file=json_file, picture=picture, options=options))

    run_safely(work, verbosity=int(verbose))


@app.command()
def explain(
    workspace: WorkspaceArgument,
    clusters: Annotated[
        list[str] | None, typer.Argument(metavar="[CLUSTER]...", help="Clusters to explain. Default: a table of all.")
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Draw all clusters; those named are drawn anyway.")
    ] = False,
    verbose: VerboseOption = False,
) -> None:
    """Say why each view of a cluster was selected, what was relaxed, and what is covered, and draw it."""
    from app.explain import explain as explain_clusters
    from app.workspace import Workspace

    def work() -> None:
        print_lines(explain_clusters(Workspace(workspace.absolute()), clusters or [], draw_all=pictures))

    run_safely(work, verbosity=int(verbose))


@app.command()
def doctor() -> None:
    """Say what is installed, and which back-ends can run here and why not."""
    from app.doctor import diagnose

    run_safely(lambda: typer.echo(diagnose()), verbosity=0)


@app.command()
def config(
    file: Annotated[Path | None, typer.Option("--config", metavar="FILE", help="Start from this file.")] = None,
) -> None:
    """Print all options with their meaning and values, as a TOML file for --config."""
    run_safely(lambda: typer.echo(format_config(load_config(file, []))), verbosity=0)
