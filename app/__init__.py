"""The program: from images to one cloud."""

import os
import zlib  # noqa: F401

# Set before NumPy is imported, here and in the processes started from here: work is spread by clusters and image pairs,
# and sums that a library splits among threads differ in their last digits with the number of threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# zlib is imported for pycolmap's sake, which holds a zlib of its own: loaded first, parts of it would take the place of
# the system's, which Python, and OpenCV for PNG files, use, and the process would abort.
