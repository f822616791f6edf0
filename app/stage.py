"""Run a stage once: skip it while its inputs and options are the same, and leave its folder whole or not at all."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

from app.errors import InputError
from app.workspace import atomic_file, remove_tree

logger = logging.getLogger(__name__)

FORMAT_VERSION = 1
"""Of the products in a workspace. Raised when a change makes older products unusable."""
RECORD = "record.json"


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """What a finished stage was made from."""

    stage: str
    options: dict[str, Any]
    inputs: dict[str, str]
    """Digest of each input."""
    product: str
    """Digest of what later stages read."""
    seconds: float
    format_version: int = FORMAT_VERSION

    @property
    def fingerprint(self) -> str:
        """Tells apart what a stage was made from."""
        return digest(self.options, self.inputs, self.format_version)

    @classmethod
    def read(cls, folder: Path) -> StageRecord | None:
        """The record in a stage's folder, or None if the stage isn't finished.

        Raises:
            InputError: a newer program made it.
        """
        try:
            data = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            logger.warning("%s is unreadable (%s); doing that stage again", folder / RECORD, error)
            return None
        if data.get("format_version", 0) > FORMAT_VERSION:
            raise InputError(
                f"{folder} was made by a newer cityrecon; update the program or choose another --workspace"
            )
        try:
            return cls(**data)
        except TypeError:
            return None


def digest(*parts: object) -> str:
    """Hash of JSON-able values and dataclasses."""
    text = json.dumps(parts, sort_keys=True, default=_plain, ensure_ascii=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def digest_files(paths: Iterable[Path]) -> str:
    """Hash of the contents of files and, sorted by name, of the files in folders."""
    state = hashlib.blake2b(digest_size=16)
    for path in paths:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in files:
            state.update(file.relative_to(path).as_posix().encode() + b"\0")
            with file.open("rb") as handle:
                while chunk := handle.read(1 << 20):
                    state.update(chunk)
    return state.hexdigest()


def _as_json(options: object) -> dict[str, Any]:
    return dict(json.loads(json.dumps(options, default=_plain)))


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return str(value)


def run_stage(
    folder: Path,
    *,
    options: object,
    inputs: Mapping[str, str],
    work: Callable[[Path], object],
    product: Callable[[Path], str],
) -> str:
    """Make ``folder`` by ``work`` unless it is there, made from the same inputs with the same options.

    ``work`` fills ``FOLDER.partial``, which becomes ``folder`` when it returns. A stopped run is continued in the same
    partial folder, as long as inputs and options are the same.

    Args:
        folder: the stage's folder.
        options: dataclass or JSON-able value.
        inputs: digest of each input.
        work: called with the partial folder.
        product: digest, given the filled folder, of what later stages read.

    Returns:
        Digest of the product: later stages are redone only if it changes.
    """
    name = folder.name
    plain_options = _as_json(options)
    wanted = digest(plain_options, dict(inputs), FORMAT_VERSION)
    partial = folder.with_name(f"{name}.partial")
    if StageRecord.read(partial) is not None:
        _replace(partial, folder)
    record = StageRecord.read(folder)
    if record is not None:
        if record.fingerprint == wanted:
            logger.info("%s: up to date", name)
            return record.product
        logger.info("%s: redoing, because of %s", name, _difference(record, plain_options, inputs))
    ticket = partial / ".for"
    if not (ticket.exists() and ticket.read_text(encoding="utf-8") == wanted):
        remove_tree(partial)
        partial.mkdir(parents=True)
        ticket.write_text(wanted, encoding="utf-8")
    start = time.monotonic()
    work(partial)
    made = StageRecord(
        stage=name,
        options=plain_options,
        inputs=dict(inputs),
        product=product(partial),
        seconds=round(time.monotonic() - start, 2),
    )
    ticket.unlink(missing_ok=True)
    with atomic_file(partial / RECORD) as path:
        path.write_text(json.dumps(asdict(made), indent=1) + "\n", encoding="utf-8")
    _replace(partial, folder)
    logger.debug("%s: %.1f s", name, made.seconds)
    return made.product


def is_current(folder: Path, *, options: object, inputs: Mapping[str, str]) -> bool:
    """Whether `run_stage` would have nothing to do."""
    record = StageRecord.read(folder)
    return record is not None and record.fingerprint == digest(_as_json(options), dict(inputs), FORMAT_VERSION)


def finished_record(folder: Path, command: str) -> StageRecord:
    """The record of a stage that must have been run.

    Raises:
        InputError: it hasn't.
    """
    record = StageRecord.read(folder)
    if record is None:
        raise InputError(f"{folder} is missing or unfinished; run `cityrecon {command}` first")
    return record


def finished_product(folder: Path, command: str) -> str:
    """Product digest of a stage that must have been run.

    Raises:
        InputError: it hasn't.
    """
    return finished_record(folder, command).product


def _replace(partial: Path, folder: Path) -> None:
    """Put a finished partial folder in place; a kill in between leaves the finished partial one, which counts."""
    remove_tree(folder)
    partial.rename(folder)


def _difference(record: StageRecord, options: dict[str, Any], inputs: Mapping[str, str]) -> str:
    changed = [
        f"{key} = {options.get(key)} (was {record.options.get(key)})"
        for key in sorted(options.keys() | record.options.keys())
        if options.get(key) != record.options.get(key)
    ]
    changed += [
        f"changed {key}"
        for key in sorted(inputs.keys() | record.inputs.keys())
        if inputs.get(key) != record.inputs.get(key)
    ]
    return ", ".join(changed) or "a new format"
