"""Options in TOML and back, and messages for what isn't allowed."""

from dataclasses import fields
from pathlib import Path

import pytest

from app.config import RunConfig, format_config, option_docs, option_types, parse_setting, read_config, update_config
from app.errors import InputError


def test_every_option_has_a_type_and_a_docstring() -> None:
    for section in fields(RunConfig):
        options = type(getattr(RunConfig(), section.name))
        assert set(option_types(options)) == set(option_docs(options)), section.name


def test_printed_configuration_reads_back_the_same(tmp_path: Path) -> None:
    config = update_config(
        RunConfig(),
        {
            "clustering": {"block_size_m": [30, 15.5], "overlap_m": 3},
            "selection": {"method": "paper", "n_vis": 3},
            "sfm": {"camera_params": [700.5, 320, 200, 0.01]},
            "georegister": {"scale": 2.5},
        },
        where="test",
    )
    (tmp_path / "run.toml").write_text(format_config(config), encoding="utf-8")
    assert read_config(tmp_path / "run.toml") == config
    assert config.clustering.block_size_m == (30.0, 15.5)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[selektion]\nn_vis = 3", "did you mean selection"),
        ("[selection]\nn_viz = 3", "unknown option selection.n_viz; did you mean n_vis"),
        ("[selection]\nn_vis = 'three'", "selection.n_vis must be of type int"),
        ("[selection]\nn_vis = true", "selection.n_vis must be of type int"),
        ("[selection]\nn_vis = 0", "n_vis must be at least 1"),
        ("[selection]\nmethod = 'best'", "selection.method must be one of paper, optimal"),
        ("[clustering]\nblock_size_m = [20]", "clustering.block_size_m must have 2 values"),
        ("[clustering]\nblock_size_m = 20", "clustering.block_size_m must be a list"),
        ("selection = 3", "must be a section"),
        ("[selection", "is not TOML"),
    ],
)
def test_what_is_not_allowed_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "run.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_config(file)
    assert complaint in str(error.value)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_config(tmp_path / "none.toml")


def test_settings_are_toml_values_or_bare_words() -> None:
    assert parse_setting("selection.n_vis=3") == {"selection": {"n_vis": 3}}
    assert parse_setting("selection.method=paper") == {"selection": {"method": "paper"}}
    assert parse_setting("clustering.block_size_m=[30, 30]") == {"clustering": {"block_size_m": [30, 30]}}
    for wrong in ("selection=3", "n_vis=3", "selection.n_vis"):
        with pytest.raises(InputError, match=r"section\.option=value"):
            parse_setting(wrong)
