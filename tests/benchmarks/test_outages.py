"""Outages: what is measured when processes are killed, with a real daemon."""

from __future__ import annotations

from benchmarks.latency import steady
from benchmarks.outages import killed
from tests.flat import readings


def test_kills_cost_time_and_nothing_else() -> None:
    result = killed(steady(readings(400), rate_hz=20.0), child=2, gateway=1)
    assert result["restarts"] == 2
    assert (result["lost_scans"], result["damaged_files"], result["missing_keyframes"]) == (0, 0, 0)
    assert [len(outages["whole_s"]) for outages in result["outages"].values()] == [1, 1, 1]
    assert all(0.0 < outages["whole_s"][0] < 60.0 for outages in result["outages"].values())
