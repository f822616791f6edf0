"""What every stage of a run works on."""

from __future__ import annotations

from dataclasses import dataclass

from app.config import RunConfig
from app.workspace import Workspace


@dataclass(frozen=True, kw_only=True)
class Run:
    """A workspace, the options in force, and how much of the machine to use."""

    workspace: Workspace
    config: RunConfig
    num_jobs: int = 0
    """Processes at a time, 0: one per core. Has no influence on results."""
