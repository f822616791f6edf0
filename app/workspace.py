"""Every path that a run reads or writes, writes that appear whole or not at all, and the lock."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from app.errors import CityReconError, InputError

_FULL_BYTES = 16 << 20
"""What a failed write may have been too large for."""


@dataclass(frozen=True)
class Workspace:
    """The folder that holds all products of one run.

    ``capture/ sfm/ georegister/ clusters/ selection/``, ``jobs/``, ``dense/CLUSTER/ fused/CLUSTER/``, and
    the same under ``batch/``: each is complete (it holds a ``record.json``) or absent; ``*.partial`` is work under way.
    """

    root: Path

    @property
    def log_file(self) -> Path:
        """Full log of all commands run on this workspace."""
        return self.root / "cityrecon.log"

    @property
    def config_file(self) -> Path:
        """Options in force at the last command."""
        return self.root / "config.toml"

    @property
    def inventory_file(self) -> Path:
        """The capture stage's product."""
        return self.root / "capture" / "inventory.json"

    @property
    def sfm_model(self) -> Path:
        """COLMAP model in its own frame and scale."""
        return self.root / "sfm" / "model"

    @property
    def georegistered_model(self) -> Path:
        """COLMAP model, z up, in metres when the scale is known."""
        return self.root / "georegister" / "model"

    @property
    def georeference_file(self) -> Path:
        """Origin, CRS and the sources of scale and gravity."""
        return self.root / "georegister" / "georeference.json"

    @property
    def clusters_file(self) -> Path:
        """One cluster per line."""
        return self.root / "clusters" / "clusters.jsonl"

    @property
    def scene(self) -> Path:
        """The georegistered model as arrays, in the order of the ground."""
        return self.root / "clusters" / "scene"

    @property
    def selection_file(self) -> Path:
        """One cluster's selected views per line."""
        return self.root / "selection" / "selection.jsonl"

    @property
    def cloud_file(self) -> Path:
        """The merged cloud, unless the user names another place."""
        return self.root / "cloud.ply"

    @property
    def batch_cloud_file(self) -> Path:
        """Cloud of the batch reconstruction."""
        return self.root / "batch" / "cloud.ply"

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the workspace; the operating system lets go when the process ends, however it ends.

        Raises:
            InputError: the workspace can't be created or written.
            CityReconError: another run holds it.
        """
        try:
            self.root.mkdir(exist_ok=True)
            handle = os.open(self.root / ".lock", os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise InputError(
                f"cannot write workspace {self.root}: {error.strerror}; create its parent folder or choose another"
            ) from error
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise CityReconError(
                    f"another run is using workspace {self.root}; wait for it or choose another workspace"
                ) from error
            yield
        finally:
            os.close(handle)


def is_disk_full(folder: Path) -> bool:
    """Whether there is hardly any space left, which native libraries report in words that don't say so."""
    return shutil.disk_usage(folder).free < _FULL_BYTES


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write; it replaces ``path`` on success and is removed on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        with partial.open("rb") as handle:
            os.fsync(handle.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def remove_tree(path: Path) -> None:
    """Remove a folder and all in it, if there."""
    if path.exists():
        shutil.rmtree(path)
