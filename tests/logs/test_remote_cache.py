"""A cache of slim logs before logs on a server: what was read once is only asked for what it is."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.slim_cache import SlimCache
from pdhef_logtool.logs import remote_source
from pdhef_logtool.logs.discovery import find_logs
from tests.counting_server import serving


def _read(url: str, cache: SlimCache) -> tuple[object, ...]:
    (log,) = find_logs([url])
    with cache.standing_in(log, pytest.fail) as found, read_drive(found, Car.load(None)) as drive:
        windows = [(w.signals.yaw_rate_rad_s.tobytes(), w.truth.vy_m_s.tobytes()) for w in drive.windows()]
        return windows, drive.signals_sha256, drive.truth_sha256, drive.sha256, drive.losses, drive.file


@pytest.mark.slow
def test_a_second_reading_asks_only_for_identity(
    tmp_path: Path, sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_source, "KEPT_COPIES", 0)  # as for another process
    file = sample_logs_dir / "faults.mcap"
    cache = SlimCache(str(tmp_path / "cache"), None, ReadOptions())
    with serving(**{file.name: file.read_bytes()}) as server:
        first = _read(server.place(file.name), cache)
        assert server.bytes_sent <= 1.02 * file.stat().st_size
        assert server.twice() <= 2  # of asking whether it is the same object
        server.requests.clear()
        assert _read(server.place(file.name), cache) == first
        assert len(server.requests) == 1
        assert server.bytes_sent < 100_000
        server.files[file.name] = (sample_logs_dir / "dlc.mcap").read_bytes()
        assert _read(server.place(file.name), cache) != first
