"""Depth maps to clouds, and clouds to one cloud."""

import zlib  # noqa: F401 - before pycolmap, whose own zlib, loaded first, makes the process abort at PNG files
