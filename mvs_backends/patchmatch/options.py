"""Options of the PatchMatch search and what the presets set."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mvs_backends.base import MvsOptions, Preset


@dataclass(frozen=True, kw_only=True)
class PatchMatchOptions:
    """How depth is searched. Pixels are those of the level being searched unless said otherwise."""

    num_source_views: int = 6
    """Source views per reference view."""
    max_cost_views: int = 4
    """The cost of a hypothesis is averaged over the best of the source views, at most so many. ACMM: all."""
    iterations: tuple[int, ...] = (6, 3, 1)
    """Photometric sweeps per level, coarse to fine; each level halves the pixel size."""
    geometric_iterations: int = 1
    """Sweeps after those, at the finest level, whose cost has the forward-backward reprojection error against the maps
    of the source views (ACMM's geometric consistency). 0: none."""
    finest_level: int = 0
    """Halvings of the image at which the search ends; its maps are upsampled."""
    planar_prior: bool = True
    """Fit planes to the credible pixels of evenly coloured regions, and give them to the others there."""
    num_random: int = 8
    """Random hypotheses per pixel at the start, beside the one interpolated from sparse points. ACMM: 1."""
    geometric_weight: float = 0.2
    """Weight lambda of the reprojection error. ACMM: 0.2."""
    max_geometric_error_px: float = 3.0
    """Truncation delta of the reprojection error. ACMM: 3."""
    sigma_space_px: float = 5.0
    """Bilateral weight: spread over distance. ACMM: 5."""
    sigma_grey: float = 20.0
    """Bilateral weight: spread over grey values of 0 to 255. ACMM: 3 for COLMAP-like weights."""
    max_cost: float = 0.8
    """Pixels of a larger final cost, reprojection error included, get no depth."""
    max_prior_cost: float = 0.15
    """Pixels of at most this cost, whose depth two source views confirm, support the planar prior. ACMP: 0.1."""
    smoothing_radius_px: int = 2
    """At the end, each plane is averaged with those that agree within so many pixels. 0: no."""
    min_speckle_px: int = 40
    """Smaller connected pieces of a depth map are removed."""
    average_views: bool = True
    """At the end, each pixel's inverse depth is averaged with those of the other views' maps that agree."""

    def __post_init__(self) -> None:
        for field in ("num_source_views", "max_cost_views", "num_random"):
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be at least 1, not {getattr(self, field)}")
        for field in (
            "geometric_iterations",
            "geometric_weight",
            "max_prior_cost",
            "smoothing_radius_px",
            "min_speckle_px",
        ):
            if getattr(self, field) < 0:
                raise ValueError(f"{field} must be at least 0, not {getattr(self, field)}")
        for field in ("max_geometric_error_px", "sigma_space_px", "sigma_grey", "max_cost"):
            if not getattr(self, field) > 0:
                raise ValueError(f"{field} must be positive, not {getattr(self, field)}")
        if not self.iterations or min(self.iterations) < 1:
            raise ValueError(f"iterations must be one or more numbers of at least 1, not {self.iterations}")


PRESETS = {
    Preset.PREVIEW: PatchMatchOptions(num_source_views=4, max_cost_views=3, iterations=(5, 2), finest_level=1),
    Preset.NORMAL: PatchMatchOptions(),
    Preset.HIGH: PatchMatchOptions(iterations=(8, 5, 2), geometric_iterations=2),
}


def options_of_preset(options: MvsOptions) -> PatchMatchOptions:
    """The search that the general options ask for."""
    preset = PRESETS[options.preset]
    if options.num_source_views == 0:
        return preset
    return replace(preset, num_source_views=options.num_source_views)
