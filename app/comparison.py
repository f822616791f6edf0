"""Compare two cloud files: a table, figures as JSON, and a picture."""

from __future__ import annotations

from pathlib import Path

from app.errors import InputError
from app.workspace import atomic_file
from fusion.cloud import read_ply
from fusion.compare import CompareOptions, compare_clouds, format_table
from fusion.picture import draw_side_by_side


def compare_files(
    cloud: Path,
    reference: Path,
    *,
    mesh: Path | None,
    json_file: Path | None,
    picture: Path | None,
    options: CompareOptions,
) -> str:
    """Compare a cloud with a reference.

    Args:
        cloud: PLY file to judge.
        reference: PLY file to judge it by.
        mesh: PLY file of the surface that accuracy is measured to; the reference if None.
        json_file: where all figures go, if given.
        picture: PNG file with both clouds side by side, if given.
        options: thresholds and thinning.

    Returns:
        A readable table.

    Raises:
        InputError: a file doesn't exist.
        CloudFormatError: a file isn't a cloud or a mesh.
    """
    for path in (cloud, reference, mesh):
        if path is not None and not path.is_file():
            raise InputError(f"{path} doesn't exist; give the path of a PLY file")
    clouds = read_ply(cloud), read_ply(reference)
    comparison = compare_clouds(*clouds, mesh=mesh, options=options)
    if json_file is not None:
        with atomic_file(json_file) as partial:
            partial.write_text(comparison.to_json() + "\n", encoding="utf-8")
    if picture is not None:
        draw_side_by_side(picture, [(cloud.stem, clouds[0]), (reference.stem, clouds[1])])
    return format_table(comparison)
