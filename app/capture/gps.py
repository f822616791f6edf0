"""GPS positions from a table, and their assignment to frames."""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.capture.gpx import read_gpx
from app.capture.inventory import FrameEntry
from app.capture.matching import FrameIndex
from app.capture.tables import Table, read_table
from app.errors import InputError

logger = logging.getLogger(__name__)

_KEY_COLUMNS = ("name", "image", "image_name", "filename", "file", "frame", "frame_id", "number", "index", "id")
_TIME_COLUMNS = ("time_s", "time", "timestamp", "seconds", "t")
_LAT_COLUMNS = ("lat", "latitude", "lat_deg", "latitude_deg")
_LON_COLUMNS = ("lon", "lng", "long", "longitude", "lon_deg", "longitude_deg")
_HEIGHT_COLUMNS = ("alt", "altitude", "height", "ele", "elevation", "alt_m", "altitude_m", "height_m", "ele_m")


@dataclass(frozen=True, kw_only=True)
class GpsTable:
    """Positions in the order of the file. R rows."""

    path: Path
    keys: tuple[str, ...]
    """(R,) image name, frame name or frame number; empty when the rows have times only."""
    times_s: NDArray[np.float64] | None
    """(R,) strictly ascending, when the rows have times and no names."""
    positions: NDArray[np.float64]
    """(R, 3) latitude and longitude in degrees, height in metres or NaN."""


def read_gps_file(path: Path) -> GpsTable:
    """Read a GPS table, or a GPX track (`.gpx`), whose first point is where the videos start.

    A table's header names the columns: one of `name image filename frame index` (or, for videos, `time_s time timestamp
    seconds`), then `lat`, `lon` and optionally `alt`, in any order and with the usual longer names. Other columns
    don't matter.

    Raises:
        InputError: the file, a column or a row can't be used.
    """
    if path.suffix.lower() == ".gpx":
        track = np.array(read_gpx(path))
        return GpsTable(path=path, keys=(), times_s=track[:, 0], positions=track[:, 1:])
    table = read_table(path)
    key, time = table.column(_KEY_COLUMNS), table.column(_TIME_COLUMNS)
    lat, lon, height = (table.column(names) for names in (_LAT_COLUMNS, _LON_COLUMNS, _HEIGHT_COLUMNS))
    if lat is None or lon is None or (key is None and time is None):
        raise InputError(
            f"{path}: the header has columns {', '.join(table.columns)}; needed are one of name, frame or time_s, "
            "and lat, lon and optionally alt"
        )
    if not table.rows:
        raise InputError(f"{path} has a header and no positions; add one line per frame")
    positions = np.full((len(table.rows), 3), math.nan)
    for row, cells in enumerate(table.rows):
        positions[row, 0] = _bounded(table, row, lat, 90.0)
        positions[row, 1] = _bounded(table, row, lon, 180.0)
        if height is not None and cells[height]:
            positions[row, 2] = table.number(row, height)
    if key is not None:
        return GpsTable(path=path, keys=_unique_keys(table, key), times_s=None, positions=positions)
    return GpsTable(path=path, keys=(), times_s=_ascending_times(table, time or 0), positions=positions)


def assign_gps(frames: Sequence[FrameEntry], table: GpsTable) -> dict[str, tuple[float, float, float]]:
    """Position per frame name.

    A row belongs to the image of that name, else to the frame of that name or stem, else to the frame whose number
    is that; where cameras are no rig, to one image of each camera. A frame with several rows (one per camera) gets
    their mean. Rows by time are interpolated.

    Raises:
        InputError: no row fits any frame.
    """
    if table.times_s is not None:
        return _assign_by_time(frames, table, table.times_s)
    index = FrameIndex(frames)
    found: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    unmatched = []
    for key, (lat, lon, height) in zip(table.keys, table.positions.tolist(), strict=True):
        matches = index.find_all(key)
        if not matches:
            unmatched.append(key)
        for frame in matches:
            found[frame.name].append((lat, lon, height))
    if not found:
        raise InputError(
            f"{table.path}: none of its {len(table.keys)} rows fits a frame (first row {table.keys[0]!r}, "
            f"first frame {frames[0].name!r}); use image names, frame names or frame numbers"
        )
    if unmatched:
        logger.info("%s: %d of %d rows belong to no frame here", table.path, len(unmatched), len(table.keys))
    return {name: mean_position(positions) for name, positions in found.items()}


def mean_position(positions: Sequence[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Mean of nearby positions (also across the date line); heights that are NaN don't count."""
    lat, lon, height = np.asarray(positions, dtype=np.float64).T
    offset = (lon - lon[0] + 180.0) % 360.0 - 180.0
    mean_lon = (lon[0] + offset.mean() + 180.0) % 360.0 - 180.0
    known = height[np.isfinite(height)]
    return (
        float(lat.mean()),
        float(lon[0]) if not offset.any() else float(mean_lon),
        float(known.mean()) if len(known) else math.nan,
    )


def _bounded(table: Table, row: int, column: int, limit: float) -> float:
    value = table.number(row, column)
    if abs(value) > limit:
        raise table.error(row, f"{table.columns[column]} {value:g} is not between -{limit:g} and {limit:g} degrees")
    return value


def _unique_keys(table: Table, column: int) -> tuple[str, ...]:
    keys = tuple(cells[column] for cells in table.rows)
    first: dict[str, int] = {}
    for row, key in enumerate(keys):
        if not key:
            raise table.error(row, f"no {table.columns[column]}")
        if first.setdefault(key, row) != row:
            raise table.error(row, f"{key!r} was already given in line {table.line_numbers[first[key]]}")
    return keys


def _ascending_times(table: Table, column: int) -> NDArray[np.float64]:
    times = np.array([table.number(row, column) for row in range(len(table.rows))])
    for row in np.flatnonzero(np.diff(times) <= 0.0)[:1]:
        raise table.error(int(row) + 1, "its time is not after the line before")
    return times


def _assign_by_time(
    frames: Sequence[FrameEntry], table: GpsTable, times_s: NDArray[np.float64]
) -> dict[str, tuple[float, float, float]]:
    timed = [(frame.name, frame.time_s) for frame in frames if frame.time_s is not None]
    if not timed:
        raise InputError(
            f"{table.path} gives positions by time, and only frames of videos have times; give frame names, or write "
            "the track into the images first (exiftool -geotag TRACK.gpx IMAGES)"
        )
    inside = [(name, time) for name, time in timed if times_s[0] <= time <= times_s[-1]]
    if not inside:
        raise InputError(
            f"{table.path}: its times ({times_s[0]:g} to {times_s[-1]:g} s) miss the video's "
            f"({timed[0][1]:g} to {timed[-1][1]:g} s); times are seconds since the video's start"
        )
    wanted = np.array([time for _, time in inside])
    lon = np.unwrap(table.positions[:, 1], period=360.0)
    columns = (table.positions[:, 0], lon, table.positions[:, 2])
    lat, lon, height = (np.interp(wanted, times_s, column) for column in columns)
    lon = (lon + 180.0) % 360.0 - 180.0
    rows = np.stack((lat, lon, height), axis=1).tolist()
    return {name: (row[0], row[1], row[2]) for (name, _), row in zip(inside, rows, strict=True)}
