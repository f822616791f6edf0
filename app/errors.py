"""Errors that reach a user as one line; everything else is a bug and goes to the log with its traceback."""


class CityReconError(Exception):
    """Work failed. The message says what, where and what to do; the command ends with exit code 1."""

    exit_code = 1


class DiskFullError(CityReconError):
    """There is no space left. The same command continues once there is."""

    def __init__(self, folder: object) -> None:
        super().__init__(f"no space left on the disk of {folder}; free some and run the same command again")


class InputError(CityReconError):
    """The user's input can't be used. Nothing has been written; the command ends with exit code 2."""

    exit_code = 2
