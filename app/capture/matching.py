"""Find the frame that a table's key means."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TypeVar

from app.capture.inventory import FrameEntry
from app.capture.scan import stem_of

_AMBIGUOUS = "ambiguous"
_Key = TypeVar("_Key", int, str)


class FrameIndex:
    """Frames by image name, frame name, file name, stem and number, the exact ones first."""

    def __init__(self, frames: Iterable[FrameEntry]) -> None:
        self._by_name: dict[str, FrameEntry] = {}
        self._by_file: dict[str, FrameEntry | str] = {}
        self._by_number: dict[int, FrameEntry | str] = {}
        for frame in frames:
            self._by_name.setdefault(frame.name, frame)
            for image in frame.images.values():
                self._by_name[image] = frame
                for key in (image.rpartition("/")[2], stem_of(image)):
                    _add(self._by_file, key, frame)
            number = frame_number(frame)
            if number is not None:
                _add(self._by_number, number, frame)

    def find(self, key: str) -> FrameEntry | None:
        """The frame of an image name, frame name, file name, stem or number; None if there is none or several."""
        found: FrameEntry | str | None = self._by_name.get(key)
        if found is None:
            found = self._by_file.get(key)
        if found is None and re.fullmatch(r"\d{1,18}", key):
            found = self._by_number.get(int(key))
        return found if isinstance(found, FrameEntry) else None


def frame_number(frame: FrameEntry) -> int | None:
    """The last number in a frame's file stem: 12 for `cam0/frame_0012.jpg`."""
    numbers = re.findall(r"\d{1,18}", stem_of(next(iter(frame.images.values()), frame.name)))
    return int(numbers[-1]) if numbers else None


def _add(table: dict[_Key, FrameEntry | str], key: _Key, frame: FrameEntry) -> None:
    if table.setdefault(key, frame) is not frame:
        table[key] = _AMBIGUOUS
