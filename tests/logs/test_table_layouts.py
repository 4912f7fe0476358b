"""Each layout of tables in the study of third-party logs, with three signals of one drive."""

from contextlib import closing

import numpy as np
import pytest

from pdhef_logtool.logs import reader_process
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.signals import is_dated
from studies.strangers.cars import Topic
from studies.strangers.tables import WRITERS

N = 200
STAMPS = 1_764_000_000_000_000_000 + 10_000_000 * np.arange(N)
TIME_S = 0.01 * np.arange(N)
SIGNALS = {
    "Lat Acc [m/s^2]": np.round(3.0 * np.sin(2.0 * TIME_S) + 0.01, 4),
    "Steering angle [deg]": np.round(20.0 * np.cos(TIME_S), 4),
    "Speed [km/h]": np.round(70.0 + 5.0 * np.sin(9.0 * TIME_S), 4),
}
#: Layouts with titles, rates or whole seconds of their own recorder.
OTHERS = (
    "default csv-plain csv-tabs csv-dashboard csv-two-clocks csv-separate-millis csv-rated csv-messages csv-settings "
    "csv-stamps csv-dots json-split txt-sentences txt-nmea txt-estimator"
)


@pytest.mark.parametrize("layout", [name for name in WRITERS if name not in OTHERS.split()])
def test_every_layout_gives_the_signals_that_were_written(layout, tmp_path, monkeypatch):
    monkeypatch.setattr(reader_process, "can_fork", lambda: False)
    suffix, put = WRITERS[layout]
    path = tmp_path / f"a{suffix}"
    put(path, [Topic("/run/imu", "", STAMPS, STAMPS, SIGNALS)])
    with closing(open_log(path)) as log:
        read = log.read({topic.name: [f.path for f in log.fields(topic.name)] for topic in log.topics})
        lost = [loss for loss in log.lost if loss.severity == "lost"]
    columns = [(values, table.log_time_ns) for table in read.values() for values in table.fields.values()]
    for expected in SIGNALS.values():
        stamps = next(t for values, t in columns if len(values) == N and np.abs(values - expected).max() < 6e-3)
        assert np.ptp(stamps) == pytest.approx(np.ptp(STAMPS), abs=2e7)
        assert not is_dated(stamps[0]) or abs(stamps[0] - STAMPS[0]) < 10**9
    assert sum(loss.count or 1 for loss in lost) <= 1  # lines below the rows
