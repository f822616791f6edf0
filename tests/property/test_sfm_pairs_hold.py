"""Whatever the frames, the list of pairs to match is complete along the sequence, free of duplicates, and bounded."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from app.capture.inventory import CameraEntry, FrameEntry, ImageEntry, Inventory
from app.sfm.options import SfmOptions
from app.sfm.pairs import image_pairs


def make_inventory(presence: list[list[bool]], positions: list[tuple[float, float, float] | None]) -> Inventory:
    cameras = [f"cam{index}" for index in range(len(presence[0]))]
    frames = tuple(
        FrameEntry(
            name=f"{number:04d}",
            images={camera: f"{camera}/{number:04d}.jpg" for camera, there in zip(cameras, row, strict=True) if there},
            position_m=position,
        )
        for number, (row, position) in enumerate(zip(presence, positions, strict=True))
    )
    names = sorted(name for frame in frames for name in frame.images.values())
    return Inventory(
        image_root=Path("images"),
        cameras=tuple(CameraEntry(name=camera, width=4, height=4, num_images=1) for camera in cameras),
        frames=frames,
        images=tuple(ImageEntry(name=name, size_bytes=1, digest="") for name in names),
        is_rig=True,
    )


@st.composite
def inventories(draw: st.DrawFn) -> Inventory:
    num_cameras, num_frames = draw(st.integers(1, 4)), draw(st.integers(2, 40))
    row = st.lists(st.booleans(), min_size=num_cameras, max_size=num_cameras).filter(any)
    coordinate = st.floats(-100, 100)
    position = st.none() | st.tuples(coordinate, coordinate, coordinate)
    return make_inventory(
        draw(st.lists(row, min_size=num_frames, max_size=num_frames)),
        draw(st.lists(position, min_size=num_frames, max_size=num_frames)),
    )


@settings(max_examples=60, deadline=None, derandomize=True)
@given(inventories(), st.integers(1, 6), st.sampled_from([1, 20, 1000]))
def test_pairs(inventory: Inventory, window: int, exhaustive: int) -> None:
    options = SfmOptions(sequence_window=window, max_exhaustive_images=exhaustive)
    pairs = image_pairs(inventory, options)
    names = {image.name for image in inventory.images}
    assert pairs == sorted(set(pairs))
    assert all(first < second and {first, second} <= names for first, second in pairs)
    if len(names) <= exhaustive:
        assert len(pairs) == len(names) * (len(names) - 1) // 2
        return
    found = set(pairs)
    for index, frame in enumerate(inventory.frames):
        assert found.issuperset(combinations(sorted(frame.images.values()), 2))
        for other in inventory.frames[index + 1 : index + 1 + window]:
            for camera in frame.images.keys() & other.images.keys():
                assert (frame.images[camera], other.images[camera]) in found
        for other in inventory.frames[index + 1 : index + 2]:
            for first in frame.images.values():
                assert all(tuple(sorted((first, second))) in found for second in other.images.values())
    per_frame = window + options.sequence_quadratic_window + options.num_position_neighbors + 1
    assert len(pairs) <= len(inventory.frames) * per_frame * len(inventory.cameras) ** 2


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.floats(0.0, 15.0))
def test_a_place_visited_again_is_matched(num_cameras: int, offset_m: float) -> None:
    """Out along a straight road, and back beside it::

    0 ---> ... ---> 29
    59 <-- ... <--- 30      offset_m away
    """
    there = [(2.0 * index, 0.0, 0.0) for index in range(30)]
    back = [(2.0 * index, offset_m, 0.0) for index in reversed(range(30))]
    inventory = make_inventory([[True] * num_cameras] * 60, [*there, *back])
    pairs = set(image_pairs(inventory, SfmOptions(max_exhaustive_images=1)))
    for index in range(20):
        assert (f"cam0/{index:04d}.jpg", f"cam{num_cameras - 1}/{59 - index:04d}.jpg") in {
            tuple(sorted(pair)) for pair in pairs
        }


def test_a_straight_road_is_matched_along_the_sequence_only() -> None:
    positions = [(1.5 * index, 0.0, 0.0) for index in range(50)]
    with_gps = make_inventory([[True]] * 50, [*positions])
    without = make_inventory([[True]] * 50, [None] * 50)
    options = SfmOptions(max_exhaustive_images=1)
    assert image_pairs(with_gps, options) == image_pairs(without, options)
