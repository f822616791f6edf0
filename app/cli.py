"""The program `cityrecon`. The processes that a command starts load this file, too, but not the commands."""

import gc
import logging
import os
import sys

# Libraries make a million objects that stay. Looking them through for garbage again and again is a fifth of the start.
gc.set_threshold(100_000)


def main() -> None:
    """Entry point."""
    from app.commands import app

    try:
        app()
    except SystemExit as end:
        if not isinstance(end.code, int):
            raise
        # The work is done, and all is written. Taking down the libraries that were loaded would take 0.3 s.
        logging.shutdown()
        sys.stdout.flush()
        os._exit(end.code)
