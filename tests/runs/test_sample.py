"""A large log is inspected by its index and a sample of its chunks; the result equals a full read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pdhef_logtool.logs.byte_source import LocalFile
from pdhef_logtool.logs.mcap_index import read_index
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.runs.inspection import fields_of_log, inspect_log, render_inspection
from pdhef_logtool.runs.inspection.report import Inspection
from tests.command_line import rendered
from tests.counting_server import serving

S = 1_000_000_000
#: Chunks of road.mcap (41, of 7.3 s): one that no window holds, and one in the first minute.
UNSEEN, SEEN = 15, 3


@pytest.fixture
def _small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a log of 300 s a large one: of it the first minute is checked, and four times 3 s are looked at."""
    monkeypatch.setattr("pdhef_logtool.runs.inspection.report.WHOLE_BYTES", 1 << 20)
    monkeypatch.setattr("pdhef_logtool.runs.inspection.report.WINDOW_NS", 60 * S)
    monkeypatch.setattr("pdhef_logtool.mapping.clocks.SURVEY_WHOLE_NS", 60 * S)
    monkeypatch.setattr("pdhef_logtool.mapping.clocks.SURVEY_WINDOWS", 4)
    monkeypatch.setattr("pdhef_logtool.mapping.clocks.SURVEY_WINDOW_NS", 3 * S)
    monkeypatch.setattr("pdhef_logtool.mapping.evidence.PIECES", 3)


def _by_times(found: Inspection) -> list[dict[str, object]]:
    """Return the entries of topics, without the delays."""
    return [{k: v for k, v in t.items() if not k.startswith("delay")} for t in found.to_dict()["topics"]]


@pytest.mark.slow
@pytest.mark.usefixtures("_small_windows")
def test_a_sample_tells_what_the_whole_tells(sample_logs_dir: Path) -> None:
    some, whole = (inspect_log(sample_logs_dir / "road.mcap", whole=w) for w in (False, True))
    assert whole.sample is None
    assert some.sample is not None
    assert (some.sample.of_chunks, some.sample.times) == (41, "index")
    assert 10 <= some.sample.chunks <= 25
    assert _by_times(some) == _by_times(whole)
    assert some.mapping == whole.mapping
    assert some.checks == whole.checks
    assert some.proposals == whole.proposals
    assert (some.start_ns, some.end_ns, some.notes, some.missing) == (
        whole.start_ns, whole.end_ns, whole.notes, whole.missing
    )  # fmt: skip
    for name, report in some.signals.items():
        assert whole.signals[name].minimum <= report.minimum <= report.maximum <= whole.signals[name].maximum
        assert report.rate_hz == pytest.approx(whole.signals[name].rate_hz)
        assert report.gaps == 0, "what lies between two windows is no gap"
    assert some.to_dict()["sample"] == {"chunks": some.sample.chunks, "of_chunks": 41, "times": "index"}
    assert "--all reads" in " ".join(rendered(render_inspection, some).split())
    assert "--all" not in rendered(render_inspection, whole)


def test_a_small_log_is_read_whole(sample_logs_dir: Path) -> None:
    assert inspect_log(sample_logs_dir / "dlc.mcap").sample is None


def _flip_in_chunk(number: int) -> Callable[[Path], None]:
    def spoil(file: Path) -> None:
        source = LocalFile(file)
        index = read_index(source)
        source.close()
        assert index is not None
        data = bytearray(file.read_bytes())
        extent, _ = index.chunks[number]
        data[(extent.start + extent.end) // 2] ^= 1
        file.write_bytes(data)

    return spoil


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-2000])


@pytest.mark.slow
@pytest.mark.usefixtures("_small_windows")
@pytest.mark.parametrize(
    ("spoil", "seen"), [(_flip_in_chunk(SEEN), True), (_flip_in_chunk(UNSEEN), False), (_cut, True)]
)
def test_damage_that_is_met_has_all_of_it_read(
    tmp_path: Path, sample_logs_dir: Path, spoil: Callable[[Path], None], seen: bool
) -> None:
    file = tmp_path / "damaged.mcap"
    file.write_bytes((sample_logs_dir / "road.mcap").read_bytes())
    spoil(file)
    found, whole = inspect_log(file), inspect_log(file, whole=True)
    assert whole.is_partial
    assert found.is_partial is seen
    assert (found.sample is None) is seen
    if seen:
        assert found.to_dict() == whole.to_dict()


@pytest.mark.slow
@pytest.mark.usefixtures("_small_windows")
def test_of_a_far_log_only_the_sample_is_fetched(sample_logs_dir: Path) -> None:
    pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")
    data = (sample_logs_dir / "road.mcap").read_bytes()
    with serving(**{"road.mcap": data, "again.mcap": data, "fields.mcap": data}) as server:
        far = inspect_log(RemotePlace(server.place("road.mcap")))
        assert far.sample is not None
        assert (far.sample.times, far.sample.of_chunks) == ("sample", 41)
        assert 0.3 < server.bytes_sent / len(data) < 0.65
        assert len(server.requests) <= 12
        assert server.twice() == 0
        near = inspect_log(sample_logs_dir / "road.mcap")
        assert far.mapping == near.mapping
        assert far.checks == near.checks
        assert [t.messages for t in far.topics] == [t.messages for t in near.topics]
        assert [t.rate_hz for t in far.topics] == pytest.approx([t.rate_hz for t in near.topics], rel=1e-3)
        assert far.to_dict()["signals"] == near.to_dict()["signals"]
        server.requests.clear()
        assert inspect_log(RemotePlace(server.place("again.mcap")), whole=True).sample is None
        assert server.bytes_sent == len(data) + 1, "the first byte is the check of the version"
        server.requests.clear()
        fields_of_log(RemotePlace(server.place("fields.mcap")), "/imu/data")
        assert server.bytes_sent < 0.6 * len(data)
