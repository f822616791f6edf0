"""All options of a run: one section per stage, in TOML and as dataclasses."""

from __future__ import annotations

import ast
import difflib
import inspect
import json
import textwrap
import tomllib
import types
import typing
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from app.capture.options import CaptureOptions
from app.clustering.options import ClusteringOptions
from app.errors import InputError
from app.georegister.options import GeoregisterOptions
from app.options import DensifyOptions
from app.sfm.options import SfmOptions
from app.view_selection.options import SelectionOptions
from fusion.compare import CompareOptions
from fusion.depth_fusion import FusionOptions
from mvs_backends.base import MvsOptions


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Options of every stage. Each field is a section of the TOML file."""

    capture: CaptureOptions = field(default_factory=CaptureOptions)
    sfm: SfmOptions = field(default_factory=SfmOptions)
    georegister: GeoregisterOptions = field(default_factory=GeoregisterOptions)
    clustering: ClusteringOptions = field(default_factory=ClusteringOptions)
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    densify: DensifyOptions = field(default_factory=DensifyOptions)
    stereo: MvsOptions = field(default_factory=MvsOptions)
    fusion: FusionOptions = field(default_factory=FusionOptions)
    compare: CompareOptions = field(default_factory=CompareOptions)


def read_config(path: Path) -> RunConfig:
    """Read a TOML file; what it doesn't name keeps its default.

    Raises:
        InputError: unreadable, not TOML, an unknown section or option, or a value that isn't allowed.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    return update_config(RunConfig(), data, where=str(path))


def update_config(config: RunConfig, data: dict[str, Any], *, where: str) -> RunConfig:
    """Replace options by ``{section: {option: value}}``.

    Raises:
        InputError: an unknown section or option, or a value that isn't allowed; the message begins with ``where``.
    """
    for section, values in data.items():
        if section not in {f.name for f in fields(config)}:
            raise InputError(f"{where}: unknown section [{section}]{_hint(section, [f.name for f in fields(config)])}")
        if not isinstance(values, dict):
            raise InputError(f"{where}: {section} must be a section [{section}] with options in it")
        options = getattr(config, section)
        hints = option_types(type(options))
        for name in values:
            if name not in hints:
                raise InputError(f"{where}: unknown option {section}.{name}{_hint(name, list(hints))}")
        try:
            options = replace(options, **{n: _convert(v, hints[n], f"{section}.{n}") for n, v in values.items()})
        except ValueError as error:
            raise InputError(f"{where}: {error}") from error
        config = replace(config, **{section: options})
    return config


def parse_setting(text: str) -> dict[str, Any]:
    """Read one `section.option=value`, the value in TOML; a bare word is a string.

    Raises:
        InputError: not of that form.
    """
    key, equals, value = text.partition("=")
    section, dot, name = key.strip().partition(".")
    if not (equals and dot):
        raise InputError(f"--set {text}: must be section.option=value, for example --set selection.n_vis=3")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    return {section: {name: parsed}}


def format_config(config: RunConfig) -> str:
    """All options as TOML, each with what it means as a comment."""
    lines = []
    for section in fields(config):
        options = getattr(config, section.name)
        lines.append(f"[{section.name}]")
        documentation = option_docs(type(options))
        for option in fields(options):
            lines += [f"# {line}" for line in textwrap.wrap(documentation[option.name], 110)]
            value = getattr(options, option.name)
            lines.append(f"# {option.name} is not set" if value is None else f"{option.name} = {_toml(value)}")
        lines.append("")
    return "\n".join(lines)


def option_types(options: type) -> dict[str, Any]:
    """Type of each field of an options class."""
    hints = typing.get_type_hints(options)
    return {f.name: hints[f.name] for f in fields(options)}


def option_docs(options: type) -> dict[str, str]:
    """Docstring of each field of an options class, on one line."""
    body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(options))).body[0]).body
    docs = {}
    for statement, following in zip(body, body[1:], strict=False):
        if (
            isinstance(statement, ast.AnnAssign)
            and isinstance(statement.target, ast.Name)
            and isinstance(following, ast.Expr)
            and isinstance(following.value, ast.Constant)
        ):
            docs[statement.target.id] = " ".join(str(following.value.value).split())
    return docs


def _hint(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"


def _convert(value: Any, wanted: Any, name: str) -> Any:
    """A TOML value as the type of an option's field."""
    origin = typing.get_origin(wanted)
    if origin in (types.UnionType, typing.Union):
        return _convert(value, next(t for t in typing.get_args(wanted) if t is not types.NoneType), name)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name} must be a list, not {value!r}")
        arguments = typing.get_args(wanted)
        if arguments[-1] is Ellipsis:
            return tuple(_convert(item, arguments[0], name) for item in value)
        if len(value) != len(arguments):
            raise ValueError(f"{name} must have {len(arguments)} values, not {len(value)}")
        return tuple(_convert(item, argument, name) for item, argument in zip(value, arguments, strict=True))
    if isinstance(wanted, type) and issubclass(wanted, StrEnum):
        if value not in list(wanted):
            raise ValueError(f"{name} must be one of {', '.join(wanted)}, not {value!r}")
        return wanted(value)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, wanted) or (wanted is not bool and isinstance(value, bool)):
        raise ValueError(f"{name} must be of type {wanted.__name__}, not {value!r}")
    return value


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return repr(value)
