"""Find the frame that a table's key means."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable

from app.capture.inventory import FrameEntry
from app.capture.scan import stem_of


class FrameIndex:
    """Frames by image name, frame name, file name, stem and number, the exact ones first."""

    def __init__(self, frames: Iterable[FrameEntry]) -> None:
        self._by_name: dict[str, FrameEntry] = {}
        self._by_file: dict[str, list[FrameEntry]] = defaultdict(list)
        self._by_number: dict[int, list[FrameEntry]] = defaultdict(list)
        for frame in frames:
            self._by_name.setdefault(frame.name, frame)
            for image in frame.images.values():
                self._by_name[image] = frame
                for key in {image.rpartition("/")[2], stem_of(image)}:
                    _add(self._by_file[key], frame)
            number = frame_number(frame)
            if number is not None:
                _add(self._by_number[number], frame)

    def find(self, key: str) -> FrameEntry | None:
        """The frame of an image name, frame name, file name, stem or number; None if there is none or several."""
        found = self.find_all(key)
        return found[0] if len(found) == 1 else None

    def find_all(self, key: str) -> list[FrameEntry]:
        """The same, or one frame of each camera where cameras are no rig; none if one camera has several."""
        if key in self._by_name:
            return [self._by_name[key]]
        found = self._by_file.get(key, [])
        if not found and re.fullmatch(r"\d{1,18}", key):
            found = self._by_number.get(int(key), [])
        cameras = [camera for frame in found for camera in frame.images]
        return found if len(set(cameras)) == len(cameras) else []


def frame_number(frame: FrameEntry) -> int | None:
    """The last number in a frame's file stem: 12 for `cam0/frame_0012.jpg`."""
    numbers = re.findall(r"\d{1,18}", stem_of(next(iter(frame.images.values()), frame.name)))
    return int(numbers[-1]) if numbers else None


def _add(frames: list[FrameEntry], frame: FrameEntry) -> None:
    if not frames or frames[-1] is not frame:
        frames.append(frame)
