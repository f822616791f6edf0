"""`python -m mvs_backends.colmap_command patch_match_stereo ARGUMENTS`: COLMAP's command, by the installed pycolmap.

In a process of its own, because COLMAP aborts the whole process when a worker thread finds no GPU.
"""

from __future__ import annotations

import sys

import pycolmap

_SECTION = "PatchMatchStereo."


def main() -> None:
    """Parse COLMAP's arguments and run it."""
    command, *arguments = sys.argv[1:]
    if command != "patch_match_stereo":
        raise SystemExit(f"unknown command {command}")
    given = {name.removeprefix("--"): value for name, value in zip(arguments[::2], arguments[1::2], strict=True)}
    options = pycolmap.PatchMatchOptions()
    for name in [name for name in given if name.startswith(_SECTION)]:
        field = name.removeprefix(_SECTION)
        kind = type(getattr(options, field))
        value = given.pop(name)
        setattr(options, field, bool(int(value)) if kind is bool else kind(value))
    pycolmap.patch_match_stereo(given["workspace_path"], options=options, config_path=given["config_path"])


if __name__ == "__main__":
    main()
