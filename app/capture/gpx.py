"""Tracks in GPX, as dashcams and phones write them (GPX 1.1 schema, topografix.com)."""

from __future__ import annotations

import logging
import math
import xml.etree.ElementTree as ElementTree
from datetime import UTC, datetime
from pathlib import Path

from app.capture.tables import read_text
from app.errors import InputError

logger = logging.getLogger(__name__)

TrackPoint = tuple[float, float, float, float]
"""Seconds since the first point, latitude and longitude in degrees, height in metres (NaN when there is none)."""


def read_gpx(path: Path) -> list[TrackPoint]:
    """Points of all tracks in a file, in order of time. Of points at the same time the first counts.

    Raises:
        InputError: it isn't GPX, or has fewer than two track points with times.
    """
    try:
        root = ElementTree.fromstring(read_text(path))
    except ElementTree.ParseError as error:
        raise InputError(f"{path} is not a GPX file ({error}); export the track again") from error
    points: dict[float, TrackPoint] = {}
    for number, element in enumerate(root.iterfind(".//{*}trkpt"), start=1):
        time = _text(element, "time")
        if time is None:
            continue
        try:
            seconds = _utc(time).timestamp()
            lat, lon = float(element.get("lat", "")), float(element.get("lon", ""))
            height = float(_text(element, "ele") or math.nan)
        except ValueError as error:
            raise InputError(f"{path}, track point {number}: {error}; export the track again") from error
        if not (abs(lat) <= 90.0 and abs(lon) <= 180.0):
            raise InputError(f"{path}, track point {number}: ({lat:g}, {lon:g}) is no place on Earth; remove it")
        points.setdefault(seconds, (seconds, lat, lon, height))
    if len(points) < 2:
        raise InputError(f"{path} has {len(points)} track points with times, at least two are needed")
    start = min(points)
    track = [(seconds - start, *points[seconds][1:]) for seconds in sorted(points)]
    logger.info("%s: %d positions in %.0f s; the first is taken for the videos' start", path, len(track), track[-1][0])
    return track


def _text(element: ElementTree.Element, name: str) -> str | None:
    found = element.find("{*}" + name)
    return None if found is None or found.text is None else found.text.strip()


def _utc(text: str) -> datetime:
    time = datetime.fromisoformat(text)
    return time if time.tzinfo is not None else time.replace(tzinfo=UTC)
