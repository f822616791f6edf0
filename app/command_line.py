"""How a stage function becomes a command: flags from option dataclasses, the lock, the log, and errors as one line."""

from __future__ import annotations

import functools
import inspect
import logging
import os
import signal
import sys
import time
import types
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Concatenate, ParamSpec

import typer

from app.config import RunConfig, format_config, option_docs, option_types, parse_setting, read_config, update_config
from app.errors import CityReconError, InputError
from app.log import format_seconds, log_to_console, log_to_file
from app.run import Run
from app.stage import RECORD
from app.workspace import Workspace, atomic_file, remove_tree
from fusion.errors import CloudFormatError, FusionError
from mvs_backends.base import MvsError

logger = logging.getLogger(__name__)
P = ParamSpec("P")

WorkspaceArgument = Annotated[Path, typer.Argument(metavar="WORKSPACE", help="Folder that holds the run.")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="TOML file with options; `cityrecon config` prints one.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.OPTION=VALUE", help="Set any option of the configuration; repeatable."),
]
JobsOption = Annotated[int, typer.Option("--jobs", "-j", min=0, help="Clusters at a time. 0: one per core.")]
VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="Show details.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings and errors only.")]


def stage_command(
    app: typer.Typer, *sections: str
) -> Callable[[Callable[Concatenate[Run, P], None]], Callable[Concatenate[Run, P], None]]:
    """Register ``function(run, ...)`` as a command with a flag for every option of some sections of the configuration.

    The options in force are those of ``--config``, otherwise those that the workspace was last run with, and over them
    the flags; they are kept in the workspace's ``config.toml``. Only commands that are given images make workspaces.
    """

    def register(function: Callable[Concatenate[Run, P], None]) -> Callable[Concatenate[Run, P], None]:
        own = list(inspect.signature(function, eval_str=True).parameters.values())[1:]
        flags = [flag for section in sections for flag in _flags(section)]
        common = [
            _parameter("workspace", WorkspaceArgument, inspect.Parameter.empty),
            _parameter("config", ConfigOption, None),
            _parameter("settings", SetOption, None),
            _parameter("jobs", JobsOption, 0),
            _parameter("verbose", VerboseOption, False),
            _parameter("quiet", QuietOption, False),
        ]
        if any(parameter.name == "workspace" for parameter in own):
            common = common[1:]

        def command(**arguments: Any) -> None:
            path = arguments["workspace"]
            kept = {p.name: arguments.pop(p.name) for p in own}
            if path is None:
                path = default_workspace(kept["out"])
            workspace = Workspace(path.absolute())
            settings = _settings(arguments, sections)
            run_safely(
                functools.partial(_run_locked, function, workspace, kept, settings, arguments),
                verbosity=-1 if arguments["quiet"] else int(arguments["verbose"]),
            )

        parameters = [*(p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own), *common, *flags]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        app.command(function.__name__, help=inspect.getdoc(function))(command)
        return function

    return register


def default_workspace(out: Path) -> Path:
    """Beside the output: `town.ply` -> `town.workspace`."""
    return out.with_name(f"{out.stem}.workspace")


def run_safely(work: Callable[[], None], *, verbosity: int) -> None:
    """Do a command's work; errors become one line on stderr and an exit code."""
    log_to_console(verbosity)
    sys.excepthook = _report_bug
    # Loading pycolmap installs a handler that answers SIGTERM with a stack trace.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        work()
    except CityReconError as error:
        _fail(error, error.exit_code)
    except CloudFormatError as error:
        _fail(error, InputError.exit_code)
    except (FusionError, MvsError) as error:
        _fail(error, CityReconError.exit_code)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(CityReconError(f"{where}{error.strerror or error}"), CityReconError.exit_code)
    except MemoryError:
        _fail(CityReconError("out of memory; use fewer --jobs or a smaller densify.max_image_size_px"), 1)
    except KeyboardInterrupt:
        logger.warning("stopped; the same command continues")
        raise typer.Exit(130) from None


def print_lines(lines: Iterable[str]) -> None:
    """Print until there is no more, or until who reads it, such as `head`, has seen enough."""
    try:
        for line in lines:
            typer.echo(line)
        sys.stdout.flush()
    except BrokenPipeError:
        # What is left in the buffer would raise again at the end of the program.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(error: Exception, code: int) -> None:
    logger.error("%s", " ".join(str(error).split()))
    logger.debug("traceback", exc_info=error)
    raise typer.Exit(code) from None


def _report_bug(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    logger.error("unexpected %s: %s; please report it with the log file", kind.__name__, " ".join(str(error).split()))
    logger.debug("traceback", exc_info=(kind, error, trace))


def _run_locked(
    function: Callable[..., None],
    workspace: Workspace,
    kept: dict[str, Any],
    settings: dict[str, dict[str, Any]],
    arguments: dict[str, Any],
) -> None:
    is_new = not workspace.root.exists()
    kept_file = workspace.config_file if workspace.config_file.exists() else None
    config = load_config(arguments["config"] or kept_file, arguments["settings"] or [])
    config = update_config(config, settings, where="options")
    if kept_file is None and "images" not in kept:
        raise InputError(
            f"{workspace.root} is no workspace; name the folder that `cityrecon full` or `cityrecon capture` made"
        )
    with workspace.lock():
        try:
            log_to_file(workspace.log_file)
            logger.debug("command: %s", " ".join(sys.argv))
            with atomic_file(workspace.config_file) as path:
                path.write_text(format_config(config), encoding="utf-8")
            start = time.monotonic()
            function(Run(workspace=workspace, config=config, num_jobs=arguments["jobs"]), **kept)
            logger.debug("done in %s", format_seconds(time.monotonic() - start))
        except InputError:
            if is_new and not any(workspace.root.glob(f"*/{RECORD}")):
                remove_tree(workspace.root)
            raise
        if is_new and kept.get("dry_run"):
            remove_tree(workspace.root)


def load_config(file: Path | None, settings: list[str]) -> RunConfig:
    """The options of a TOML file, or the defaults, changed by `section.option=value` settings."""
    config = read_config(file) if file is not None else RunConfig()
    for setting in settings:
        config = update_config(config, parse_setting(setting), where="--set")
    return config


def _settings(arguments: dict[str, Any], sections: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Move the flags that were given out of the arguments, by section."""
    given: dict[str, dict[str, Any]] = {}
    for section in sections:
        for option in fields(_options_class(section)):
            value = arguments.pop(f"{section}__{option.name}")
            if value is not None and value != []:
                given.setdefault(section, {})[option.name] = value
    return given


def _options_class(section: str) -> type:
    return type(getattr(RunConfig(), section))


def _flags(section: str) -> list[inspect.Parameter]:
    options = _options_class(section)
    defaults, docs = options(), option_docs(options)
    flags = []
    for name, kind in option_types(options).items():
        flag = name.replace("_", "-")
        default = getattr(defaults, name)
        text = docs[name]
        if default is not None and default != "":
            text += f" Default: {' '.join(map(str, default)) if isinstance(default, tuple) else default}."
        spelling = f"--{flag}/--no-{flag}" if kind is bool else f"--{flag}"
        flag_type = _flag_type(kind)
        annotation = Annotated[flag_type, typer.Option(spelling, help=text, show_default=False)]  # type: ignore[valid-type]
        flags.append(_parameter(f"{section}__{name}", annotation, None))
    return flags


def _flag_type(kind: Any) -> Any:
    """The type that Typer is to parse for an option's field."""
    if getattr(kind, "__origin__", None) is tuple and kind.__args__[-1] is Ellipsis:
        kind = types.GenericAlias(list, kind.__args__[:1])
    return kind | None


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
