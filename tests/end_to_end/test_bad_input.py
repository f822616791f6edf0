"""What can't be used is refused in one line, with the right exit code, and nothing is broken by it."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from tests.small_street import STREET, FinishedRun, cityrecon, refused


def copy_images(folder: Path, number: int) -> list[Path]:
    folder.mkdir(parents=True)
    images = [folder / f"{frame:06d}.jpg" for frame in range(number)]
    for image in images:
        shutil.copy(STREET / "images" / "cam0" / image.name, image)
    return images


def no_images(folder: Path) -> None:
    folder.mkdir()
    (folder / "notes.txt").write_text("no image")


def one_image(folder: Path) -> None:
    copy_images(folder, 1)


def truncated_image(folder: Path) -> None:
    last = copy_images(folder, 3)[-1]
    last.write_bytes(last.read_bytes()[:20000])


def unreadable_image(folder: Path) -> None:
    copy_images(folder, 3)
    (folder / "000003.jpg").symlink_to(folder / "nowhere.jpg")


def mixed_sizes(folder: Path) -> None:
    last = copy_images(folder, 3)[-1]
    cv2.imwrite(str(last), np.zeros((100, 100, 3), np.uint8))


def nothing_in_common(folder: Path) -> None:
    folder.mkdir()
    rng = np.random.default_rng(1)
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(str(folder / name), rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (no_images, "no images in"),
        (one_image, "at least two that overlap are needed"),
        (truncated_image, "000002.jpg: "),
        (unreadable_image, "000003.jpg: "),
        (mixed_sizes, "mixes images of different sizes"),
        (nothing_in_common, "show the same thing"),
    ],
)
def test_images_that_cannot_be_used(tmp_path: Path, make: Callable[[Path], None], complaint: str) -> None:
    make(tmp_path / "images")
    out = tmp_path / "town.ply"
    out.write_text("an earlier result")
    assert complaint in refused(cityrecon("full", tmp_path / "images", out))
    assert out.read_text() == "an earlier result"
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("option", "text", "complaint"),
    [
        ("--gps", "frame,lat,lon,alt\n000000,44.8,10.3,60\n000001,north,10.3,60\n", "line 3"),
        ("--gps", "frame,lat,lon,alt\n000000,44.8,10.3,60\n000001,144.8,10.3,60\n", "line 3"),
        ("--gps", "when,where\n1,here\n", "file"),
        ("--rig", "[{", "file"),
        ("--config", "[sfm\nstrategies = 1", "is not TOML"),
        ("--config", "[sfm]\nmax_num_features = 'many'", "max_num_features"),
    ],
)
def test_files_that_cannot_be_used(tmp_path: Path, option: str, text: str, complaint: str) -> None:
    copy_images(tmp_path / "images", 2)
    file = tmp_path / "file"
    file.write_text(text)
    message = refused(cityrecon("full", tmp_path / "images", tmp_path / "town.ply", option, file))
    assert str(file) in message
    assert complaint in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "images"]


def test_an_unknown_option_is_named(tmp_path: Path) -> None:
    result = cityrecon("full", tmp_path, tmp_path / "town.ply", "--fast")
    assert result.returncode == 2
    assert "--fast" in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("out", "workspace"),
    [("/proc/town.ply", None), ("/proc/town.ply", "ws"), ("town.ply", "file"), ("town.ply", "/proc/ws")],
)
def test_places_that_cannot_be_written(tmp_path: Path, out: str, workspace: str | None) -> None:
    copy_images(tmp_path / "images", 2)
    (tmp_path / "file").write_text("not a folder")
    more = [] if workspace is None else ["--workspace", tmp_path / workspace]
    refused(cityrecon("full", tmp_path / "images", tmp_path / out, *more))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "images"]
    assert (tmp_path / "file").read_text() == "not a folder"


def outside_the_folder(model: pycolmap.Reconstruction) -> None:
    for image_id, image in model.images.items():
        image.name = f"../{image_id}.jpg"


def not_finite(model: pycolmap.Reconstruction) -> None:
    frame = model.frames[min(model.frames)]
    frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, np.array([np.nan, 0.0, 0.0]))


def of_other_images(model: pycolmap.Reconstruction) -> None:
    for image_id, image in model.images.items():
        image.name = f"elsewhere/{image_id}.jpg"


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (outside_the_folder, "leaves the image folder"),
        (not_finite, "not finite"),
        (of_other_images, "are not in"),
    ],
)
def test_models_that_cannot_be_imported(
    finished_run: FinishedRun, tmp_path: Path, damage: Callable[[pycolmap.Reconstruction], None], complaint: str
) -> None:
    model = pycolmap.Reconstruction(finished_run.workspace / "sfm" / "model")
    damage(model)
    (tmp_path / "model").mkdir()
    model.write_binary(tmp_path / "model")
    out = tmp_path / "town.ply"
    message = refused(cityrecon("full", finished_run.scene / "images", out, "--import", tmp_path / "model"))
    assert complaint in message
    assert not out.exists()


def limited(num_bytes: int) -> str:
    """Code that lets no file of a process and its children grow beyond a size, as a full disk would."""
    return f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({num_bytes}, {num_bytes}))"


def test_no_space_for_the_cloud(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace, out = finished_run.copy_to(tmp_path), tmp_path / "town.ply"
    out.write_text("an earlier result")
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] == resource.RLIM_INFINITY
    limit = limited(finished_run.out.stat().st_size // 2)
    message = refused(cityrecon("fuse", workspace, "--out", out, before=limit), exit_code=1)
    assert "File too large" in message
    assert out.read_text() == "an earlier result"
    assert not list(tmp_path.glob(".*"))
    assert cityrecon("fuse", workspace, "--out", out).returncode == 0
    assert out.read_bytes() == finished_run.out.read_bytes()


def test_no_space_for_maps_or_features(finished_run: FinishedRun, tmp_path: Path) -> None:
    workspace = finished_run.copy_to(tmp_path)
    (workspace / "cityrecon.log").unlink()
    smallest = min((workspace / "dense").iterdir(), key=lambda folder: len(list((folder / "images").rglob("*.jpg"))))
    shutil.rmtree(smallest)
    result = cityrecon("densify", workspace, before=limited(100_000))
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert result.stderr.count("error: ") == 2, "the cluster's, and that of the command"
    assert not smallest.exists()

    shutil.rmtree(workspace / "sfm")
    result = cityrecon("sfm", workspace, before=limited(200_000))
    refused(result, exit_code=1)
    assert not (workspace / "sfm").exists()
