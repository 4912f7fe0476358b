import json
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from rerun.chunk import McapReader
from source_log import write_source
from written import as_written

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.mcap_sink import AnnotatedMcap, thinned_step_ns
from pdhef_logtool.results.sink import Event
from studies import mcap_logs
from tests.logs.recorded import decoded_by_rosbags, summary_of

STATE = "pdhef_msgs/msg/VehicleStateEstimate"
ODOMETRY = "nav_msgs/msg/Odometry"

#: Every topic of the annotated log: type, encoding, messages. 600 stamps, 12 of them not valid.
SOURCE_TOPICS = {
    "/imu": ("sensor_msgs/msg/Imu", "cdr", 600),
    "/can/speed": ("can.Speed", "json", 120),
    "/blob": (None, "octets", 6),
}
#: Topics of each track.
TRACK_TOPICS = {
    "state": (STATE, "cdr", 600),
    "odometry": (ODOMETRY, "cdr", 588),
    "plot": ("pdhef_msgs/msg/PlottedEstimate", "cdr", 120),
    "path": ("nav_msgs/msg/Path", "cdr", 1),
}
NAMES = {"phy_ukf": "phy-ukf", "zero": "zero", "truth": "truth"}
OUR_TOPICS = {f"/pdhef/{token}/{what}": topic for token in NAMES for what, topic in TRACK_TOPICS.items()}
TOPICS = SOURCE_TOPICS | OUR_TOPICS

ALGORITHM = {"algorithm": "vehicle-ukf", "sha256": "ab" * 32, "options": {"limit_gain": 1.0}}
RMSE = {"signal": "sideslip_rad", "metric": "rmse", "unit": "rad"}
REPORT = {
    "format": "pdhef.report",
    "log": {"name": "drive", "end_ns": 1_700_000_006_000_000_123},
    "truth": {"available": True},
    "estimators": [{"name": "phy-ukf", "algorithm": ALGORITHM}, {"name": "zero", "algorithm": None}],
    "metrics": [
        {**RMSE, "estimator": "phy-ukf", "segment": "all", "value": 0.0125, "n": 588},
        {**RMSE, "estimator": "zero", "segment": "nonlinear", "value": None, "n": 0},
    ],
}
METRICS = {
    "log": "drive",
    "truth": "available",
    "phy-ukf/algorithm": json.dumps(ALGORITHM, sort_keys=True),
    "phy-ukf/sideslip_rad/all/rmse": "0.0125 rad n=588",
    "zero/sideslip_rad/nonlinear/rmse": "null rad n=0",
}


def annotate(path: Path, source: Path | None, tracks, report=REPORT, events=(), **facts) -> None:
    """Annotate a log, None: write a sidecar, with tracks."""
    with ExitStack() as opened:
        log = None if source is None else opened.enter_context(closing(open_log(source)))
        with AnnotatedMcap(path, log, **facts) as annotated:
            annotated.write(tracks)
            annotated.finish(report, tracks, events)


@pytest.fixture
def tracks(circle):
    return [circle(name, 0, 600) for name in NAMES.values()]


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "drive.mcap"
    write_source(path)
    return path


@pytest.fixture
def annotated(tmp_path, source, tracks):
    path = tmp_path / "annotated.mcap"
    annotate(path, source, tracks)
    return path


def messages(path: Path, topic: str | None = None):
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [
            (c.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, c, m in reader.iter_messages(topics=None if topic is None else [topic])
        ]


def decoded(path: Path, topic: str) -> list:
    return decoded_by_rosbags([path], [topic])[topic]


def test_every_topic_is_there_with_all_messages_in_indexed_chunks(annotated):
    summary = summary_of(annotated)
    types = {0: None} | {number: schema.name for number, schema in summary.schemas.items()}
    n_of = summary.statistics.channel_message_counts
    counts = {c.topic: (types[c.schema_id], c.message_encoding, n_of[c.id]) for c in summary.channels.values()}
    assert counts == TOPICS and len(summary.channels) == len(TOPICS)
    assert Counter(topic for topic, *_ in messages(annotated)) == {topic: n for topic, (_, _, n) in TOPICS.items()}
    assert summary.statistics.message_start_time == 1_700_000_000_000_000_123
    assert summary.statistics.message_end_time == 1_700_000_005_992_000_123
    assert set().union(*(c.message_index_offsets for c in summary.chunk_indexes)) == set(summary.channels)
    assert [a.name for a in summary.attachment_indexes] == ["calibration.txt", "report.json", "report.json"]
    assert [m.name for m in summary.metadata_indexes] == ["recorder", "pdhef.metrics"]


def test_source_is_kept_bit_for_bit(annotated, source):
    for topic in SOURCE_TOPICS:
        assert messages(annotated, topic) == messages(source, topic)
        assert len(messages(source, topic)) == SOURCE_TOPICS[topic][2]

    def channels(path):
        summary = summary_of(path)
        schemas = {id_: (s.name, s.encoding, s.data) for id_, s in summary.schemas.items()}
        return {
            c.topic: (c.message_encoding, c.metadata, schemas.get(c.schema_id))
            for c in summary.channels.values()
            if c.topic in SOURCE_TOPICS
        }

    assert channels(annotated) == channels(source)
    with source.open("rb") as a, annotated.open("rb") as b:
        before, after = make_reader(a), make_reader(b)
        assert before.get_header().profile == after.get_header().profile == "ros2"
        kept = list(after.iter_attachments())
        assert kept[:-1] == list(before.iter_attachments())
        assert list(after.iter_metadata())[:-1] == list(before.iter_metadata())


def test_messages_are_merged_by_log_time(annotated):
    times = [t for _, t, *_ in messages(annotated)]
    assert times == sorted(times)
    starts = [c.message_start_time for c in summary_of(annotated).chunk_indexes]
    with annotated.open("rb") as stream:
        sequential = [m.log_time for _, _, m in NonSeekingReader(stream).iter_messages(log_time_order=False)]
    assert starts[:-1] == sorted(starts[:-1])  # the maps, which are known at the end, are of the start
    assert sorted(sequential) == times


def test_metrics_record_and_report_attachment(annotated):
    with annotated.open("rb") as stream:
        reader = make_reader(stream)
        (metrics,) = [m.metadata for m in reader.iter_metadata() if m.name == "pdhef.metrics"]
        report = list(reader.iter_attachments())[-1]
    assert metrics == METRICS
    assert (report.name, report.media_type) == ("report.json", "application/json")
    assert report.log_time == 1_700_000_006_000_000_123
    assert json.loads(report.data) == REPORT


@pytest.fixture
def ros_only(tmp_path, source, tracks):
    drive, path = tmp_path / "ros.mcap", tmp_path / "ros_annotated.mcap"
    # rosbags opens no file with other encodings.
    mcap_logs.write_log(drive, (m for m in mcap_logs.messages(source) if m.encoding == "cdr"), "ros2")
    annotate(path, drive, tracks)
    return path


@pytest.mark.parametrize("token", ["phy_ukf", "truth"])
def test_rosbags_reads_every_state(ros_only, circle, token):
    track = circle(NAMES[token], 0, 600)
    rows = decoded(ros_only, f"/pdhef/{token}/state")
    assert [t for t, _ in rows] == track.stamps_ns.tolist()
    assert [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in rows] == track.stamps_ns.tolist()
    assert {m.header.frame_id for _, m in rows} == {"base_link"}
    fields = "vx_m_s vy_m_s yaw_rate_rad_s sideslip_rad ay_m_s2 sideslip_std_rad network_trust r_scale nis friction"
    for field in (*fields.split(), "valid", "diverged"):
        np.testing.assert_array_equal(
            [getattr(m, field) for _, m in rows], as_written(getattr(track, field), field), err_msg=field
        )
    assert np.isnan([m.mixture_weight for _, m in rows]).all() and not any(m.reason for _, m in rows)
    covariance = np.array([m.covariance for _, m in rows])
    if token == "truth":
        assert np.isnan(covariance).all()
    else:
        np.testing.assert_array_equal(covariance, as_written(track.covariance.reshape(600, 9)))


@pytest.mark.slow
@pytest.mark.parametrize("token", ["phy_ukf", "truth"])
def test_rosbags_reads_every_odometry(ros_only, circle, token):
    track = circle(NAMES[token], 0, 600)
    use = track.valid
    rows = decoded(ros_only, f"/pdhef/{token}/odometry")
    assert [t for t, _ in rows] == track.stamps_ns[use].tolist()
    assert {(m.header.frame_id, m.child_frame_id) for _, m in rows} == {("map", "base_link")}
    poses = [m.pose.pose for _, m in rows]
    np.testing.assert_array_equal([p.position.x for p in poses], as_written(track.x_m[use], "x_m"))
    np.testing.assert_array_equal([p.position.y for p in poses], as_written(track.y_m[use], "y_m"))
    yaw = [2 * np.arctan2(p.orientation.z, p.orientation.w) for p in poses]
    np.testing.assert_allclose(yaw, track.yaw_rad[use], atol=6e-6)
    twists = [m.twist.twist for _, m in rows]
    np.testing.assert_array_equal([t.linear.x for t in twists], as_written(track.vx_m_s[use], "vx_m_s"))
    np.testing.assert_array_equal([t.linear.y for t in twists], as_written(track.vy_m_s[use], "vy_m_s"))
    yaw_rate = as_written(track.yaw_rate_rad_s[use], "yaw_rate_rad_s")
    np.testing.assert_array_equal([t.angular.z for t in twists], yaw_rate)
    covariance = rows[0][1].twist.covariance
    expected = np.zeros(36)
    if token != "truth":
        # x, y and the rotation about z of a row-major 6 x 6 matrix
        expected[[0, 1, 6, 7, 11, 31, 35]] = [0.04, 0.001, 0.001, 0.09, 0.002, 0.002, 0.0004]
    np.testing.assert_array_equal(covariance, as_written(expected))


def test_annotating_twice_is_annotating_once(tmp_path, annotated, tracks):
    again = tmp_path / "again.mcap"
    annotate(again, annotated, tracks)
    assert messages(again) == messages(annotated)
    with again.open("rb") as a, annotated.open("rb") as b:
        first, second = make_reader(a), make_reader(b)
        assert list(first.iter_attachments()) == list(second.iter_attachments())
        assert list(first.iter_metadata()) == list(second.iter_metadata())
        assert len(first.get_summary().channels) == len(TOPICS)


def test_sidecar_holds_our_topics_alone(tmp_path, tracks):
    path = tmp_path / "sidecar.mcap"
    annotate(path, None, tracks)
    assert {topic for topic, *_ in messages(path)} == set(OUR_TOPICS)
    assert len(decoded(path, "/pdhef/phy_ukf/odometry")) == 588
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert [a.name for a in reader.iter_attachments()] == ["report.json"]
        assert [m.name for m in reader.iter_metadata()] == ["pdhef.metrics"]
    rows = {c.entity_path for c in McapReader(path).stream() if c.num_rows and not c.is_static}
    assert set(OUR_TOPICS) <= rows


def test_two_estimators_never_share_a_topic_and_a_failure_leaves_no_file(tmp_path, circle):
    with pytest.raises(OutputError, match="different topics"):
        annotate(tmp_path / "a.mcap", None, [circle("pd-hef"), circle("pd_hef")])
    with pytest.raises(KeyError):
        annotate(tmp_path / "a.mcap", None, [circle("zero")], {})
    assert list(tmp_path.iterdir()) == []


def test_of_a_long_drive_what_nobody_asked_for_stands_five_times_a_second(tmp_path, circle):
    path = tmp_path / "annotated.mcap"
    tracks = [circle(name, 0, 600, adaptive=True) for name in ("phy-ukf", "zero")]
    annotate(path, None, tracks, shown={"phy-ukf"}, others_step_ns=200_000_000)
    found = {topic: [t for t, *_ in decoded(path, topic)] for topic in OUR_TOPICS}
    assert len(found["/pdhef/phy_ukf/state"]) == 600
    assert len(found["/pdhef/phy_ukf/odometry"]) == pytest.approx(60, abs=2)
    stated = np.array(found["/pdhef/zero/state"])
    assert len(stated) == pytest.approx(30, abs=1)
    assert set(np.diff(stated // 200_000_000)) == {1}
    rows = dict(decoded(tmp_path / "annotated.mcap", "/pdhef/zero/state"))
    whole = circle("zero", 0, 600, adaptive=True)
    at = np.searchsorted(whole.stamps_ns, stated)
    assert found["/pdhef/zero/odometry"] == stated[whole.valid[at]].tolist()
    for field in ("sideslip_rad", "nis", "mixture_weight", "reason", "valid"):
        expected = as_written(getattr(whole, field)[at], field)
        np.testing.assert_array_equal([getattr(rows[t], field) for t in stated], expected, err_msg=field)


def test_plots_are_in_degrees_with_limits_and_errors(tmp_path, circle):
    path = tmp_path / "annotated.mcap"
    estimate, truth = circle("phy-ukf", 0, 600, bias=0.02), circle("truth", 0, 600)
    annotate(path, None, [estimate, truth])
    rows = decoded(path, "/pdhef/phy_ukf/plot")
    assert len(rows) == 120 and np.all(np.diff([t for t, _ in rows]) == 50_000_000)
    for stamp_ns, row in rows:
        at = int(np.searchsorted(estimate.stamps_ns, stamp_ns))
        slip = np.degrees(estimate.sideslip_rad[at]) if estimate.valid[at] else np.nan
        np.testing.assert_allclose(row.sideslip_deg, slip, rtol=2e-4)
        np.testing.assert_allclose(
            row.sideslip_high_deg - row.sideslip_low_deg, np.degrees(0.03) * 3.92 + 0 * slip, rtol=2e-3
        )
        error = np.degrees(estimate.sideslip_rad[at] - truth.sideslip_rad[at])
        np.testing.assert_allclose(row.sideslip_error_deg, error if estimate.valid[at] else np.nan, rtol=1e-3)
        np.testing.assert_allclose(row.yaw_rate_error_deg_s, np.degrees(0.02) + 0 * slip, rtol=1e-3)
    assert all(np.isnan(row.sideslip_error_deg) for _, row in decoded(path, "/pdhef/truth/plot"))
    (_, way), *_ = decoded(path, "/pdhef/phy_ukf/path")
    seconds = np.arange(0, 600, 100)
    known = seconds[estimate.valid[seconds]]
    assert [p.pose.position.x for p in way.poses] == pytest.approx(
        estimate.x_m[known][: len(way.poses)].tolist(), abs=0.5
    )
    assert way.header.frame_id == way.poses[0].header.frame_id == "map"


def test_the_log_has_a_line_for_faults_checks_losses_and_events(tmp_path, circle):
    path = tmp_path / "annotated.mcap"
    track = circle("pd-hef", 0, 600, adaptive=True)
    start_ns = int(track.stamps_ns[0])
    check = {"name": "ay.units", "verdict": "failed", "waived": False, "evidence": "°/s"}
    loss = {"kind": "gap", "what": "no samples", "where": "/imu", "start_ns": start_ns + 10**9, "severity": "lost"}
    report = {
        **REPORT,
        "log": {**REPORT["log"], "start_ns": start_ns},
        "checks": [check, {**check, "waived": True}, {**check, "verdict": "passed"}],
        "losses": [loss],
    }
    events = [
        Event("slalom", start_ns + 2 * 10**9, start_ns + 4 * 10**9, "left"),
        Event("pd-hef diverged", start_ns + 3 * 10**9, start_ns + 4 * 10**9, ""),
        Event("straight", start_ns + 4 * 10**9, start_ns + 5 * 10**9, ""),
    ]
    annotate(path, None, [track], report, events)
    lines = [(t - start_ns, m.level, m.name, m.msg) for t, m in decoded(path, "/pdhef/log")]
    assert [x for x in lines if x[2] == "pdhef"] == [
        (0, 40, "pdhef", "check ay.units failed: °/s"),
        (0, 30, "pdhef", "check ay.units failed (waived): °/s"),
        (10**9, 30, "pdhef", "gap: no samples (/imu)"),
        (2 * 10**9, 20, "pdhef", "slalom, 2.00 s: left"),
        (3 * 10**9, 40, "pdhef", "pd-hef diverged, 1.00 s"),
        (4 * 10**9, 10, "pdhef", "straight, 1.00 s"),
    ]
    faults = [x for x in lines if x[2] == "pd-hef"]
    assert faults and all(level == 30 and text.startswith("pd-hef: ") for _, level, _, text in faults)


@pytest.mark.parametrize(("source_bytes", "expected_s"), [(10**9, 0.05), (5_000_000, 0.5), (10_000, 5.0)])
def test_other_tracks_are_thinned_to_the_size_of_the_source(source_bytes, expected_s):
    step_ns = thinned_step_ns(source_bytes, rows=30_000, others=6, span_ns=300 * 10**9)
    assert step_ns == pytest.approx(expected_s * 1e9)
    assert thinned_step_ns(10**12, rows=360_000, others=6, span_ns=3600 * 10**9) == 200_000_000
