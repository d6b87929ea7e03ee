import gzip
import json
import math

import numpy as np
import pytest

from drivers.frames import LaserScan, OdometrySample
from service.cli import main
from service.errors import InputError, StorageError
from service.geometry.se2 import SE2
from service.offline.importing.carmen import import_carmen
from service.recording.mcap_source import open_session
from tests.soaked import in_soak

HEAD = "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"


def flaser(time_s, robot, laser=None, ranges=(2.0,) * 180):
    poses = (*(laser or robot), *robot)
    numbers = " ".join(str(value) for value in (len(ranges), *ranges, *poses))
    return f"FLASER {numbers} {time_s} merlin {time_s}\n"


def odom(time_s, x, y, theta, tv=0):
    return f"ODOM {x} {y} {theta} {tv} 0 0 {time_s} merlin {time_s}\n"


def robotlaser(time_s, robot, laser, ranges, kind="ROBOTLASER1", most=81.92, remissions=()):
    n, m = len(ranges), len(remissions)
    fields = (0, -1.0, 0.1 * (n - 1), 0.1, most, 0.01, 0, n, *ranges, m, *remissions, *laser, *robot)
    numbers = " ".join(map(str, (*fields, 0.3, 0.1, 0.4, 0.2, 0.0)))
    return f"{kind} {numbers} {time_s} merlin {time_s}\n"


@pytest.fixture
def imported(tmp_path):
    """Imports a log given as text and reads the session back: report, session, frames by kind."""

    def run(text, name="run.log", **options):
        log = tmp_path / name
        log.write_text(HEAD + text)
        report = import_carmen(log, tmp_path / "out.mcap", **options)
        session = open_session([report.path])
        frames = list(session.frames())
        scans = [frame for frame in frames if isinstance(frame, LaserScan)]
        samples = [frame for frame in frames if isinstance(frame, OdometrySample)]
        return report, session, scans, samples

    return run


def test_a_raw_log_becomes_scans_odometry_and_mounting(imported):
    report, session, scans, samples = imported(
        odom("10.000001", 0.0, 0.0, 0.0, tv=0.5)
        + flaser("10.1", (0.05, 0.0, 0.0), laser=(0.15, 0.0, 0.0))
        + odom("10.2", 0.1, 0.0, 0.0, tv=0.5)
        + flaser("10.3", (0.15, 0.0, 0.0), laser=(0.25, 0.0, 0.0))
    )
    assert session.sensors == {"/base/odom": "base", "/front/scan": "front"}
    assert session.mountings == {"front": SE2(0.1, 0.0, 0.0)}
    assert [scan.stamp_ns for scan in scans] == [10_100_000_000, 10_300_000_000]
    assert [sample.stamp_ns for sample in samples] == [10_000_001_000, 10_200_000_000]
    assert samples[1].twist_mps_radps == (0.5, 0.0, 0.0)
    assert (report.corrected, report.odometry_source) == ("", "2 ODOM lines")
    assert str(report).startswith(f"{report.path}: 2 scans of front, 2 odometry samples over 0.3 s")


def test_an_import_reports_as_json_what_it_counted(tmp_path, capsys):
    log = tmp_path / "run.log"
    log.write_text(HEAD + odom(10.0, 0, 0, 0) + flaser(10.1, (0, 0, 0)) + "FLASER broken\nTRUEPOS 0 0 0\n")
    assert main(["import", "carmen", str(log), str(tmp_path / "out.mcap"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["scans"] == {"front": 1}
    assert facts["malformed"] == {"FLASER": 1}
    assert facts["ignored"] == {"TRUEPOS": 1}
    assert facts["mountings"]["front"] == {"x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0}


@pytest.mark.parametrize(
    ("count", "first_deg", "last_deg"),
    [(180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (401, -50, 50), (91, -90, 90)],
)
def test_beams_of_flaser_point_where_carmen_has_them(imported, count, first_deg, last_deg):
    _, _, (scan,), _ = imported(flaser("1.0", (0, 0, 0), ranges=(1.0,) * count))
    assert math.degrees(scan.first_angle_rad) == pytest.approx(first_deg)
    assert math.degrees(scan.first_angle_rad + (count - 1) * scan.angle_step_rad) == pytest.approx(last_deg)


def test_robotlaser_says_its_own_angles_and_range(imported):
    text = robotlaser(
        "5.0", (1, 2, 0.5), (1, 2, 0.5), [4.0, 5.0, 81.91, 6.0], remissions=[7, 8]
    ) + robotlaser(
        "5.1", (1, 2, 0.5), (1, 2, 0.5 + math.pi), [4.0, 5.6, 1.0, 6.0], kind="ROBOTLASER2", most=5.6
    )
    report, session, scans, samples = imported(text)
    assert report.scans == {"front": 1, "rear": 1}
    front, rear = scans
    assert (front.first_angle_rad, front.angle_step_rad) == (-1.0, pytest.approx(0.1))
    np.testing.assert_array_equal(front.range_m, np.float32([4.0, 5.0, np.nan, 6.0]))
    np.testing.assert_array_equal(rear.range_m, np.float32([4.0, np.nan, 1.0, np.nan]))
    assert abs(session.mountings["rear"].theta_rad) == pytest.approx(math.pi, abs=1e-5)
    assert (samples[0].x_m, samples[0].y_m, samples[0].theta_rad) == (1.0, 2.0, pytest.approx(0.5))
    assert "no ODOM lines" in report.odometry_source


def corrected_log():
    """As GMapping writes it: the odometry starts again from each corrected pose, which stands twice."""
    return (
        odom("1.0", 0.0, 0.0, 0.0)
        + odom("1.1", 0.1, 0.0, 0.0)
        + flaser("1.1", (5.0, 5.0, math.pi / 2))
        + odom("0", 5.0, 5.0, math.pi / 2)
        + "NEFF 10 0 pippo 0\n"
        + odom("1.2", 5.0, 5.2, math.pi / 2)
        + flaser("1.2", (7.0, 5.0, 0.0))
        + odom("1.19877e-71", 7.0, 5.0, 0.0)
        + "NEFF 10 0 pippo 0\n"
        + odom("1.3", 7.3, 5.0, 0.0)
    )


def test_corrected_poses_do_not_become_odometry(imported):
    report, _, scans, samples = imported(corrected_log())
    assert len(scans) == 2
    assert [sample.x_m for sample in samples] == pytest.approx([0.0, 0.1, 0.3, 0.6])
    assert [sample.y_m for sample in samples] == pytest.approx([0.0] * 4, abs=1e-12)
    assert [s.twist_mps_radps[0] for s in samples] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    assert "NEFF" in report.corrected
    assert "is a corrected log" in str(report)
    assert "increments of 4 ODOM lines" in str(report)


def test_corrected_poses_can_be_asked_for_and_odometry_left_out(imported):
    _, _, _, samples = imported(corrected_log(), odometry="logged")
    assert [sample.x_m for sample in samples] == [5.0, 7.0]
    report, session, _, samples = imported(corrected_log(), odometry="none")
    assert samples == []
    assert session.sensors == {"/front/scan": "front"}
    assert "left out" in str(report)


def test_a_laser_that_moves_against_the_robot_gives_a_corrected_log_away(imported):
    robots = [(0.1 * k, 0.0, 0.0) for k in range(20)]
    text = "".join(
        flaser(f"{1 + 0.1 * k:.1f}", pose, laser=(pose[0], 0.02 * k, 0.0)) for k, pose in enumerate(robots)
    )
    report, session, _, samples = imported(text)
    assert "the laser moves against the robot" in report.corrected
    assert [sample.x_m for sample in samples] == [pose[0] for pose in robots]
    assert session.mountings["front"] == SE2()


def test_lines_out_of_order_are_reported_with_their_lateness(imported):
    times_s = ("1000.0", "1000.1", "900.0", "900.1")
    report, _, scans, _ = imported("".join(flaser(time_s, (0.0, 0.0, 0.0)) for time_s in times_s))
    assert [scan.stamp_ns // 10**8 for scan in scans] == [9000, 9001, 10000, 10001]
    assert "put in the order of their stamps: 1 line, by up to 100.10 s" in str(report)


def test_malformed_lines_are_counted_and_skipped(imported):
    good = flaser("1.0", (0, 0, 0))
    report, _, scans, samples = imported(
        good
        + "FLASER 180 1.0 2.0\n"
        + "FLASER many\n"
        + flaser("1.1", (math.nan, 0, 0))
        + "ODOM 1 2 x 0 0 0 1.0 merlin 1.0\n"
        + "ODOM 1 2 3 0 0 0 -5 merlin 1.0\n"
        + "PARAM\n"
        + "SYNC tag 1.0 merlin 1.0\n"
        + "SONAR 1 2 3\n"
        + good[: len(good) // 2]
    )
    assert len(scans) == len(samples) == 1
    assert report.malformed == {"FLASER": 4, "ODOM": 2, "PARAM": 1}
    assert report.ignored == {"SYNC": 1, "SONAR": 1}
    assert "skipped as malformed: 4 FLASER, 2 ODOM, 1 PARAM" in str(report)


def test_gzip_is_read_whatever_the_name(tmp_path):
    log = tmp_path / "run.log"
    log.write_bytes(gzip.compress((HEAD + flaser("1.0", (0, 0, 0))).encode()))
    assert import_carmen(log, tmp_path / "out.mcap").scans == {"front": 1}
    log.write_bytes(log.read_bytes()[:-12])
    with pytest.raises(InputError, match="cannot read"):
        import_carmen(log, tmp_path / "out.mcap")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Dear diary,\n", r"is it a CARMEN log\? It begins with 'Dear diary,'"),
        (flaser("inf", (1, 0, 0)) + flaser("nan", (1, 0, 0)), "holds no line of FLASER"),
        (
            flaser("1.0", (0, 0, 0), ranges=[81.91] * 180) + flaser("2.0", (0, 0, 0), ranges=[0] * 180),
            "not one beam of 2 scans came back between 0 and 50 m",
        ),
        ("".join(flaser("1.13486e+09", (k, 0, 0)) for k in range(9)), "9 scans carry 1 different times"),
    ],
    ids=["no log", "stamps that are no times", "no beam came back", "times that lost their digits"],
)
def test_a_log_that_cannot_be_mapped_is_refused_in_words(tmp_path, text, words):
    log = tmp_path / "run.log"
    log.write_text(text)
    with pytest.raises(InputError, match=words):
        import_carmen(log, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_an_import_that_is_running_is_not_disturbed(tmp_path):
    log = tmp_path / "run.log"
    log.write_text(flaser("1.0", (0, 0, 0)))
    (tmp_path / "out.mcap.active").write_bytes(b"")
    with pytest.raises(StorageError, match="is in the way"):
        import_carmen(log, tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap.active").exists()
    with pytest.raises(StorageError, match="is no folder"):
        import_carmen(log, log / "out.mcap")


@pytest.mark.parametrize(
    ("log", "reference", "shift_ns", "corrected"),
    [
        in_soak("fr079/raw/freiburg-079-corrected.log.gz", "fr079/fr079.mcap", 1_211_440_000_000, True),
        in_soak("aces/raw/aces-corrected.log.gz", "aces/aces.mcap", 1_000_000_000 * 10**9, True),
        ("csail/raw/csail.corrected.gfs.gz", "csail/csail.mcap", 0, True),
        ("wean1/raw/robotdata1.log.gz", "wean1/wean1.mcap", 1_000_000_000 * 10**9, False),
    ],
    ids=["fr079", "aces", "csail", "wean1"],
)
def test_real_logs_give_what_others_made_of_them(shared, tmp_path, log, reference, shift_ns, corrected):
    """The references were converted by another program, on a clock of their own."""
    report = import_carmen(shared / "datasets" / log, tmp_path / "out.mcap")
    assert bool(report.corrected) is corrected
    assert not report.malformed
    ours, theirs = (
        list(open_session([path]).frames()) for path in (report.path, shared / "datasets" / reference)
    )
    for kind in (LaserScan, OdometrySample):
        pairs = zip(*([f for f in frames if isinstance(f, kind)] for frames in (ours, theirs)), strict=True)
        for frame, expected in pairs:
            assert abs(frame.stamp_ns + shift_ns - expected.stamp_ns) < 1_000
            if isinstance(frame, LaserScan):
                np.testing.assert_allclose(frame.range_m, expected.range_m, atol=1e-5)
                assert frame.first_angle_rad == pytest.approx(expected.first_angle_rad)
                assert frame.angle_step_rad == pytest.approx(expected.angle_step_rad)
                continue
            assert (frame.x_m, frame.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-6)
            turned_rad = math.remainder(frame.theta_rad - expected.theta_rad, math.tau)
            assert turned_rad == pytest.approx(0.0, abs=1e-6)
