"""How well a drive round a corner says what it knows of its scale, by GPS whose errors drift:

        | 20 m
________|
  40 m
"""

from __future__ import annotations

import numpy as np
import pytest

from app.georegister.alignment import fit_planar

_FRAMES, _SIGMA_M, _DRIVES = 77, 0.4, 30


@pytest.mark.parametrize(("autocorrelation", "least", "most"), [(0.0, 0.5, 1.3), (0.97, 0.5, 2.0)])
def test_the_error_of_the_scale_is_as_said(autocorrelation: float, least: float, most: float) -> None:
    way_m = np.linspace(0, 60, _FRAMES)
    track = np.column_stack((np.minimum(way_m, 40), np.maximum(way_m - 40, 0)))
    heading = np.interp(way_m, [38, 42], [0, np.pi / 2])
    right = np.column_stack((np.sin(heading), -np.cos(heading)))
    ratios = []
    for seed in range(_DRIVES):
        steps = np.random.default_rng(seed).normal(0, _SIGMA_M, (_FRAMES, 2))
        steps[1:] *= np.sqrt(1 - autocorrelation**2)
        errors = np.zeros((_FRAMES, 2))
        for frame, step in enumerate(steps):
            errors[frame] = autocorrelation * errors[frame - 1] + step
        fit = fit_planar(track, track + errors, seed=0, right=right)
        assert fit is not None
        ratios.append((fit.scale - 1) / fit.scale_relative_sigma)
    assert least < np.sqrt(np.mean(np.square(ratios))) < most
