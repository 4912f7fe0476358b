"""Each layout of tables in the study of third-party logs, with signals of one drive at two rates."""

from contextlib import closing

import numpy as np
import pytest

from pdhef_logtool.logs import reader_process
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.signals import is_dated
from studies.strangers.cars import Topic
from studies.strangers.tables import WRITERS

STAMPS = 1_764_000_000_000_000_000 + 10_000_000 * np.arange(200)
TIME_S = (STAMPS - STAMPS[0]) * 1e-9
FAST = {
    "Lat Acc [m/s^2]": np.round(3.0 * np.sin(2.0 * TIME_S) + 0.01, 4),
    "Steering angle [deg]": np.round(20.0 * np.cos(TIME_S), 4),
    "Yaw rate [deg/s]": np.round(9.0 * np.cos(3.0 * TIME_S), 4),
}
SLOW = {"Speed [km/h]": np.round(70.0 + 5.0 * np.sin(9.0 * TIME_S[::5]), 4)}
#: Layouts with titles, rates or whole seconds of their own recorder.
OTHERS = (
    "default csv-plain csv-tabs csv-dashboard csv-two-clocks csv-separate-millis csv-rated csv-messages csv-settings "
    "csv-stamps csv-dots csv-hash json-split txt-sentences txt-nmea txt-estimator"
)
#: Layouts of signals at the same times.
ONE_CLOCK = "txt-kinds txt-aligned txt-positions vbo mat-pairs mat-quantities mat-names json-channels hdf5-frame"


@pytest.mark.parametrize("layout", [name for name in WRITERS if name not in OTHERS.split()])
def test_every_layout_gives_the_signals_that_were_written(layout, tmp_path, monkeypatch):
    monkeypatch.setattr(reader_process, "can_fork", lambda: False)
    suffix, put = WRITERS[layout]
    path = tmp_path / f"a{suffix}"
    topics = [Topic("/run/imu", "", STAMPS, STAMPS, FAST), Topic("/run/gnss", "", STAMPS[::5], STAMPS[::5], SLOW)]
    topics = topics[:1] if layout in ONE_CLOCK.split() else topics
    put(path, topics)
    with closing(open_log(path)) as log:
        read = log.read({topic.name: [f.path for f in log.fields(topic.name)] for topic in log.topics})
        lost = [loss for loss in log.lost if loss.severity == "lost"]
    columns = [
        (values[np.isfinite(values)], table.log_time_ns[np.isfinite(values)])
        for table in read.values()
        for values in table.fields.values()
    ]
    for expected in (values for topic in topics for values in topic.fields.values()):
        stamps = next(t for v, t in columns if v.shape == expected.shape and np.abs(v - expected).max() < 6e-3)
        assert np.ptp(stamps) == pytest.approx(np.ptp(STAMPS), abs=6e7)
        assert not is_dated(stamps[0]) or abs(stamps[0] - STAMPS[0]) < 10**9
    assert sum(loss.count or 1 for loss in lost) <= 1  # lines below the rows
