"""What every dense back-end must do, asked of each: for real where it can run, else against its stand-in.

       x x x x      four cameras side by side, looking along z
        \\| |/
    ============    a slanted plane, about 5 away

The stand-ins (`tests/stand_ins/`) read their input by the rules of the program's own source, refuse what deviates, and
answer with the true maps in the program's own format. OPENMVS and ACM may name the folders of OpenMVS's programs and of
ACMP and its kin, which are tested too then, as is COLMAP where it finds a GPU.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvs_backends import get_backend
from mvs_backends.base import MvsError, MvsJob, MvsOptions, MvsView
from mvs_backends.colmap_maps import write_maps
from tests.reference.colmap_maps import read_map
from tests.reference.plane_scene import plane_job, true_depth, write_model

ROOT = Path(__file__).parents[2]
NORMAL, OFFSET = np.array([0.4, 0.2, 1.0]) / np.linalg.norm([0.4, 0.2, 1.0]), 5.0
WIDTH, HEIGHT = 160, 112
PROGRAMS = {
    "colmap": ("colmap", ("colmap",)),
    "acmp": ("acm", ("ACMP",)),
    "acmh": ("acm", ("ACMH",)),
    "acmm": ("acm", ("ACMM",)),
    "acmmp": ("acm", ("ACMMP",)),
    "openmvs": ("openmvs", ("InterfaceCOLMAP", "DensifyPointCloud")),
}
"""Stand-in, and the names of its executables."""
ADAPTERS = ("colmap", "acmp", "openmvs")
"""One back-end of each adapter."""


@dataclass(frozen=True)
class Subject:
    """A back-end under test."""

    name: str
    options: MvsOptions
    exact: bool = True
    """Answers with the truth, at every pixel."""

    def estimate(self, job: MvsJob) -> None:
        get_backend(self.name).estimate(job=job, options=self.options, num_threads=1)


def install(name: str, folder: Path) -> MvsOptions:
    """Executables that stand in for a program."""
    stand_in, executables = PROGRAMS[name]
    folder.mkdir(exist_ok=True)
    for executable in executables:
        path = folder / executable
        path.write_text(
            f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\n"
            f"from tests.stand_ins.{stand_in} import main\nmain()\n",
            encoding="utf-8",
        )
        path.chmod(0o755)
    option = {"acm": "acmp_path", "colmap": "colmap_path", "openmvs": "openmvs_path"}[stand_in]
    return MvsOptions(**{option: str(folder)})  # type: ignore[arg-type]


def subject(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Subject:
    monkeypatch.setenv("PLANE", " ".join(map(str, [*NORMAL, OFFSET])))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if name == "patchmatch":
        return Subject(name, MvsOptions(), exact=False)
    if not name.startswith("real "):
        return Subject(name, install(name, tmp_path / "bin"))
    name = name.removeprefix("real ")
    nowhere = str(tmp_path / "nowhere")
    options = MvsOptions(
        openmvs_path=os.environ.get("OPENMVS", nowhere), acmp_path=os.environ.get("ACM", nowhere), gpu_index="0"
    )
    available = get_backend(name).availability(options)
    if not available.ok:
        pytest.skip(available.reason)
    return Subject(name, options, exact=False)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> MvsJob:
    job = plane_job(
        tmp_path_factory.mktemp("job") / "job", normal=(0.4, 0.2, 1.0), size=(WIDTH, HEIGHT), num_points=200
    )
    write_model(job)
    return job


@pytest.fixture
def job(template: MvsJob, tmp_path: Path) -> MvsJob:
    shutil.copytree(template.workspace, tmp_path / "job")
    return replace(template, workspace=tmp_path / "job")


def check_maps(subject: Subject, job: MvsJob, view: int, max_x: float = np.inf, first_column: int = 0) -> None:
    """Both maps are true where the plane is in the region and not masked, and empty elsewhere."""
    camera = job.views[view]
    depth, normal = read_map(job.depth_map_path(view)), read_map(job.normal_map_path(view))
    known = depth > 0
    np.testing.assert_array_equal(np.linalg.norm(normal, axis=-1) > 0.5, known)
    assert not known[:, :first_column].any()
    assert (world_x(camera, depth)[known] <= max_x + (1e-3 if subject.exact else 1e-2)).all()
    wanted = world_x(camera, true_depth(camera, NORMAL, OFFSET)) <= max_x - (1e-3 if subject.exact else 0.1)
    wanted[:, :first_column] = False
    assert wanted.mean() > 0.1
    found = known & wanted
    assert found.sum() > (0.9999 if subject.exact else 0.5) * wanted.sum()
    error = np.abs(depth / true_depth(camera, NORMAL, OFFSET) - 1)[found]
    expected = camera.cam_from_world[:, :3] @ -NORMAL
    assert expected[2] < 0, "faces the camera"
    angle_deg = np.degrees(np.arccos(np.clip(normal[found] @ expected, -1, 1)))
    assert np.quantile(error, 1.0 if subject.exact else 0.9) < (2e-5 if subject.exact else 0.01)
    assert np.quantile(angle_deg, 1.0 if subject.exact else 0.9) < (0.1 if subject.exact else 20.0)


def world_x(camera: MvsView, depth: np.ndarray) -> np.ndarray:
    """(H, W) where in the world, along x, each pixel's point is."""
    pixels = np.stack([*np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), np.ones((HEIGHT, WIDTH))], -1)
    in_camera = pixels @ np.linalg.inv(camera.calibration).T * depth[..., None]
    in_world: np.ndarray = (in_camera - camera.cam_from_world[:, 3]) @ camera.cam_from_world[:, :3]
    return in_world[..., 0]


@pytest.mark.parametrize("name", [*PROGRAMS, "patchmatch", *(f"real {name}" for name in PROGRAMS)])
def test_maps_are_true_in_the_region_where_not_masked(
    name: str, job: MvsJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The region cuts the plane at x = 1; the left half of one image is masked; the last view shares nothing."""
    alone = plane_job(tmp_path / "alone", normal=(0.4, 0.2, 1.0), size=(WIDTH, HEIGHT), num_points=200)
    job = replace(
        alone,
        boxes_in_world=np.array([[[-8.0, -8.0, 2.0], [1.0, 8.0, 12.0]]]),
        mask_dir=tmp_path / "masks",
        sources=((1, 2), (0, 2), (0, 1), ()),
        point_views=(*alone.point_views[:3], np.zeros(0, np.int64)),
    )
    write_model(job)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    (tmp_path / "masks" / "cam").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "masks" / f"{job.views[1].name}.png"), mask)
    tested = subject(name, tmp_path, monkeypatch)
    tested.estimate(job)
    for view in range(3):
        check_maps(tested, job, view, max_x=1.0, first_column=WIDTH // 2 if view == 1 else 0)
    assert not read_map(job.depth_map_path(3)).any() and not read_map(job.normal_map_path(3)).any()
    assert not [p for p in (job.workspace / "stereo").glob("*") if p.is_dir() and not p.name.endswith("_maps")]


FAULTS = {
    "exit": {"": r"ended with exit code 1; its last lines: .*(CUDA|cannot load)"},
    "kill": {"": "was ended by SIGKILL"},
    "hang": {"": r"ran longer than 0\.5 s and was stopped"},
    "partial": {"colmap": "left no whole maps of cam", "acmp": "is no map of 160x112", "openmvs": "can't be read"},
    "garbage": {
        "colmap": "left no whole maps of cam",
        "acmp": "is no map of 160x112",
        "openmvs": "can't be read|no depth",
    },
    "foreign": {"colmap": "pixels, its image", "acmp": "is no map of 160x112", "openmvs": "made with another pose"},
    "full disk": {"colmap": "left no whole maps of cam", "acmp": "is no map of 160x112", "openmvs": "can't be read"},
}
"""What the message says, for one back-end or for all."""


@pytest.mark.parametrize("name", ADAPTERS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_in_one_line_and_the_next_call_does_the_work(
    fault: str, name: str, job: MvsJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested = subject(name, tmp_path, monkeypatch)
    monkeypatch.setenv("FAULT", fault)
    faulty = replace(tested, options=replace(tested.options, program_timeout_s=0.5 if fault == "hang" else 0.0))
    with full_disk() if fault == "full disk" else nothing(), pytest.raises(MvsError) as caught:
        faulty.estimate(job)
    expected = FAULTS[fault]
    assert re.search(expected.get(name) or expected[""], str(caught.value))
    assert "\n" not in str(caught.value)
    if fault in ("exit", "hang"):
        return  # nothing was left that the next call could stumble over
    monkeypatch.delenv("FAULT")
    tested.estimate(job)
    for view in range(len(job.views)):
        check_maps(tested, job, view)


@contextmanager
def full_disk() -> Iterator[None]:
    """No file grows beyond what configurations need, here and in programs that are started."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def nothing() -> Iterator[None]:
    yield


def test_a_full_disk_leaves_no_map_of_ours(job: MvsJob) -> None:
    depth, normal = np.ones((HEIGHT, WIDTH), np.float32), np.ones((HEIGHT, WIDTH, 3), np.float32)
    with full_disk(), pytest.raises(OSError, match="geometric.bin"):
        write_maps(job, 0, depth, normal)
    assert not [path for path in (job.workspace / "stereo").rglob("*") if path.is_file()]


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_missing_program_says_what_to_do(
    name: str, job: MvsJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (option,) = [key for key, value in vars(install(name, tmp_path / "bin")).items() if value == str(tmp_path / "bin")]
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("pycolmap.has_cuda", False)
    for given in ("", str(tmp_path), str(tmp_path / "nowhere")):
        availability = get_backend(name).availability(MvsOptions(**{option: given}))  # type: ignore[arg-type]
        assert not availability.ok and "\n" not in availability.reason
        assert f"--{option.replace('_', '-')}" in availability.reason
    with pytest.raises(MvsError, match=re.escape(availability.reason.partition(" at ")[0].partition(" in ")[0])):
        get_backend(name).estimate(job=job, options=MvsOptions(), num_threads=1)


@pytest.mark.parametrize("name", ["acmp", "openmvs"])
def test_the_program_is_found_on_path_and_by_its_path(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = install(name, tmp_path / "bin")
    assert get_backend(name).availability(options).ok
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    assert get_backend(name).availability(MvsOptions()).ok
    if name == "acmp":
        assert get_backend(name).availability(MvsOptions(acmp_path=str(tmp_path / "bin" / "ACMP"))).ok
