"""The program `cityrecon`."""

import logging
import os
import sys


def main() -> None:
    """Entry point."""
    # The processes that a command starts load this file again, and have no use for the commands.
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
