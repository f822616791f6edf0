"""What only ACMP and its kin do; the rest is in `test_backend_contract.py`."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvs_backends import get_backend
from mvs_backends.acm import share_done
from mvs_backends.base import MvsError, MvsOptions
from tests.reference.plane_scene import plane_job


def test_images_too_large(tmp_path: Path) -> None:
    program = tmp_path / "ACMP"
    program.write_text("#!/bin/false\n", encoding="utf-8")
    program.chmod(0o755)
    job = plane_job(tmp_path / "large", normal=(0.0, 0.0, 1.0), size=(3202, 4), num_views=2)
    with pytest.raises(MvsError, match="--max-image-size-px 3200"):
        get_backend("acmp").estimate(job=job, options=MvsOptions(acmp_path=str(tmp_path)), num_threads=1)


@pytest.mark.parametrize(
    ("program", "size_px", "num_passes"),
    [("ACMH", 3000, 2), ("ACMP", 3000, 3), ("ACMM", 1000, 3), ("ACMM", 1001, 6), ("ACMMP", 3000, 9)],
)
def test_progress_grows_to_one(program: str, size_px: int, num_passes: int) -> None:
    num_views = 4
    shares = [share_done(program, size_px, done, num_views) for done in range(num_passes * num_views + 1)]
    assert shares[0] == 0.0 and shares[-1] == 1.0
    assert all(a < b for a, b in zip(shares, shares[1:], strict=False))
    if num_passes == 6:
        assert shares[12] == pytest.approx(0.2), "the scale with a quarter of the pixels costs a quarter of the other"
