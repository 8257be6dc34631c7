"""Twenty seconds of full load: nothing fails, and memory stays. Longer: ``python -m benchmarks.soak --seconds 600``."""

from __future__ import annotations

from pathlib import Path

from live_service import live_service, wait_until


def test_memory_stays_under_full_load(avatars, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))
    from benchmarks.soak import soak

    with live_service(avatars) as service:
        seen = soak(service.url, "shell", 20.0, clients=3)
        assert set(seen.statuses) <= {200, 422}  # 422: the nonsense
        assert min(seen.statuses[200], seen.statuses[422]) >= 20  # some load, also on a machine that does much else
        assert seen.broken == 0
        assert seen.growth() < 8e6
        wait_until(lambda: service.number("caphy_inference_in_flight") == 0)
        assert service.number("caphy_buffered_bytes") == 0
        assert service.stop() == 0
        assert [line for line in service.logged() if line["level"] == "error"] == []
