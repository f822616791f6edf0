"""Find the images and videos of a folder, and refuse names that can't be carried safely through a model."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from app.errors import InputError

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".3gp"}
)


@dataclass(frozen=True, kw_only=True)
class Listing:
    """Names relative to the scanned folder, with `/`, in natural order."""

    images: tuple[str, ...]
    videos: tuple[str, ...]


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Sort key under which `a9` comes before `a10`."""
    parts: list[str | int] = list(re.split(r"(\d+)", name))
    parts[1::2] = [int(part) for part in parts[1::2]]
    return parts, name


def camera_of(image_name: str) -> str:
    """Camera name of an image: its folder, empty for the root."""
    return image_name.rpartition("/")[0]


def stem_of(image_name: str) -> str:
    """File name without folder and suffix."""
    file = image_name.rpartition("/")[2]
    dot = file.rfind(".")
    return file[:dot] if dot > 0 else file


def scan(root: Path, *, exclude: Sequence[Path] = ()) -> Listing:
    """List all images and videos under ``root``; hidden files and folders and other files don't count.

    Args:
        root: an existing folder, resolved.
        exclude: resolved folders to stay out of (masks, the workspace).

    Raises:
        InputError: the folder can't be read, or holds links that lead out of it, or names that aren't plain text.
    """
    images: list[str] = []
    videos: list[str] = []
    leaving: list[str] = []
    pending = [(root, "")]
    while pending:
        folder, prefix = pending.pop()
        try:
            with os.scandir(folder) as iterator:
                entries = list(iterator)
        except OSError as error:
            raise InputError(f"cannot read folder {folder}: {error.strerror}; give permission to read it") from error
        for entry in entries:
            name = prefix + entry.name
            suffix = PurePosixPath(entry.name).suffix.lower()
            is_media = suffix in IMAGE_SUFFIXES or suffix in VIDEO_SUFFIXES
            if entry.name.startswith("."):
                continue
            if entry.is_symlink() and (is_media or entry.is_dir()):
                target = Path(entry.path).resolve()
                if not target.is_relative_to(root):
                    leaving.append(f"{name} -> {target}")
                    continue
            if entry.is_dir():
                if entry.is_symlink():
                    logger.info("%s is a link to a folder within %s: not looked at twice", name, root)
                elif Path(entry.path) not in exclude:
                    pending.append((Path(entry.path), f"{name}/"))
            elif is_media:
                _check_name(root, name)
                (images if suffix in IMAGE_SUFFIXES else videos).append(name)
    if leaving:
        raise InputError(
            f"{len(leaving)} link(s) in {root} lead out of it (first: {leaving[0]}); "
            "copy the files into the folder, or give the folder that holds them"
        )
    return Listing(images=tuple(sorted(images, key=natural_key)), videos=tuple(sorted(videos, key=natural_key)))


def check_stems(root: Path, images: Sequence[str]) -> None:
    """Refuse two images of one camera that differ by suffix only: they would be the same frame.

    Raises:
        InputError: naming the first pair.
    """
    seen: dict[tuple[str, str], str] = {}
    for name in images:
        other = seen.setdefault((camera_of(name), stem_of(name)), name)
        if other != name:
            raise InputError(
                f"{root}: images {other} and {name} differ only by their suffix; keep one of them, "
                "or put them into different folders"
            )


def _check_name(root: Path, name: str) -> None:
    try:
        name.encode("utf-8")
        plain = name.isprintable()
    except UnicodeEncodeError:
        plain = False
    if not plain:
        raise InputError(f"{root}: image name {name!r} holds bytes that aren't printable UTF-8 text; rename it")
