"""Errors that reach a user as one line; everything else is a bug and goes to the log with its traceback."""


class CityReconError(Exception):
    """Work failed. The message says what, where and what to do; the command ends with exit code 1."""

    exit_code = 1


class InputError(CityReconError):
    """The user's input can't be used. Nothing has been written; the command ends with exit code 2."""

    exit_code = 2
