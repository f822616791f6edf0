"""Small text tables with a header row: reading them with errors that name the line."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

from app.errors import InputError

_DELIMITERS = (",", ";", "\t", " ")


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of text cells with their line numbers in the file."""

    path: Path
    columns: tuple[str, ...]
    """Lower case, stripped."""
    rows: tuple[tuple[str, ...], ...]
    line_numbers: tuple[int, ...]

    def column(self, names: tuple[str, ...]) -> int | None:
        """Index of the first of ``names`` that is there."""
        return next((self.columns.index(name) for name in names if name in self.columns), None)

    def number(self, row: int, column: int) -> float:
        """A finite number.

        Raises:
            InputError: naming the line.
        """
        text = self.rows[row][column]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(row, f"{text!r} in column {self.columns[column]!r} is not a number")
        return value

    def error(self, row: int, problem: str) -> InputError:
        """An error that names the line of a row."""
        return InputError(f"{self.path}, line {self.line_numbers[row]}: {problem}; correct or remove the line")


def read_text(path: Path) -> str:
    """Text of a user's file.

    Raises:
        InputError: it can't be read or isn't text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; check the path and its permissions") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file in UTF-8 (byte {error.start}); convert it") from error


def read_table(path: Path) -> Table:
    """Read a table separated by commas, semicolons, tabs or spaces (told from its header).

    Empty lines and lines starting with `#` after the header are skipped; the header itself may start with `#`.

    Raises:
        InputError: no header or no rows, or a row with another number of cells than the header.
    """
    lines = [
        (number, line) for number, line in enumerate(read_text(path).splitlines(), start=1) if line.strip(" \t,;\r")
    ]
    if not lines:
        raise InputError(f"{path} is empty; it must have a header line and one line per frame")
    header = lines[0][1].lstrip("#").strip()
    delimiter = max(_DELIMITERS, key=lambda candidate: (header.count(candidate), -_DELIMITERS.index(candidate)))
    columns = tuple(cell.strip().lower() for cell in _split(header, delimiter))
    rows = []
    numbers = []
    for number, line in lines[1:]:
        if line.lstrip().startswith("#"):
            continue
        cells = tuple(cell.strip() for cell in _split(line.strip() if delimiter == " " else line, delimiter))
        if len(cells) != len(columns):
            raise InputError(
                f"{path}, line {number}: {len(cells)} values where the header has {len(columns)} columns; "
                "correct or remove the line"
            )
        rows.append(cells)
        numbers.append(number)
    return Table(path=path, columns=columns, rows=tuple(rows), line_numbers=tuple(numbers))


def _split(line: str, delimiter: str) -> list[str]:
    try:
        reader = csv.reader(io.StringIO(line), delimiter=delimiter, skipinitialspace=True)
        return next(reader, [])
    except csv.Error:
        return []
