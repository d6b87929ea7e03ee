from dataclasses import replace

import numpy as np
import pytest

import corridor
from tests.service.api.rooms import MOUNTINGS, driven

ROOM_SCAN = next(frame for frame in driven().frames if isinstance(frame, corridor.LaserScan))


def mapped(mapper: corridor.Mapper, frames) -> list[corridor.Pose]:
    return [pose for frame in frames if (pose := mapper.process(frame)) is not None]


def test_a_mapper_gives_what_a_replay_gives_bit_for_bit(recording, replayed):
    opened = corridor.read(recording)
    mapper = corridor.Mapper(opened)
    poses = mapped(mapper, opened)
    assert len(poses) == len(replayed.poses) == 50
    for here, there in zip(poses, replayed.poses, strict=True):
        assert (here.stamp_ns, here.x_m, here.y_m, here.theta_rad, here.state) == (
            *(there.stamp_ns, there.x_m, there.y_m, there.theta_rad, there.state),
        )
        np.testing.assert_array_equal(here.covariance, there.covariance)
    np.testing.assert_array_equal(mapper.trajectory().pose, replayed.trajectory_live.pose)
    mapper.finish()
    np.testing.assert_array_equal(mapper.trajectory().pose, replayed.trajectory.pose)
    grid = mapper.map()
    np.testing.assert_array_equal(grid.cells, replayed.map.cells)
    assert mapper.counters["scans"] == 50
    assert not mapper.warnings


def test_frames_of_a_program_are_mapped_where_the_vehicle_was(replayed):
    mapper = corridor.Mapper(mountings=MOUNTINGS)
    assert mapper.map() is None
    assert mapper.counters["scans"] == mapper.counters["scans_dropped_late"] == 0
    poses = mapped(mapper, driven().frames)
    for pose in poses:
        true = driven().truth[pose.stamp_ns]
        assert np.hypot(pose.x_m - true.x_m, pose.y_m - true.y_m) < 0.02
    assert len(poses) == 50


def test_a_config_is_a_file_or_what_would_stand_in_one(tmp_path):
    sensor = {"type": "sick_lms100", "mounting": {"x_m": 0.2, "y_m": 0.05, "yaw_deg": 5.7295779513}}
    config = {"sensors": {"front": sensor}, "mapping": {"cell_m": 0.1}}
    (tmp_path / "v.yaml").write_text(
        "sensors: {front: {type: sick_lms100, mounting: {x_m: 0.2, y_m: 0.05, yaw_deg: 5.7295779513}}}\n"
        "mapping: {cell_m: 0.1}\n"
    )
    mappers = [corridor.Mapper(config), corridor.Mapper(tmp_path / "v.yaml")]
    first, second = ([p.x_m for p in mapped(mapper, driven().frames[:120])] for mapper in mappers)
    assert first == second
    grid = mappers[0].map()
    assert grid.cell_m == 0.1


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        (
            {"config": {"mapping": {"cel_m": 0.1}}},
            corridor.ConfigError,
            r"config:2:3: mapping\.cel_m: .*cell_m",
        ),
        ({"config": {"mapping": {"mode": "localization"}}}, corridor.ConfigError, "is in a stored map"),
        ({"mountings": {"front": (1.0, 2.0)}}, corridor.UsageError, r"mounting of front: .*expected \(x m"),
        ({"mountings": {"front": (1.0, 2.0, np.nan)}}, corridor.UsageError, "mounting of front: "),
        ({"version": 2}, corridor.UsageError, "version 2 is of a stored map"),
    ],
)
def test_wrong_settings_are_refused_in_words(settings, error, words):
    with pytest.raises(error, match=words):
        corridor.Mapper(**settings)


def test_a_scan_of_an_unknown_laser_is_refused_and_one_of_an_unmapped_laser_counted():
    mapper = corridor.Mapper({"sensors": {"rear": {"type": "sick_lms100", "map": False}}}, MOUNTINGS)
    assert mapper.process(replace(ROOM_SCAN, sensor="rear")) is None
    assert mapper.counters["scans_not_mapped"] == 1
    with pytest.raises(corridor.InputError, match="'left', where the mapper knows front, rear"):
        mapper.process(replace(ROOM_SCAN, sensor="left"))


def test_what_is_no_frame_is_refused():
    with pytest.raises(corridor.UsageError, match=r"a ndarray is no frame; corridor\.scan"):
        corridor.Mapper().process(ROOM_SCAN.range_m)


def test_a_saved_map_is_gone_on_in(stored):
    mapper = corridor.Mapper(mountings=MOUNTINGS, map=stored, localize=True)
    poses = mapped(mapper, driven().frames)
    assert poses[0].state == "lost"
    true = driven().truth[poses[-1].stamp_ns]
    assert np.hypot(poses[-1].x_m - true.x_m, poses[-1].y_m - true.y_m) < 0.02
    assert poses[-1].state != "lost"
    with pytest.raises(corridor.UsageError, match="localises only"):
        mapper.save(stored)
    corridor.Mapper({"map": {"load": str(stored)}}, localize=True)  # which needs a map


def test_nothing_goes_on_after_the_end_and_nothing_is_saved_of_nothing(tmp_path):
    mapper = corridor.Mapper(mountings=MOUNTINGS)
    with pytest.raises(corridor.InputError, match="nothing was mapped"):
        mapper.save(tmp_path / "map")
    assert mapper.process(ROOM_SCAN) is not None
    assert mapper.save(tmp_path / "map") == 1
    with pytest.raises(corridor.UsageError, match="finished"):
        mapper.process(ROOM_SCAN)
