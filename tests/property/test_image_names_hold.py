"""Invariants of the names of a scene's images, kept in one array."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from app.scene.posed_scene import ImageNames

name_lists = st.lists(st.text(st.sampled_from("ab/.0é\U0001f600"), min_size=1, max_size=6), max_size=8)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(name_lists, name_lists)
def test_names_come_back_and_each_is_found_in_its_row(kept: list[str], wanted: list[str]) -> None:
    kept = sorted(set(kept))
    names = ImageNames.of(kept)
    assert list(names) == kept
    assert names == kept
    rows = names.rows_of([*kept, *wanted])
    assert rows.tolist() == [kept.index(name) if name in kept else -1 for name in [*kept, *wanted]]
    assert list(names.take(rows[: len(kept)])) == kept
