"""Robust similarities from model positions to known positions, with their uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TRIALS = 1_000
_MAX_SCORED = 2_000
_INLIER_SIGMAS = 3.0
_KEPT_SIGMAS = 3.7
"""Where the noise is known: of 1,000 good positions one is left out."""
_MIN_SIGMA_M = 1e-3
_MIN_FREEDOM = 0.5
_LEVER_SIGMA_M = 2.0
"""How far antennas are from cameras, before GPS says."""
_MIN_LEVER_FRAMES = 10
_MIN_EVIDENCE = 15.0
"""Twice the log likelihood ratio that two more unknowns need: chance gives that once in 1,800 times."""
_MIN_RIGHT = 0.5
_RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2D vector of two unit normals."""
_MAXWELL_MEDIAN = 1.5382
"""The same in 3D."""


@dataclass(frozen=True, kw_only=True)
class PlanarFit:
    """target = scale * rotate(model, yaw) + offset + rotate(lever, heading) in the plane, as complex numbers x + iy."""

    scale: float
    yaw_rad: float
    offset_m: complex
    lever_m: complex
    """Where the antenna is, from the camera: metres right of it and (imaginary part) in front of it. 0 if not told."""
    inliers: NDArray[np.bool_]
    """(F,)"""
    residuals_m: NDArray[np.float64]
    """(F,) distances, also of outliers."""
    sigma_m: float
    """Standard deviation of one coordinate of the inliers' residuals."""
    scale_relative_sigma: float
    """With correlated errors accounted for."""


def fit_planar(
    model: NDArray[np.float64],
    target_m: NDArray[np.float64],
    *,
    seed: int,
    right: NDArray[np.float64] | None = None,
    scale: float | None = None,
) -> PlanarFit | None:
    """Align 2D positions: least median of squares over pairs, then least squares over the inliers.

    Needs no threshold for outliers: the noise level comes from the data, so it works for 0.3 m and for 5 m of noise
    with nearly half of the positions wrong.

    Args:
        model: (F, 2)
        target_m: (F, 2)
        seed: of the sampling.
        right: (F, 2) the cameras' x axes in the plane. With them the antenna's place beside the camera is estimated,
            and used if the data speak for one clearly: on a straight drive it is the same as an offset.
        scale: fixed scale; estimated if None.

    Returns:
        The fit, or None with fewer than 3 positions or where all lie in one place.
    """
    if len(model) < 3:
        return None
    source, target = model[:, 0] + 1j * model[:, 1], target_m[:, 0] + 1j * target_m[:, 1]
    start = _least_median(source, target, np.random.default_rng(seed), scale)
    if start is None:
        return None
    ones = np.ones((len(model), 1), dtype=np.complex128)
    plain = _refine(source, target, ones, start, scale)
    if right is None or not (np.linalg.norm(right, axis=1) > _MIN_RIGHT).all():
        return plain
    turns = (right[:, 0] + 1j * right[:, 1]) / np.linalg.norm(right, axis=1)
    levered = _refine(source, target, np.column_stack((ones, turns)), start, scale)
    return levered if _is_clearly_better(levered, plain) else plain


def _is_clearly_better(levered: PlanarFit, plain: PlanarFit) -> bool:
    """Likelihood ratio test over the positions that fit with the lever."""
    chosen = levered.inliers
    residual = float((levered.residuals_m[chosen] ** 2).sum()) + int(chosen.sum()) * _MIN_SIGMA_M**2
    ratio = float((plain.residuals_m[chosen] ** 2).sum()) / residual
    return (
        int(chosen.sum()) >= _MIN_LEVER_FRAMES and 2.0 * int(chosen.sum()) * math.log(max(ratio, 1.0)) > _MIN_EVIDENCE
    )


def _least_median(
    source: NDArray[np.complex128], target: NDArray[np.complex128], rng: np.random.Generator, scale: float | None
) -> tuple[complex, complex, float] | None:
    """Factor, offset and median residual of the pair whose similarity has the smallest median residual.

    The median of F residuals, of which two are 0, is the (F + 3) / 2-th smallest (Rousseeuw and Leroy 1987, 3.4).
    """
    pairs = rng.integers(0, len(source), (_TRIALS, 2))
    base = source[pairs[:, 1]] - source[pairs[:, 0]]
    usable = np.abs(base) > 1e-6 * float(np.abs(source - source.mean()).max())
    factors = (target[pairs[usable, 1]] - target[pairs[usable, 0]]) / base[usable]
    pairs = pairs[usable]
    if scale is not None:
        moved = np.abs(factors) > 0.0
        pairs, factors = pairs[moved], factors[moved] * (scale / np.abs(factors[moved]))
    if not len(factors):
        return None
    offsets = target[pairs[:, 0]] - factors * source[pairs[:, 0]]
    scored = _scored_rows(len(source), rng)
    residuals = np.abs(factors[:, None] * source[scored] + offsets[:, None] - target[scored])
    middle = (len(scored) + 3) // 2 - 1
    medians = np.partition(residuals, middle, axis=1)[:, middle]
    best = int(np.argmin(medians))
    return complex(factors[best]), complex(offsets[best]), float(medians[best])


def _refine(
    source: NDArray[np.complex128],
    target: NDArray[np.complex128],
    basis: NDArray[np.complex128],
    start: tuple[complex, complex, float],
    scale: float | None,
) -> PlanarFit:
    """Least squares for target = factor * source + basis @ coefficients over the inliers, again and again."""
    factor, offset, median = start
    coefficients = np.zeros(basis.shape[1], dtype=np.complex128)
    coefficients[0] = offset
    # Two of few positions fit exactly, which makes the median too small (Rousseeuw and Leroy 1987, 5.1.2).
    rayleigh = _RAYLEIGH_MEDIAN / (1.0 + 5.0 / (len(source) - 2))
    sigma = max(median / rayleigh, _MIN_SIGMA_M)
    inliers = np.ones(len(source), dtype=np.bool_)
    information, noise = 0.0, _MIN_SIGMA_M
    for iteration in range(20):
        sigmas = _INLIER_SIGMAS if iteration < 10 else _KEPT_SIGMAS
        chosen = np.abs(factor * source + basis @ coefficients - target) <= sigmas * sigma
        if chosen.sum() < 3:
            break
        inliers = chosen
        ridge = np.zeros(basis.shape[1])
        ridge[1:] = (sigma / _LEVER_SIGMA_M) ** 2
        factor, coefficients, information = _least_squares(source[chosen], target[chosen], basis[chosen], ridge, scale)
        errors = np.abs(factor * source + basis @ coefficients - target)
        freedom = max(2 * int(chosen.sum()) - 2 - 2 * basis.shape[1], 1)
        noise = max(math.sqrt(float((errors[chosen] ** 2).sum()) / freedom), _MIN_SIGMA_M)
        # The median withstands gross errors; once these are out, the inliers' spread is the better measure of the
        # noise, and takes back what was good.
        median_sigma = max(float(np.median(errors)) / rayleigh, _MIN_SIGMA_M)
        sigma = median_sigma if iteration < 10 else max(median_sigma, noise)
    residuals = factor * source + basis @ coefficients - target
    arm = abs(factor) * math.sqrt(information)
    turn = factor / abs(factor) if abs(factor) > 0.0 else 1.0
    inflation = correlation_inflation(residuals[inliers], 1 + basis.shape[1])
    return PlanarFit(
        scale=abs(factor),
        yaw_rad=float(np.angle(factor)),
        offset_m=complex(coefficients[0]),
        lever_m=complex(coefficients[1] / turn) if basis.shape[1] > 1 else 0j,
        inliers=inliers,
        residuals_m=np.abs(residuals),
        sigma_m=noise,
        scale_relative_sigma=noise * inflation / arm if arm > 0.0 else math.inf,
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
    noise = max(noise, _MIN_SIGMA_M) * correlation_inflation(errors[inliers], 7 / 3)
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
    return inliers, noise * correlation_inflation(residuals[inliers], design.shape[1])


def correlation_inflation(
    residuals: NDArray[np.float64] | NDArray[np.complex128], parameters_per_coordinate: float
) -> float:
    """How much larger the error of what was fitted is than with as many independent residuals.

    GPS errors drift slowly, so neighbours in time share much of theirs: of n residuals as many as
    n_eff = n (1 - rho) / (1 + rho) are independent, for the lag-1 autocorrelation rho, and what the fit has taken up of
    a drift is not among them. So with p parameters sqrt((n - p) / (n_eff - p)). The rho of few residuals is too small
    by about (1 + 4 rho) / n (Kendall 1954).

    Args:
        residuals: (F,) or (F, D), in order of time, mean near 0.
        parameters_per_coordinate: p, of those fitted.
    """
    values = residuals.reshape(len(residuals), -1)
    power = float((np.abs(values) ** 2).sum())
    if power == 0.0:
        return 1.0
    product = float(np.real(values[:-1] * np.conj(values[1:])).sum())
    rho = product / power
    rho = min(max(rho + (1.0 + 4.0 * rho) / len(values), 0.0), 1.0)
    independent = len(values) * (1.0 - rho) / (1.0 + rho)
    freedom = max(len(values) - parameters_per_coordinate, _MIN_FREEDOM)
    return math.sqrt(freedom / min(freedom, max(independent - parameters_per_coordinate, _MIN_FREEDOM)))


def _scored_rows(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """All rows, or a sample of them where scoring all would take long."""
    if count <= _MAX_SCORED:
        return np.arange(count)
    return np.sort(rng.choice(count, _MAX_SCORED, replace=False))


def _least_squares(
    source: NDArray[np.complex128],
    target: NDArray[np.complex128],
    basis: NDArray[np.complex128],
    ridge: NDArray[np.float64],
    scale: float | None,
) -> tuple[complex, NDArray[np.complex128], float]:
    """Factor (of absolute value ``scale`` if given), coefficients, and the information about the factor."""
    normal = np.linalg.inv(basis.conj().T @ basis + np.diag(ridge))
    projected = source - basis @ (normal @ (basis.conj().T @ source))
    product = complex((np.conj(projected) * target).sum())
    information = max(float(np.real((np.conj(projected) * source).sum())), 0.0)
    if scale is not None:
        factor = scale * product / abs(product) if abs(product) > 0.0 else complex(scale)
    else:
        factor = product / information if information > 0.0 else 1.0 + 0j
    return factor, normal @ (basis.conj().T @ (target - factor * source)), information


def _similarity(model: NDArray[np.float64], target_m: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(3, 4) least-squares similarity (Umeyama 1991), also for positions in a plane or on a line.

    COLMAP's own gives up on positions in a plane, which is what a drive over level ground makes.
    """
    source, target = model - model.mean(axis=0), target_m - target_m.mean(axis=0)
    power = float((source**2).sum())
    if power == 0.0:
        return None
    u, values, vt = np.linalg.svd(target.T @ source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((values * signs).sum()) / power
    if scale <= 0.0:
        return None
    return np.column_stack((scale * rotation, target_m.mean(axis=0) - scale * rotation @ model.mean(axis=0)))


def _errors(
    similarity: NDArray[np.float64], model: NDArray[np.float64], target_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    errors: NDArray[np.float64] = model @ similarity[:, :3].T + similarity[:, 3] - target_m
    return errors
