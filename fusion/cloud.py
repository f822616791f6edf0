"""Point clouds in memory and in PLY files.

Coordinates are metres relative to the origin kept in ``georeference.json``, so single precision is enough: half a
millimetre at 8 km.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from fusion.errors import CloudFormatError

logger = logging.getLogger(__name__)

_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_LINES = 1000
_COUNT_DIGITS = 20
_CHUNK_POINTS = 1_000_000
_COARSE_SPACING_M = 1e-3


@dataclass(frozen=True)
class PointCloud:
    """Points with, where known, their unit normals and colours."""

    points: NDArray[np.float32]
    """(N, 3) coordinates in metres."""
    normals: NDArray[np.float32] | None = None
    """(N, 3) unit vectors that point away from the surface, towards who saw it."""
    colors: NDArray[np.uint8] | None = None
    """(N, 3) red, green, blue."""

    def __post_init__(self) -> None:
        """Check shapes and types, which the writer and the kernels rely on."""
        for name, values, dtype in (
            ("points", self.points, np.float32),
            ("normals", self.normals, np.float32),
            ("colors", self.colors, np.uint8),
        ):
            if values is None:
                continue
            if values.shape != (len(self.points), 3) or values.dtype != dtype:
                raise ValueError(
                    f"{name} must be a ({len(self.points)}, 3) array of {dtype.__name__}, "
                    f"not {values.shape} of {values.dtype}"
                )

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def select(self, which: NDArray[np.bool_] | NDArray[np.integer]) -> PointCloud:
        """Return the points that a mask (N,) or an index array picks, in that order."""
        return PointCloud(
            self.points[which],
            None if self.normals is None else self.normals[which],
            None if self.colors is None else self.colors[which],
        )

    @staticmethod
    def concatenate(clouds: Sequence[PointCloud]) -> PointCloud:
        """Join clouds in the given order; normals and colours stay only where every cloud has them."""
        normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
        colors = [cloud.colors for cloud in clouds if cloud.colors is not None]
        points = [cloud.points for cloud in clouds]
        return PointCloud(
            np.concatenate(points) if points else np.empty((0, 3), dtype=np.float32),
            np.concatenate(normals) if clouds and len(normals) == len(clouds) else None,
            np.concatenate(colors) if clouds and len(colors) == len(clouds) else None,
        )


def _record_type(has_normals: bool, has_colors: bool) -> np.dtype[np.void]:
    """Packed little-endian record of one vertex."""
    fields: list[tuple[str, str]] = [(name, "<f4") for name in ("x", "y", "z")]
    if has_normals:
        fields += [(name, "<f4") for name in ("nx", "ny", "nz")]
    if has_colors:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    return np.dtype(fields)


class PlyWriter:
    """Write a binary PLY file piece by piece; the number of points need not be known beforehand.

    The count goes into the header when the block ends without an error; a comment line takes up the slack, so the
    header keeps its length. After an error the file says that it has no points.

    Example:
        with PlyWriter(path, has_normals=True, has_colors=True) as writer:
            for cloud in clouds:
                writer.append(cloud)
    """

    def __init__(self, path: Path, *, has_normals: bool, has_colors: bool) -> None:
        """Open the file and write its header.

        Args:
            path: File to create or overwrite.
            has_normals: Whether vertices carry normals; every appended cloud must have them then.
            has_colors: Whether vertices carry colours; every appended cloud must have them then.
        """
        self._dtype = _record_type(has_normals, has_colors)
        self._has_normals = has_normals
        self._has_colors = has_colors
        self._file: BinaryIO = path.open("wb")
        self.n_points = 0
        self._file.write(self._header(0))

    def _header(self, n_points: int) -> bytes:
        """Header of constant length for any number of points."""
        lines = ["ply", "format binary_little_endian 1.0"]
        lines.append("comment written by cityrecon" + " " * (_COUNT_DIGITS - len(str(n_points))))
        lines.append(f"element vertex {n_points}")
        for name in self._dtype.names or ():
            lines.append(f"property {'uchar' if self._dtype[name].itemsize == 1 else 'float'} {name}")
        return ("\n".join(lines) + "\nend_header\n").encode("ascii")

    def append(self, cloud: PointCloud) -> None:
        """Add the points of a cloud after those already written.

        Raises:
            ValueError: The cloud lacks normals or colours that the header has announced.
        """
        records = np.empty(len(cloud), dtype=self._dtype)
        columns: list[tuple[str, NDArray[np.float32] | NDArray[np.uint8] | None]] = [("x y z", cloud.points)]
        if self._has_normals:
            columns.append(("nx ny nz", cloud.normals))
        if self._has_colors:
            columns.append(("red green blue", cloud.colors))
        for names, values in columns:
            if values is None:
                raise ValueError(f"the cloud must have {names}, which the file's header has announced")
            for axis, name in enumerate(names.split()):
                records[name] = values[:, axis]
        self._file.write(records.tobytes())
        self.n_points += len(cloud)

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the number of points into the header, unless an error ended the block, and close the file."""
        with self._file:
            if kind is None:
                self._file.seek(0)
                self._file.write(self._header(self.n_points))


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary little-endian PLY: x y z [nx ny nz] as float, [red green blue] as uchar."""
    with PlyWriter(path, has_normals=cloud.normals is not None, has_colors=cloud.colors is not None) as writer:
        for start in range(0, len(cloud), _CHUNK_POINTS):
            writer.append(cloud.select(np.arange(start, min(start + _CHUNK_POINTS, len(cloud)))))


@dataclass
class _Element:
    """One element of a PLY header with its properties: (name, type) or, for lists, (name, count type, type)."""

    name: str
    count: int
    properties: list[tuple[str, ...]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(len(entry) == 3 for entry in self.properties)

    def record_type(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(entry[0], order + entry[1]) for entry in self.properties])


def _read_header(file: BinaryIO, path: Path) -> tuple[str, list[_Element]]:
    """Read up to and including ``end_header``; return the file's format and its elements in order."""
    if file.readline(16).strip() != b"ply":
        raise CloudFormatError(f"{path}: not a PLY file; give a point cloud in PLY format")
    layout = ""
    elements: list[_Element] = []
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(4096)
        match line.decode("ascii", errors="replace").split():
            case ["end_header"]:
                if not layout:
                    raise CloudFormatError(f"{path}: the PLY header names no format; export the cloud again")
                return layout, elements
            case ["format", name, _] if name in _BYTE_ORDERS:
                layout = name
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count)))
            case ["property", "list", count_type, item_type, name] if (
                elements and count_type in _PLY_TYPES and item_type in _PLY_TYPES
            ):
                elements[-1].properties.append((name, _PLY_TYPES[count_type], _PLY_TYPES[item_type]))
            case ["property", type_name, name] if elements and type_name in _PLY_TYPES:
                elements[-1].properties.append((name, _PLY_TYPES[type_name]))
            case [("comment" | "obj_info"), *_]:
                continue
            case _:
                break
    raise CloudFormatError(f"{path}: the PLY header is damaged; export the cloud again")


def _truncated(path: Path) -> CloudFormatError:
    return CloudFormatError(f"{path}: the file ends before its last point; copy or export it again")


def _skip_element(file: BinaryIO, element: _Element, layout: str, path: Path) -> None:
    """Move past an element that stands before the vertices."""
    order = _BYTE_ORDERS[layout]
    if layout == "ascii":
        for _ in range(element.count):
            file.readline()
    elif not element.has_lists:
        file.seek(element.count * element.record_type(order).itemsize, 1)
    else:
        for _ in range(element.count):
            for entry in element.properties:
                length = 1
                if len(entry) == 3:
                    counter = np.dtype(order + entry[1])
                    data = file.read(counter.itemsize)
                    if len(data) < counter.itemsize:
                        raise _truncated(path)
                    length = int(np.frombuffer(data, counter)[0])
                file.seek(length * np.dtype(order + entry[-1]).itemsize, 1)


def _cloud_of_columns(columns: dict[str, NDArray[np.generic]], path: Path) -> PointCloud:
    """Build a cloud from named columns, each (N,) in the type that the file has."""

    def stack(*names: str) -> NDArray[np.generic] | None:
        return np.stack([columns[name] for name in names], axis=1) if all(n in columns for n in names) else None

    points = stack("x", "y", "z")
    normals = stack("nx", "ny", "nz")
    colors = stack("red", "green", "blue")
    if colors is None:
        colors = stack("diffuse_red", "diffuse_green", "diffuse_blue")
    if points is None:
        raise CloudFormatError(f"{path}: the vertices lack x, y or z; export the cloud again")
    if not np.isfinite(points.astype(np.float64)).all():
        raise CloudFormatError(f"{path}: some points have coordinates that aren't finite; remove them first")
    if colors is not None and colors.dtype != np.uint8:
        scale = 255.0 if colors.dtype.kind == "f" else 255.0 / np.iinfo(colors.dtype.str).max
        colors = np.rint(np.clip(colors.astype(np.float64) * scale, 0, 255))
    return PointCloud(
        points.astype(np.float32),
        None if normals is None else normals.astype(np.float32),
        None if colors is None else colors.astype(np.uint8),
    )


def read_ply_chunks(path: Path, chunk_points: int = _CHUNK_POINTS) -> Iterator[PointCloud]:
    """Read the vertices of a PLY file piece by piece, at most `chunk_points` at a time.

    Binary files of either byte order and ASCII files, coordinates of any number type; other elements and properties are
    skipped.

    Raises:
        CloudFormatError: Not a PLY file, damaged, cut short, without points, or with coordinates that aren't finite.
        OSError: The file can't be read.
    """
    with path.open("rb") as file:
        layout, elements = _read_header(file, path)
        vertices = next((element for element in elements if element.name == "vertex"), None)
        if vertices is None or vertices.count == 0:
            raise CloudFormatError(f"{path}: there are no points in this file")
        names = [entry[0] for entry in vertices.properties]
        if vertices.has_lists or len(set(names)) < len(names):
            raise CloudFormatError(f"{path}: the vertices have list or repeated properties; export the cloud again")
        for element in elements[: elements.index(vertices)]:
            _skip_element(file, element, layout, path)
        for start in range(0, vertices.count, chunk_points):
            count = min(chunk_points, vertices.count - start)
            columns: dict[str, NDArray[np.generic]]
            if layout == "ascii":
                rows = [file.readline().split()[: len(names)] for _ in range(count)]
                if not all(len(row) == len(names) for row in rows):
                    raise _truncated(path)
                try:
                    table = np.array(rows, dtype=np.float64)
                except ValueError as error:
                    raise CloudFormatError(f"{path}: a vertex isn't made of numbers; export the cloud again") from error
                columns = {name: table[:, i].astype(kind) for i, (name, kind) in enumerate(vertices.properties)}
            else:
                dtype = vertices.record_type(_BYTE_ORDERS[layout])
                data = file.read(count * dtype.itemsize)
                if len(data) < count * dtype.itemsize:
                    raise _truncated(path)
                records = np.frombuffer(data, dtype)
                columns = {name: records[name] for name in names}
            yield _cloud_of_columns(columns, path)


def read_ply(path: Path) -> PointCloud:
    """Read a whole PLY file; see `read_ply_chunks` for what it may hold and for the errors."""
    cloud = PointCloud.concatenate(list(read_ply_chunks(path)))
    largest = np.abs(cloud.points).max()
    if np.spacing(largest) > _COARSE_SPACING_M:
        logger.warning(
            "%s: coordinates up to %.0f m keep steps of only %.1f mm in single precision; subtract an origin first",
            path,
            largest,
            1e3 * np.spacing(largest),
        )
    return cloud
