"""Jobs in processes of their own: failures of every kind are reported, and end nobody else."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from app.errors import CityReconError
from app.executor import run_jobs, split_cores


def behave(how: str, output: Path, report) -> None:  # type: ignore[no-untyped-def]
    report(1, 2)
    if how == "fails":
        raise CityReconError("no such thing")
    if how == "has a bug":
        raise KeyError("oops")
    if how == "is killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "aborts":
        os.abort()
    output.write_text("done")


def test_each_end_of_a_job_is_reported(tmp_path: Path) -> None:
    ways = ["works", "fails", "has a bug", "is killed", "aborts", "works too"]
    ended: dict[str, str | None] = {}
    progress = []
    run_jobs(
        behave,
        {way: (way, tmp_path / way) for way in ways},
        num_workers=2,
        log_file=tmp_path / "log",
        on_progress=lambda name, done, total: progress.append((name, done, total)),
        on_done=ended.__setitem__,
    )
    assert ended["works"] is None
    assert ended["works too"] is None
    assert (tmp_path / "works too").read_text() == "done"
    assert ended["fails"] == "no such thing"
    assert "exit code 1" in str(ended["has a bug"])
    assert "SIGKILL" in str(ended["is killed"])
    assert "SIGABRT" in str(ended["aborts"])
    assert sorted(progress) == sorted((way, 1, 2) for way in ways)
    assert "KeyError: 'oops'" in (tmp_path / "log").read_text(), "a bug's traceback is in the log file"


def write_gpu(output: Path, report) -> None:  # type: ignore[no-untyped-def]
    output.write_text(os.environ["CUDA_VISIBLE_DEVICES"])
    while len(list(output.parent.glob("job*"))) < 2:
        time.sleep(0.02)


def test_each_job_has_a_gpu_of_its_own(tmp_path: Path) -> None:
    """Two at a time, each waiting for the other, then a third."""
    run_jobs(
        write_gpu,
        {name: (tmp_path / name,) for name in ("job1", "job2", "job3")},
        num_workers=2,
        log_file=tmp_path / "log",
        on_progress=lambda name, done, total: None,
        on_done=lambda name, reason: None,
        environments=[{"CUDA_VISIBLE_DEVICES": "3"}, {"CUDA_VISIBLE_DEVICES": "5"}],
    )
    gpus = [(tmp_path / name).read_text() for name in ("job1", "job2", "job3")]
    assert sorted(gpus[:2]) == ["3", "5"]
    assert gpus[2] in ("3", "5")
    assert "CUDA_VISIBLE_DEVICES" not in os.environ


def wait_forever(pid_file: Path, report) -> None:  # type: ignore[no-untyped-def]
    pid_file.write_text(str(os.getpid()))
    time.sleep(600)


def test_jobs_die_with_a_killed_parent(tmp_path: Path) -> None:
    script = f"""
from pathlib import Path
from app.executor import run_jobs
from tests.unit.test_executor import wait_forever
if __name__ == "__main__":
    folder = Path({str(tmp_path)!r})
    run_jobs(wait_forever, {{"a": (folder / "pid",)}}, num_workers=1, log_file=folder / "log",
             on_progress=print, on_done=print)
"""
    main = tmp_path / "main.py"
    main.write_text(script)
    root = str(Path(__file__).parents[2])
    parent = subprocess.Popen([sys.executable, str(main)], cwd=root, env={**os.environ, "PYTHONPATH": root})
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        assert parent.poll() is None
        time.sleep(0.05)
    child = int((tmp_path / "pid").read_text())
    parent.kill()
    parent.wait()
    for _ in range(100):
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or state.read_text().split(")")[1].split()[0] == "Z":
            return
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    raise AssertionError("the job outlived its parent by 5 s")


def test_cores_are_shared_out() -> None:
    processes, threads = split_cores(1, 0)
    assert processes == 1
    assert threads == len(os.sched_getaffinity(0))
    assert split_cores(1000, 1) == (1, threads)
    assert split_cores(0, 0)[0] == 1
