"""A stage runs once, is redone exactly when its inputs or options change, and leaves its folder whole or not at all."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.errors import InputError
from app.stage import RECORD, digest_files, finished_product, is_current, run_stage


@dataclass(frozen=True, kw_only=True)
class Options:
    size: int = 1


class Worker:
    """Counts its calls and writes the given text."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.calls = 0

    def __call__(self, folder: Path) -> None:
        self.calls += 1
        (folder / "product.txt").write_text(self.text)
        (folder / "scratch.txt").write_text(str(self.calls))


def run(folder: Path, worker: Worker, *, size: int = 1, **inputs: str) -> str:
    return run_stage(
        folder,
        options=Options(size=size),
        inputs=inputs,
        work=worker,
        product=lambda made: digest_files([made / "product.txt"]),
    )


def test_skips_what_is_done_and_redoes_what_changed(tmp_path: Path) -> None:
    worker = Worker("a")
    run(tmp_path / "s", worker, model="m1")
    run(tmp_path / "s", worker, model="m1")
    assert worker.calls == 1
    run(tmp_path / "s", worker, model="m2")
    assert worker.calls == 2
    run(tmp_path / "s", worker, model="m2", size=2)
    assert worker.calls == 3
    assert is_current(tmp_path / "s", options=Options(size=2), inputs={"model": "m2"})
    assert not is_current(tmp_path / "s", options=Options(size=3), inputs={"model": "m2"})


def test_product_digest_tells_only_about_the_product(tmp_path: Path) -> None:
    first = run(tmp_path / "s", Worker("a"), model="m1")
    assert run(tmp_path / "s", Worker("a"), model="m2") == first
    assert run(tmp_path / "s", Worker("b"), model="m3") != first


def test_failure_leaves_the_earlier_result_and_the_partial_work(tmp_path: Path) -> None:
    run(tmp_path / "s", Worker("old"), model="m1")

    def fail(folder: Path) -> None:
        (folder / "half.txt").write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        run_stage(tmp_path / "s", options={}, inputs={"model": "m2"}, work=fail, product=lambda _: "")
    assert (tmp_path / "s" / "product.txt").read_text() == "old"

    seen = []
    run_stage(
        tmp_path / "s",
        options={},
        inputs={"model": "m2"},
        work=lambda folder: seen.append((folder / "half.txt").exists()),
        product=lambda _: "",
    )
    assert seen == [True], "the same work goes on where it was stopped"
    assert not (tmp_path / "s" / "product.txt").exists()


def test_partial_work_for_other_options_is_not_reused(tmp_path: Path) -> None:
    def fail(folder: Path) -> None:
        (folder / "half.txt").write_text("half")
        raise OSError

    with pytest.raises(OSError):
        run_stage(tmp_path / "s", options={"a": 1}, inputs={}, work=fail, product=lambda _: "")
    seen = []
    run_stage(
        tmp_path / "s",
        options={"a": 2},
        inputs={},
        work=lambda folder: seen.append((folder / "half.txt").exists()),
        product=lambda _: "",
    )
    assert seen == [False]


@pytest.mark.parametrize("moment", ["work", "before_record", "before_removal", "between_renames"])
def test_kill_at_any_moment_then_the_same_result(tmp_path: Path, moment: str) -> None:
    """A process kills itself at a moment of its second, changed run; a third run must bring the changed result."""
    script = f"""
import os, signal, sys
from pathlib import Path
import app.stage as stage
from app.stage import run_stage, digest_files
def die(*_, **__): os.kill(os.getpid(), signal.SIGKILL)
def work(folder):
    (folder / "product.txt").write_text(sys.argv[1])
    if sys.argv[2] == "work": die()
if sys.argv[2] == "before_record": stage.atomic_file = die
if sys.argv[2] == "before_removal": stage._replace = die
if sys.argv[2] == "between_renames":
    real = stage.remove_tree
    def remove(path):
        real(path)
        if path.name == "s": die()
    stage.remove_tree = remove
run_stage(Path({str(tmp_path / "s")!r}), options={{}}, inputs={{"text": sys.argv[1]}}, work=work,
          product=lambda made: digest_files([made / "product.txt"]))
"""

    def process(text: str, killed_at: str) -> int:
        command = [sys.executable, "-c", script, text, killed_at]
        return subprocess.run(command, check=False, cwd=Path(__file__).parents[2], env=os.environ).returncode

    assert process("old", "never") == 0
    assert process("new", moment) == -signal.SIGKILL
    assert process("new", "never") == 0
    assert (tmp_path / "s" / "product.txt").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s"]
    assert sorted(path.name for path in (tmp_path / "s").iterdir()) == ["product.txt", RECORD]


def test_refuses_what_a_newer_program_made(tmp_path: Path) -> None:
    run(tmp_path / "s", Worker("a"))
    record = json.loads((tmp_path / "s" / RECORD).read_text())
    record["format_version"] += 1
    (tmp_path / "s" / RECORD).write_text(json.dumps(record))
    with pytest.raises(InputError, match="newer cityrecon"):
        run(tmp_path / "s", Worker("a"))


def test_damaged_record_means_doing_it_again(tmp_path: Path) -> None:
    worker = Worker("a")
    run(tmp_path / "s", worker)
    (tmp_path / "s" / RECORD).write_text("{")
    run(tmp_path / "s", worker)
    assert worker.calls == 2


def test_unfinished_stage_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cityrecon cluster"):
        finished_product(tmp_path / "clusters", "cluster")
