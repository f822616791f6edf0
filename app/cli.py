"""The program `cityrecon`."""


def main() -> None:
    """Entry point."""
    # The processes that a command starts load this file again, and have no use for the commands.
    from app.commands import app

    app()
