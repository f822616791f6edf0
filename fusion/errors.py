"""Errors of this package. Each message is one line that says what is wrong, where, and what to do."""


class FusionError(Exception):
    """Fusing, comparing or drawing clouds failed."""


class CloudFormatError(FusionError):
    """A file isn't a point cloud that can be used."""
