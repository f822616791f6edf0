"""GPS position and orientation from the EXIF block of a JPEG file.

COLMAP's reader decodes the whole image to get at its EXIF data, some 50 times slower; it is used for focal lengths
(one image per camera), not for positions (all images).
"""

from __future__ import annotations

import math
import struct

_ORIENTATION_TAG = 0x0112
_GPS_IFD_TAG = 0x8825
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT = range(1, 7)
_TYPE_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8}
_MAX_ENTRIES = 512


def gps_from_exif(tiff: bytes) -> tuple[float, float, float] | None:
    """Position in an EXIF block.

    Args:
        tiff: the block from its byte order mark on (after `Exif\\0\\0`).

    Returns:
        Latitude and longitude in degrees and height in metres (NaN if there is none), or None where there is no
        valid position. (0, 0) is what cameras write without a fix, and counts as none.
    """
    try:
        order, root = _read_root(tiff)
        if _GPS_IFD_TAG not in root:
            return None
        gps = _read_ifd(tiff, order, struct.unpack(order + "I", root[_GPS_IFD_TAG][1][:4])[0])
        lat = _angle_deg(gps, order, _LAT, _LAT_REF, b"S")
        lon = _angle_deg(gps, order, _LON, _LON_REF, b"W")
        height = math.nan
        if _ALT in gps:
            height = _rationals(gps[_ALT], order, 1)[0]
            if gps.get(_ALT_REF, (1, b"\0"))[1][:1] == b"\1":
                height = -height
    except (struct.error, KeyError, ZeroDivisionError):
        return None
    if abs(lat) > 90.0 or abs(lon) > 180.0 or (lat == 0.0 and lon == 0.0):
        return None
    return lat, lon, height


def quarter_turns_from_exif(tiff: bytes) -> int:
    """Clockwise quarter turns, 0 to 3, that show the pixels as stored upright; 0 where the block doesn't say.

    Mirrored orientations, which cameras don't write, count as 0.
    """
    try:
        order, root = _read_root(tiff)
        (value,) = struct.unpack(order + "H", root[_ORIENTATION_TAG][1][:2])
    except (struct.error, KeyError):
        return 0
    return {6: 1, 3: 2, 8: 3}.get(value, 0)


def _read_root(tiff: bytes) -> tuple[str, dict[int, tuple[int, bytes]]]:
    """Byte order and first directory; an empty one if the block isn't EXIF."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return "<", {}
    return order, _read_ifd(tiff, order, struct.unpack_from(order + "I", tiff, 4)[0])


def _read_ifd(tiff: bytes, order: str, offset: int) -> dict[int, tuple[int, bytes]]:
    """Entries of one directory: tag to (type, value bytes)."""
    (count,) = struct.unpack_from(order + "H", tiff, offset)
    entries = {}
    for index in range(min(count, _MAX_ENTRIES)):
        position = offset + 2 + 12 * index
        tag, kind, length = struct.unpack_from(order + "HHI", tiff, position)
        size = _TYPE_SIZES.get(kind, 0) * length
        start = position + 8 if size <= 4 else struct.unpack_from(order + "I", tiff, position + 8)[0]
        entries[tag] = (kind, tiff[start : start + size])
    return entries


def _rationals(entry: tuple[int, bytes], order: str, count: int) -> list[float]:
    values = struct.unpack(f"{order}{2 * count}I", entry[1][: 8 * count])
    return [top / bottom for top, bottom in zip(values[::2], values[1::2], strict=True)]


def _angle_deg(gps: dict[int, tuple[int, bytes]], order: str, tag: int, ref_tag: int, negative: bytes) -> float:
    values = struct.unpack(f"{order}6I", gps[tag][1][:24])
    # Some cameras write 0/0 for seconds that they fold into the minutes.
    degrees, minutes, seconds = (
        0.0 if top == 0 and bottom == 0 else top / bottom for top, bottom in zip(values[::2], values[1::2], strict=True)
    )
    angle: float = degrees + minutes / 60.0 + seconds / 3600.0
    return -angle if gps[ref_tag][1][:1] == negative else angle
