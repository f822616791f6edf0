"""GPUs and memory for back-ends."""

from __future__ import annotations

import pytest

from mvs_backends import hardware
from mvs_backends.base import MvsError, MvsOptions
from mvs_backends.hardware import chosen_gpus, deal_gpus, gpu_environment, memory_budget_gib


def test_chosen_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware, "installed_gpus", lambda: ("a", "b", "c"))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert chosen_gpus("-1") == ("0", "1", "2")
    assert chosen_gpus("2,0") == ("2", "0")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5, GPU-77")
    assert chosen_gpus("-1") == ("5", "GPU-77")
    assert chosen_gpus("1") == ("GPU-77",)
    with pytest.raises(MvsError, match="no GPU 2, only 2"):
        chosen_gpus("2")
    monkeypatch.setattr(hardware, "installed_gpus", tuple)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert chosen_gpus("-1") == (), "all, uncounted"
    assert chosen_gpus("1") == ("1",)


@pytest.mark.parametrize("index", ["", "a", "0,", "-2", "0;1"])
def test_a_bad_gpu_index(index: str) -> None:
    with pytest.raises(ValueError, match="gpu_index"):
        MvsOptions(gpu_index=index)


def test_dealt_gpus() -> None:
    """Every GPU goes to one job, and jobs get equally many but for one."""
    for count in range(1, 6):
        gpus = [str(number) for number in range(count)]
        for num_jobs in range(1, 8):
            dealt = deal_gpus(gpus, num_jobs)
            assert sorted(gpu for share in dealt for gpu in share) == gpus
            assert len(dealt) == min(count, num_jobs)
            assert max(map(len, dealt)) - min(map(len, dealt)) <= 1
    assert deal_gpus((), 3) == ((),), "one job at a time on GPUs that can't be counted"
    assert gpu_environment(()) == {}


def test_jobs_share_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)))
    whole, half = memory_budget_gib(8), memory_budget_gib(4)
    assert whole > 0
    assert half == pytest.approx(whole / 2, rel=0.2)


def test_finished_work_does_not_depend_on_the_machine() -> None:
    other = MvsOptions(openmvs_path="/there", gpu_index="1", cache_gib=3.0, program_timeout_s=9.0, colmap_path="c")
    assert other.for_record() == MvsOptions()
    assert MvsOptions(seed=3).for_record() == MvsOptions(seed=3)
