"""Which drives there are: the five sequences of [O]'s table 1, and towns of many such drives."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A town made of districts, each with a drive of its own through it."""

    num_keyframes: int
    """Per district; each has one image of every camera."""
    num_points: int
    """Per district."""
    num_streets: int
    """Streets in each of the two directions of a district's grid."""
    street_spacing_m: float
    """Mean distance of neighbouring streets."""
    house_share: float
    """Of the blocks between streets; the others are open ground behind a fence."""
    keyframe_spacing_m: float
    seed: int
    num_districts: int = 1


def _town(num_districts: int) -> Preset:
    """Districts like seq5, 12,502 images each."""
    return Preset(
        num_keyframes=1786,
        num_points=411_000,
        num_streets=6,
        street_spacing_m=75.0,
        house_share=0.85,
        keyframe_spacing_m=2.05,
        seed=6,
        num_districts=num_districts,
    )


PRESETS = {
    "small": Preset(
        num_keyframes=60,
        num_points=4_000,
        num_streets=3,
        street_spacing_m=75.0,
        house_share=0.85,
        keyframe_spacing_m=2.0,
        seed=0,
    ),
    "seq1": Preset(
        num_keyframes=733,
        num_points=389_621,
        num_streets=6,
        street_spacing_m=45.0,
        house_share=0.85,
        keyframe_spacing_m=2.85,
        seed=1,
    ),
    "seq2": Preset(
        num_keyframes=969,
        num_points=321_696,
        num_streets=4,
        street_spacing_m=85.0,
        house_share=0.85,
        keyframe_spacing_m=1.6,
        seed=2,
    ),
    "seq3": Preset(
        num_keyframes=1211,
        num_points=349_616,
        num_streets=4,
        street_spacing_m=105.0,
        house_share=0.4,
        keyframe_spacing_m=1.25,
        seed=23,
    ),
    "seq4": Preset(
        num_keyframes=1416,
        num_points=372_434,
        num_streets=5,
        street_spacing_m=75.0,
        house_share=0.7,
        keyframe_spacing_m=2.0,
        seed=4,
    ),
    "seq5": Preset(
        num_keyframes=1708,
        num_points=393_246,
        num_streets=6,
        street_spacing_m=75.0,
        house_share=0.85,
        keyframe_spacing_m=2.05,
        seed=5,
    ),
    "12k": _town(1),
    "100k": _town(8),
    "1m": _town(80),
}
