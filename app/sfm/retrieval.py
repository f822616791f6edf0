"""Images that look alike: candidates for closing loops where no positions are known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from app.capture.inventory import FrameEntry
from app.sfm.options import SfmOptions

_NUM_WORDS = 64
_WORDS_FROM = 40_000
"""Descriptors that the words are found from."""
_ITERATIONS = 10
_PER_IMAGE = 1000
"""Descriptors that describe an image."""
_BLOCK = 1000
"""Images compared with all others at once."""

Array = NDArray[np.float32]


def similar_pairs(database_path: Path, frames: Sequence[FrameEntry], options: SfmOptions) -> Iterator[tuple[str, str]]:
    """Pairs of images that look most alike among those the sequence doesn't pair.

    Args:
        database_path: with features.
        frames: in order of capture.
        options: number of pairs per image, window, seed.
    """
    if not options.num_similar_images:
        return
    names = [name for frame in frames for name in frame.images.values()]
    frame_of = np.array([index for index, frame in enumerate(frames) for _ in frame.images])
    described = describe_images(database_path, names, options.seed)
    for start in range(0, len(names), _BLOCK):
        similarity = described[start : start + _BLOCK] @ described.T
        near = np.abs(frame_of[start : start + _BLOCK, None] - frame_of) <= options.sequence_window
        similarity[near] = -1.0
        best = np.argsort(-similarity, axis=1, kind="stable")[:, : options.num_similar_images]
        for row, others in enumerate(best):
            for other in others:
                if similarity[row, other] > 0:
                    yield names[start + row], names[other]


def describe_images(database_path: Path, names: Sequence[str], seed: int) -> Array:
    """(N, D) one vector of unit length per image: VLAD of its SIFT descriptors (Jegou et al. 2010; Arandjelovic and
    Zisserman 2013 for the normalisation), zero for an image without features."""
    generator = np.random.default_rng(seed)
    with pycolmap.Database.open(database_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}

        def read(name: str) -> Array:
            data: Array = np.asarray(database.read_descriptors(ids[name]).data, np.float32)
            return data[np.sort(generator.permutation(len(data))[:_PER_IMAGE])] / np.float32(512)

        per_image = max(_WORDS_FROM // len(names), 20)
        sample = np.concatenate([data[:: max(len(data) // per_image, 1)] for data in map(read, names)])
        if len(sample) < _NUM_WORDS:
            return np.zeros((len(names), 1), np.float32)
        words = _words(sample, generator)
        described = np.zeros((len(names), words.size), np.float32)
        for row, name in enumerate(names):
            data = read(name)
            nearest = _nearest(data, words)
            for word in np.unique(nearest):
                difference = (data[nearest == word] - words[word]).sum(axis=0)
                length = max(float(np.linalg.norm(difference)), 1e-12)
                described[row, word * words.shape[1] : (word + 1) * words.shape[1]] = difference / length
    norms = np.linalg.norm(described, axis=1, keepdims=True)
    described /= np.maximum(norms, np.float32(1e-12))
    return described


def _words(sample: Array, generator: np.random.Generator) -> Array:
    """(K, 128) centres of clusters of descriptors, by Lloyd's algorithm."""
    words = sample[generator.choice(len(sample), _NUM_WORDS, replace=False)]
    for _ in range(_ITERATIONS):
        nearest = _nearest(sample, words)
        for word in range(_NUM_WORDS):
            members = sample[nearest == word]
            if len(members):
                words[word] = members.mean(axis=0)
    return words


def _nearest(data: Array, words: Array) -> NDArray[np.intp]:
    nearest: NDArray[np.intp] = np.argmin((words**2).sum(axis=1) - 2 * data @ words.T, axis=1)
    return nearest
