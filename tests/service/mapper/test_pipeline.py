import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import Frame, GnssFix, ImuSample, LaserScan
from service.estimator import samples
from service.geometry.se2 import SE2
from service.mapper.components import GraphUpdate, PlaceUpdate, UnconfirmedPlace
from service.mapper.known_pose import KnownPose
from service.mapper.localisation import UNCONFIRMED_PLACE
from service.mapper.methods.shared import NoGraph
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from simulators.truth import Ride
from simulators.worlds import WORLDS
from tests.accuracy.driving import Trip
from tests.accuracy.sensors import GOOD_WHEELS, LMS100_10HZ, LUX_AHEAD
from tests.service.mapper.drives import MOUNTING, ROOM, drive, outputs_of, standing
from tests.simulated import FORWARD, UTM30LX_40HZ, Imu, Laser, odometry, scans


@pytest.mark.parametrize("profile", ["contour_lm", "submap_graph"])
def test_fixes_are_counted_and_passed_over_where_no_graph_takes_them(profile):
    mapper = build_mapper(mapping_config({"profile": profile}), {})
    lost = GnssFix("imu", 2, 3, -1, math.nan, math.nan, math.nan, (0.0,) * 9)
    for fix in (GnssFix("imu", 1, 2, 0, 60.1, 24.5, 51.0, (0.0,) * 9), lost):
        assert mapper.process(fix) is None
    assert mapper.counters == {"fixes_passed_over": 2}


@pytest.mark.parametrize("is_paused", [False, True])
def test_samples_that_are_dropped_while_no_scan_comes_are_counted(is_paused, monkeypatch):
    monkeypatch.setattr(samples, "MAX_SAMPLES", samples.CAPACITY)
    mapper = build_mapper(mapping_config(), {"front": MOUNTING})
    scans = [frame for frame in drive(ROOM, standing, 0.2).frames if isinstance(frame, LaserScan)]
    mapper.process(scans[0])
    for k in range(samples.CAPACITY + 1):
        mapper.process(ImuSample("imu", k + 1, k + 1, (0.0,) * 3, (0.0, 0.0, 9.81)))
    for scan in scans[1:3]:
        (mapper.skip if is_paused else mapper.process)(scan)
    assert mapper.counters["samples_dropped_waiting"] == samples.CAPACITY // 2


class KnowingGraph(NoGraph):
    """Has corrected a key frame: the pose is known as `covariance` there."""

    covariance = np.diag([1.0, 0.01, 0.01])

    def apply_result(self):
        return GraphUpdate({}, known=KnownPose(SE2(), np.zeros((3, 3)), self.covariance))


def test_the_covariance_grows_from_that_of_the_graph_and_drift_is_not_ok():
    mapper: Mapper = build_mapper(mapping_config(), {"front": MOUNTING})
    mapper.components = replace(mapper.components, graph=KnowingGraph())
    frames = iter(drive(ROOM, standing, 0.6).frames)
    before = next(output for frame in frames if (output := mapper.process(frame)) is not None)
    assert before.state == "ok"
    assert np.trace(before.covariance) < 1e-3
    mapper.apply_result()
    after = next(output for frame in frames if (output := mapper.process(frame)) is not None)
    np.testing.assert_allclose(after.covariance, KnowingGraph.covariance, atol=1e-3)
    assert after.state == "degraded"
    assert "uncertain by 1.00 m" in after.reason


class FindingGraph(NoGraph):
    """Reports an unconfirmed place of the segment that the first lost scan begins."""

    place = UnconfirmedPlace(1, SE2(5.0, -2.0, 0.7))

    def apply_result(self):
        return GraphUpdate({}, place=PlaceUpdate(unconfirmed_place=self.place))


def test_nothing_is_rendered_while_the_place_is_unknown_and_a_detached_segment_is_mapped_apart():
    """Carried into another room, while odometry reports a standstill."""
    mapper: Mapper = build_mapper(mapping_config(), {"front": MOUNTING})
    mapper.components = replace(mapper.components, graph=FindingGraph())
    here = drive(ROOM, standing, 0.8)
    outputs_of(mapper, here.frames)
    assert mapper.changed_tiles()
    other = [tuple(2.5 * v for v in wall) for wall in ROOM[:6]]
    last_ns = here.frames[-1].stamp_ns
    there = drive(other, lambda t: SE2(3.0, 3.0, 2.0), 1.2, last_ns, wheel_scale=None).frames
    lost = outputs_of(mapper, there[:20])
    assert {output.state for output in lost} == {"lost"}
    assert np.isfinite(lost[0].covariance).all()
    mapper.apply_result()
    for output in outputs_of(mapper, there[20:]):  # longer than the shown map waits for the next scan
        assert (output.state, output.reason) == ("degraded", UNCONFIRMED_PLACE)
        assert output.pose_map_odom == FindingGraph.place.pose_map_odom
    assert mapper.changed_tiles() == []
    assert mapper.components.local_map.detached.scan_count > 5


def two_lasers(seconds: float = 1.6) -> list[Frame]:
    """The room driven through with a second laser behind, whose sweeps overlap those of the first."""
    front = drive(ROOM, ahead, seconds)
    rear = [
        replace(frame, sensor="rear", stamp_ns=frame.stamp_ns - SHIFT_NS)
        for frame in drive(ROOM, lambda t_s: ahead(t_s - SHIFT_NS * 1e-9), seconds, mounting=REAR).frames
        if isinstance(frame, LaserScan)
    ]
    return sorted([*front.frames, *rear], key=lambda frame: (frame.arrived_ns, frame.sensor))


SHIFT_NS = 7_000_000  # that a sweep of the rear laser begins before one of the front laser
REAR = SE2(-0.3, 0.1, math.pi)
BOTH = {"front": MOUNTING, "rear": REAR}


def ahead(t_s: float) -> SE2:
    return SE2(0.4 * t_s, 0.0, 0.1 * t_s)


def true_pose(stamp_ns: int) -> SE2:
    """Seen from the first scan, which is one of the front laser."""
    first_ns = 10**9 + 1_234_567
    return ahead((first_ns - 10**9) * 1e-9).inverse() @ ahead((stamp_ns - 10**9) * 1e-9)


def driven(world: str, laser: Laser, each: int, leaves_out: Callable[[Mapper, LaserScan], None]) -> float:
    """Worst error, m, of 15 s in which only each so many scans come to be matched; those are all ok."""
    made = Trip(WORLDS[world], laser, 15.0, GOOD_WHEELS, Imu())._drive(5)
    mapper = build_mapper(mapping_config(), {"front": FORWARD})
    scans, worst_m = 0, 0.0
    for frame in made.frames:
        scans += isinstance(frame, LaserScan)
        if isinstance(frame, LaserScan) and scans % each != 1:
            leaves_out(mapper, frame)
        elif (output := mapper.process(frame)) is not None:
            error = made.truth[output.stamp_ns].inverse() @ output.pose_map_base
            worst_m = max(worst_m, math.hypot(error.x_m, error.y_m))
            assert output.state == "ok"
    return worst_m


@pytest.mark.parametrize("laser", [LMS100_10HZ, LUX_AHEAD], ids=["LMS-100", "LUX"])
def test_scans_that_are_passed_over_do_not_shorten_the_path_of_odometry(laser: Laser):
    """On a busy computer three of four are: odometry's step is that since the last one that was matched."""
    assert driven("office", laser, 4, lambda mapper, scan: mapper.skip(scan)) < 0.05


def test_scans_with_too_few_returns_do_not_shorten_the_path_of_odometry():
    """People who come near cover the walls: to the scans alone they seem to stand."""

    def blank(mapper: Mapper, scan: LaserScan) -> None:
        mapper.process(replace(scan, range_m=np.full_like(scan.range_m, np.nan)))

    assert driven("crowd", LMS100_10HZ, 2, blank) < 0.05


def test_sweeps_of_two_lasers_overlap_and_every_one_is_mapped():
    mapper: Mapper = build_mapper(mapping_config(), BOTH)
    frames = two_lasers()
    outputs = outputs_of(mapper, frames)
    assert mapper.counters["scans"] == sum(isinstance(frame, LaserScan) for frame in frames)
    stamps_ns = [output.stamp_ns for output in outputs]
    assert stamps_ns == sorted(set(stamps_ns))  # a pose for each, and no two at one moment
    off = [true_pose(o.stamp_ns).inverse() @ o.pose_map_base for o in outputs]
    assert max(math.hypot(e.x_m, e.y_m) for e in off) < 0.01
    assert {output.state for output in outputs} == {"ok"}


def test_a_mounting_measured_to_two_centimetres_is_no_error_of_odometry():
    """Both lasers at the same times: by what they differ the wheels would seem to roll too far.

    Then the wheels alone measure the path.
    """
    seconds, silent_ns, back_ns = 7.0, 4_000_000_000, 6_500_000_000
    ride = Ride(WORLDS["ring"](), 0, 0.5)
    front = replace(UTM30LX_40HZ, beams=361, step_deg=0.75)
    frames: list[Frame] = [*odometry(ride, GOOD_WHEELS, seconds, 5)]
    rear = replace(front, name="rear", mounting=SE2(-0.2, 0.0, math.pi))
    for seed, laser in enumerate((front, rear)):
        frames += scans(ride, laser, seconds, [seed])[0]
    mountings = {"front": FORWARD, "rear": rear.mounting @ SE2(0.02, -0.01, 0.0)}
    mapper: Mapper = build_mapper(mapping_config(), mountings)
    begin, worst_m = ride.pose(0), 0.0
    for frame in sorted(frames, key=lambda frame: (frame.arrived_ns, frame.sensor)):
        if isinstance(frame, LaserScan) and silent_ns < frame.stamp_ns < back_ns:
            continue
        if (output := mapper.process(frame)) is not None and frame.stamp_ns > back_ns:
            error = (begin.inverse() @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base
            worst_m = max(worst_m, math.hypot(error.x_m, error.y_m))
    assert worst_m < 0.03
    assert mapper.counters["mounting_corrected_rear"] > 0


def test_a_laser_that_is_turned_against_its_mounting_is_not_mapped_and_reported_by_how_much():
    turned = REAR @ SE2(0.0, 0.0, math.radians(4.0))
    mapper: Mapper = build_mapper(mapping_config(), {"front": MOUNTING, "rear": turned})
    reasons, farthest_m = set(), 0.0
    for frame in two_lasers():
        if (output := mapper.process(frame)) is None:
            continue
        away = true_pose(output.stamp_ns).inverse() @ output.pose_map_base
        farthest_m = max(farthest_m, math.hypot(away.x_m, away.y_m))
        if frame.sensor == "rear" and frame.stamp_ns > 2_560_000_000:
            reasons.add(output.reason)
    (reason,) = reasons
    assert re.match(
        r"rear is off its configured mounting by -(3\.[89]|4\.[01]) deg, [+-]0\.0\d m ahead and "
        r"[+-]0\.0\d m left",
        reason,
    )
    assert mapper.counters["scans_compared_rear"] > 60
    assert farthest_m < 0.01


def test_a_laser_with_a_wrong_mounting_is_not_mapped_when_the_others_fall_silent():
    """Nor when they come back: without them its poses would be called `ok`, turned by 4 deg."""
    mapper: Mapper = build_mapper(mapping_config(), {"front": MOUNTING, "rear": REAR @ SE2(0, 0, 0.07)})
    alone_ns, back_ns = 2_000_000_000, 2_560_000_000  # half a second of silence is not yet alone
    states: dict[str, set[str]] = {"silent": set(), "alone": set()}
    for frame in two_lasers(2.2):
        if frame.sensor == "front" and frame.stamp_ns > alone_ns:
            continue
        output = mapper.process(frame)
        if output is not None and frame.stamp_ns > back_ns:
            states["alone"].add(output.state)
        elif output is not None and alone_ns < frame.stamp_ns < alone_ns + 450_000_000:
            states["silent"].add(output.state)
    assert states == {"silent": {"degraded"}, "alone": {"lost"}}


def test_a_laser_that_hangs_is_named_while_another_sees_on():
    mapper: Mapper = build_mapper(mapping_config(), BOTH)
    frozen, reported = None, []
    for frame in two_lasers():
        if isinstance(frame, LaserScan) and frame.sensor == "rear" and frame.stamp_ns > 1_700_000_000:
            frozen = frozen or frame
            frame = replace(frame, range_m=frozen.range_m)
        output = mapper.process(frame)
        if output is not None and frame.stamp_ns > 2_000_000_000:
            reported.append((frame.sensor, output.state, "has the laser stopped measuring" in output.reason))
    assert {("front", "ok", False), ("rear", "degraded", True)} == set(reported)


def swinging(t_s: float) -> SE2:
    return SE2(0.2 * t_s, 0.0, 0.5 * math.sin(2.0 * t_s))


def test_a_laser_whose_stamps_are_late_is_named_and_no_longer_mapped_beside_the_other():
    """Each turn would shift what it sees against the map of the other, to and fro."""
    mapper: Mapper = build_mapper(mapping_config(), BOTH)
    late_ns, seconds, alone_ns = 80_000_000, 7.5, 7_000_000_000
    front = [f for f in drive(ROOM, swinging, seconds, every=2).frames if f.stamp_ns < alone_ns]
    seen_late = drive(
        ROOM, lambda t_s: swinging(t_s - late_ns * 1e-9), seconds, mounting=REAR, every=2
    ).frames
    rear = [replace(frame, sensor="rear") for frame in seen_late if isinstance(frame, LaserScan)]
    reported: dict[str, set[tuple[str, str, str]]] = {"both": set(), "alone": set()}
    for frame in sorted([*front, *rear], key=lambda frame: (frame.arrived_ns, isinstance(frame, LaserScan))):
        output = mapper.process(frame)
        if output is None or frame.stamp_ns < 5_000_000_000:
            continue
        when = "both" if frame.stamp_ns < alone_ns else "alone"
        if when == "both" or frame.stamp_ns > alone_ns + 700_000_000:
            reported[when].add(
                (frame.sensor, output.state, re.sub(r"\b(79|80|81) ms.*", "80 ms", output.reason))
            )
    assert reported == {
        "both": {("front", "ok", ""), ("rear", "degraded", "rear has stamps that are 80 ms")},
        "alone": {("rear", "ok", "")},
    }
    assert mapper.counters["scans_compared_rear"] > 60
