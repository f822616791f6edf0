"""The program: from images to one cloud."""

import os
import zlib  # noqa: F401 - before pycolmap, see mvs_backends/__init__.py

# Set before NumPy is imported, here and in the processes started from here: work is spread by clusters and image pairs,
# and sums that a library splits among threads differ in their last digits with the number of threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
