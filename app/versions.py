"""Versions of what each stage makes.

Whoever changes a stage so that the same inputs and options give another product raises its number: finished work of
the older program is then redone, and what depends on it if its product differs. Other releases keep it.
"""

from __future__ import annotations

_VERSIONS = {
    "capture": 1,
    "sfm": 1,
    "georegister": 2,
    "cluster": 1,
    "select": 4,
    "jobs": 1,
    "densify": 6,
    "fuse": 1,
}


def program_version(stage: str) -> dict[str, str]:
    """The version as one of the inputs of `run_stage`."""
    return {"program version": str(_VERSIONS[stage])}
