"""Robust similarities from model positions to known positions, with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

_TRIALS = 1_000
_MAX_SCORED = 2_000
_INLIER_SIGMAS = 3.0
_MIN_SIGMA_M = 1e-3
_MAX_AUTOCORRELATION = 0.9
_RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2D vector of two unit normals."""
_MAXWELL_MEDIAN = 1.5382
"""The same in 3D."""


@dataclass(frozen=True, kw_only=True)
class PlanarFit:
    """target = scale * rotate(model, yaw) + offset in the plane, as complex numbers x + iy."""

    scale: float
    yaw_rad: float
    offset_m: complex
    inliers: NDArray[np.bool_]
    """(F,)"""
    residuals_m: NDArray[np.float64]
    """(F,) distances, also of outliers."""
    sigma_m: float
    """Standard deviation of one coordinate of the inliers' residuals."""
    scale_relative_sigma: float
    """With correlated errors accounted for."""


def fit_planar(
    model: NDArray[np.float64], target_m: NDArray[np.float64], *, seed: int, scale: float | None = None
) -> PlanarFit | None:
    """Align 2D positions: least median of squares over pairs, then least squares over the inliers.

    Needs no threshold for outliers: the noise level comes from the data, so it works for 0.3 m and for 5 m of noise
    with nearly half of the positions wrong.

    Args:
        model: (F, 2)
        target_m: (F, 2)
        seed: of the sampling.
        scale: fixed scale; estimated if None.

    Returns:
        The fit, or None with fewer than 3 positions or where all lie in one place.
    """
    if len(model) < 3:
        return None
    source, target = model[:, 0] + 1j * model[:, 1], target_m[:, 0] + 1j * target_m[:, 1]
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, len(model), (_TRIALS, 2))
    base = source[pairs[:, 1]] - source[pairs[:, 0]]
    span = float(np.abs(source - source.mean()).max())
    usable = np.abs(base) > 1e-6 * span
    if span == 0.0 or not usable.any():
        return None
    pairs, base = pairs[usable], base[usable]
    factors = (target[pairs[:, 1]] - target[pairs[:, 0]]) / base
    if scale is not None:
        moved = np.abs(factors) > 0.0
        pairs, factors = pairs[moved], factors[moved] * (scale / np.abs(factors[moved]))
    if not len(factors):
        return None
    offsets = target[pairs[:, 0]] - factors * source[pairs[:, 0]]
    scored = _scored_rows(len(model), rng)
    medians = np.median(
        np.abs(factors[:, None] * source[None, scored] + offsets[:, None] - target[None, scored]), axis=1
    )
    best = int(np.argmin(medians))
    factor, offset = complex(factors[best]), complex(offsets[best])
    sigma = max(float(medians[best]) / _RAYLEIGH_MEDIAN, _MIN_SIGMA_M)
    inliers = np.ones(len(model), dtype=np.bool_)
    for _ in range(20):
        chosen = np.abs(factor * source + offset - target) <= _INLIER_SIGMAS * sigma
        if chosen.sum() < 3:
            break
        inliers = chosen
        factor, offset = _least_squares(source[inliers], target[inliers], scale)
        sigma = max(float(np.median(np.abs(factor * source + offset - target))) / _RAYLEIGH_MEDIAN, _MIN_SIGMA_M)
    errors = factor * source + offset - target
    centered = source[inliers] - source[inliers].mean()
    freedom = max(2 * int(inliers.sum()) - 4, 1)
    noise = max(float(np.sqrt((np.abs(errors[inliers]) ** 2).sum() / freedom)), _MIN_SIGMA_M)
    lever = abs(factor) * float(np.sqrt((np.abs(centered) ** 2).sum()))
    return PlanarFit(
        scale=abs(factor),
        yaw_rad=float(np.angle(factor)),
        offset_m=offset,
        inliers=inliers,
        residuals_m=np.abs(errors),
        sigma_m=noise,
        scale_relative_sigma=noise * correlation_inflation(errors[inliers]) / lever if lever > 0.0 else np.inf,
    )


@dataclass(frozen=True, kw_only=True)
class SpatialFit:
    """target_m = scale * rotation @ model + translation."""

    scale: float
    rotation: NDArray[np.float64]
    """(3, 3)"""
    translation_m: NDArray[np.float64]
    """(3,)"""
    inliers: NDArray[np.bool_]
    """(F,)"""
    residuals_m: NDArray[np.float64]
    """(F, 3)"""
    scale_relative_sigma: float
    tilt_sigma_deg: float
    """Of the rotation about its least certain axis: infinite for a straight line."""


def fit_spatial(model: NDArray[np.float64], target_m: NDArray[np.float64], *, seed: int) -> SpatialFit | None:
    """Align 3D positions: least median of squares over triples, then least squares over the inliers.

    Args:
        model: (F, 3)
        target_m: (F, 3)
        seed: of the sampling.

    Returns:
        The fit, or None with fewer than 4 positions, or where all lie in one place.
    """
    if len(model) < 4:
        return None
    rng = np.random.default_rng(seed)
    best: NDArray[np.float64] | None = None
    best_median = np.inf
    scored = _scored_rows(len(model), rng)
    # All positions first: without outliers nothing beats them, and on a straight line no triple determines a rotation.
    samples = [np.arange(len(model)), *rng.integers(0, len(model), (_TRIALS // 4, 3))]
    for sample in samples:
        candidate = _similarity(model[sample], target_m[sample])
        if candidate is None:
            continue
        median = float(np.median(np.linalg.norm(_errors(candidate, model[scored], target_m[scored]), axis=1)))
        if median < best_median:
            best, best_median = candidate, median
    if best is None:
        return None
    inliers = np.ones(len(model), dtype=np.bool_)
    for _ in range(20):
        lengths = np.linalg.norm(_errors(best, model, target_m), axis=1)
        sigma = max(float(np.median(lengths)) / _MAXWELL_MEDIAN, _MIN_SIGMA_M)
        inliers = lengths <= _INLIER_SIGMAS * 1.2 * sigma
        refined = _similarity(model[inliers], target_m[inliers]) if inliers.sum() >= 3 else None
        if refined is None or np.array_equal(refined, best):
            break
        best = refined
    errors = _errors(best, model, target_m)
    scale = float(np.cbrt(np.linalg.det(best[:, :3])))
    centered = scale * (model[inliers] - model[inliers].mean(axis=0))
    noise = float(np.sqrt((errors[inliers] ** 2).sum() / max(3 * int(inliers.sum()) - 7, 1)))
    noise = max(noise, _MIN_SIGMA_M) * correlation_inflation(errors[inliers])
    extents = np.linalg.svd(centered, compute_uv=False)
    return SpatialFit(
        scale=scale,
        rotation=best[:, :3] / scale,
        translation_m=best[:, 3],
        inliers=inliers,
        residuals_m=errors,
        scale_relative_sigma=noise / float(np.linalg.norm(extents)) if extents[0] > 0.0 else np.inf,
        tilt_sigma_deg=float(np.degrees(noise / extents[1])) if extents[1] > 0.0 else np.inf,
    )


def robust_line_sigma(columns: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.bool_], float]:
    """Inliers and noise of values that are linear in some columns, by iterated least squares with rejection.

    Args:
        columns: (F, K)
        values: (F,)

    Returns:
        (F,) inliers, and the standard deviation of their residuals with correlated errors accounted for.
    """
    design = np.column_stack((columns, np.ones(len(columns))))
    weights = np.ones(len(values))
    residuals = values - np.median(values)
    for _ in range(30):
        solution = np.linalg.lstsq(design * weights[:, None], values * weights, rcond=1e-9)[0]
        residuals = values - design @ solution
        sigma = max(1.4826 * float(np.median(np.abs(residuals))), 1e-6)
        # Square root of Cauchy's weights.
        weights = 1.0 / np.sqrt(1.0 + (residuals / (2.385 * sigma)) ** 2)
    inliers: NDArray[np.bool_] = np.abs(residuals) <= _INLIER_SIGMAS * sigma
    freedom = max(int(inliers.sum()) - design.shape[1], 1)
    noise = float(np.sqrt((residuals[inliers] ** 2).sum() / freedom))
    return inliers, noise * correlation_inflation(residuals[inliers])


def correlation_inflation(residuals: NDArray[np.float64] | NDArray[np.complex128]) -> float:
    """How much larger the error of a mean is than that of as many independent residuals.

    GPS errors drift slowly, so neighbours in time share much of theirs: sqrt((1 + rho) / (1 - rho)) for the lag-1
    autocorrelation rho.

    Args:
        residuals: (F,) or (F, D), in order of time, mean near 0.
    """
    values = residuals.reshape(len(residuals), -1)
    power = float((np.abs(values) ** 2).sum())
    if power == 0.0:
        return 1.0
    product = float(np.real(values[:-1] * np.conj(values[1:])).sum())
    rho = min(max(product / power, 0.0), _MAX_AUTOCORRELATION)
    return float(np.sqrt((1.0 + rho) / (1.0 - rho)))


def _scored_rows(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """All rows, or a sample of them where scoring all would take long."""
    if count <= _MAX_SCORED:
        return np.arange(count)
    return np.sort(rng.choice(count, _MAX_SCORED, replace=False))


def _least_squares(
    source: NDArray[np.complex128], target: NDArray[np.complex128], scale: float | None
) -> tuple[complex, complex]:
    centered = source - source.mean()
    factor = complex((np.conj(centered) * (target - target.mean())).sum())
    power = float((np.abs(centered) ** 2).sum())
    if scale is None:
        factor = factor / power if power > 0.0 else 1.0
    else:
        factor = scale * factor / abs(factor) if abs(factor) > 0.0 else complex(scale)
    return factor, complex(target.mean() - factor * source.mean())


def _similarity(model: NDArray[np.float64], target_m: NDArray[np.float64]) -> NDArray[np.float64] | None:
    found = pycolmap.estimate_sim3d(model, target_m)
    if found is None:
        return None
    matrix: NDArray[np.float64] = np.asarray(found.matrix(), dtype=np.float64)
    return matrix if np.isfinite(matrix).all() and np.linalg.det(matrix[:, :3]) > 0.0 else None


def _errors(
    similarity: NDArray[np.float64], model: NDArray[np.float64], target_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    errors: NDArray[np.float64] = model @ similarity[:, :3].T + similarity[:, 3] - target_m
    return errors
