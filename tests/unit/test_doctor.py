"""What `cityrecon doctor` says of packages."""

from __future__ import annotations

import pytest

from app import doctor


def test_a_package_that_stands_in_for_another_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """pycolmap-cuda12 brings the module pycolmap; the package pycolmap is then not installed."""
    monkeypatch.setattr(doctor, "packages_distributions", lambda: {"pycolmap": ["pycolmap-cuda12"]})
    monkeypatch.setattr(doctor, "version", lambda name: {"pycolmap-cuda12": "4.2.1"}.get(name, "1.0"))
    lines = [line.split() for line in doctor.diagnose().splitlines()]
    assert ["pycolmap-cuda12", "4.2.1", "works"] in lines
    assert ["numpy", "1.0", "works"] in lines, "a package that no table lists goes by its own name"
