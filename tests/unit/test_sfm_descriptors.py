"""Matches of descriptors, against the rule written out feature by feature, and against COLMAP's brute force."""

from __future__ import annotations

import math

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from app.sfm import descriptors
from app.sfm.descriptors import match_descriptors


def random_descriptors(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    vectors = rng.gamma(0.4, size=(count, 128))
    return np.rint(512 * np.sqrt(vectors / vectors.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)


def disturbed(rng: np.random.Generator, made: NDArray[np.uint8]) -> NDArray[np.uint8]:
    noisy = np.abs(made + rng.normal(0.0, 12.0, made.shape))
    return np.rint(512 * noisy / np.linalg.norm(noisy, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)


def clear_nearest(query: NDArray[np.uint8], others: NDArray[np.uint8]) -> int | None:
    angles = [math.acos(min(float(query.astype(int) @ other.astype(int)) / 512**2, 1.0)) for other in others]
    first, second = sorted(range(len(angles)), key=lambda row: (angles[row], row))[:2]
    return first if angles[first] <= 0.7 and angles[first] < 0.8 * angles[second] else None


@pytest.mark.parametrize("block", [3, 1024])
def test_each_others_clearly_nearest(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descriptors, "_BLOCK", block)
    rng = np.random.default_rng(4)
    first = random_descriptors(rng, 40)
    second = np.concatenate([disturbed(rng, first[10:30]), random_descriptors(rng, 15)])[rng.permutation(35)]
    second[0] = second[1]
    forward = [clear_nearest(row, second) for row in first]
    expected = [
        (row, partner)
        for row, partner in enumerate(forward)
        if partner is not None and clear_nearest(second[partner], first) == row
    ]
    assert 10 < len(expected) < 21
    matches = match_descriptors(first, second)
    assert matches.tolist() == [list(pair) for pair in expected]
    assert match_descriptors(second, first)[:, ::-1].tolist() == sorted(matches.tolist(), key=lambda pair: pair[1])


def test_it_finds_what_colmaps_brute_force_finds() -> None:
    rng = np.random.default_rng(5)
    first = random_descriptors(rng, 300)
    second = disturbed(rng, first)[rng.permutation(300)]
    options = pycolmap.FeatureMatchingOptions(use_gpu=False)
    options.sift.cpu_brute_force_matcher = True
    matcher = pycolmap.FeatureMatcher.create(options, pycolmap.Device.cpu)
    sift = [pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, data) for data in (first, second)]
    nothing = pycolmap.FeatureKeypoints()
    expected = matcher.match(nothing, sift[0], nothing, sift[1])
    assert len(expected) > 200
    np.testing.assert_array_equal(match_descriptors(first, second), expected)


def test_too_few_to_compare() -> None:
    rng = np.random.default_rng(6)
    some = random_descriptors(rng, 5)
    for few in (some[:0], some[:1]):
        assert match_descriptors(few, some).shape == match_descriptors(some, few).shape == (0, 2)
