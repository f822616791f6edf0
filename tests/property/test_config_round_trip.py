"""Whatever options are in force, the file that a run leaves gives the same ones again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from app.config import RunConfig, format_config, read_config
from app.options import DensifyOptions
from app.sfm.options import SfmOptions, Strategy
from fusion.compare import CompareOptions
from mvs_backends.base import MvsOptions, Preset

LENGTHS = st.floats(1e-9, 1e9)


@st.composite
def configs(draw: st.DrawFn) -> RunConfig:
    corner = draw(st.none() | st.tuples(LENGTHS, LENGTHS, LENGTHS))
    bounds = None if corner is None else (*(-value for value in corner), *corner)
    return replace(
        RunConfig(),
        sfm=SfmOptions(
            camera_params=tuple(draw(st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=4))),
            strategies=tuple(draw(st.lists(st.sampled_from(Strategy), min_size=1, max_size=3, unique=True))),
            use_gpu=draw(st.booleans()),
        ),
        densify=DensifyOptions(backend=draw(st.text(st.characters(exclude_categories=("Cs",)), max_size=12))),
        stereo=MvsOptions(preset=draw(st.sampled_from(Preset)), seed=draw(st.integers(0, 2**40))),
        compare=CompareOptions(thresholds_m=tuple(draw(st.lists(LENGTHS, min_size=1, max_size=3))), bounds_m=bounds),
    )


@settings(max_examples=60, derandomize=True, deadline=None)
@given(configs())
def test_a_written_configuration_reads_back_the_same(config: RunConfig) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "config.toml"
        path.write_text(format_config(config), encoding="utf-8")
        assert read_config(path) == config
