import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from service.config import ServiceConfig, parse_config
from service.mapstore.files import save_map
from service.runtime import resume
from service.runtime.resume import Point, PointWriter, point_file, resumed
from tests.service.mapstore.tile_makers import graph_of, tile
from tests.waiting import wait_until

CONFIG = """
vehicle: veh1
sensors: {{front: {{type: sick_lms100, host: 127.0.0.1, mounting: {{x_m: 0.0}}}}}}
recording: {{directory: {out}}}
map: {{directory: {out}}}
web: {{enabled: false}}
"""


@pytest.fixture
def config(tmp_path: Path) -> ServiceConfig:
    return parse_config(CONFIG.format(out=tmp_path), "config")


@pytest.fixture
def folder(config: ServiceConfig, tmp_path: Path) -> Path:
    """Of a map that a killed session stored."""
    cell_m = config.mapping.cell_m
    save_map(tmp_path / "map", [replace(tile(0, 0, 1, edge=64), cell_m=cell_m)], 1, graph=graph_of(3))
    return tmp_path / "map"


def killed(config: ServiceConfig, folder: Path, ago_s: float) -> None:
    """Leave what a service leaves that was killed so long ago."""
    unix_ns = time.time_ns() - round(ago_s * 1e9)
    point = Point(folder=folder, unix_ns=unix_ns, x_m=1.0, y_m=2.0, theta_rad=0.5)
    point_file(config).write_text(point.model_dump_json())


def test_a_session_goes_on_in_the_map_and_at_the_pose_of_one_that_was_killed(config, folder):
    killed(config, folder, ago_s=10.0)
    going_on, pose = resumed(config)
    assert going_on.begin_in == going_on.sinks["map"].load == folder
    assert (pose.x_m, pose.y_m, pose.theta_rad) == (1.0, 2.0, 0.5)


@pytest.mark.parametrize("ago_s", [70.0, -70.0], ids=["too old", "of a clock that stepped back"])
def test_an_old_map_is_not_gone_on_in(config, folder, ago_s):
    killed(config, folder, ago_s)
    assert resumed(config) == (config, None)


def test_the_map_of_a_service_that_runs_is_not_gone_on_in(config, folder, monkeypatch, caplog):
    """Two of one vehicle by two configs would store versions in one folder."""
    monkeypatch.setattr(resume, "WRITE_S", 0.01)
    killed(config, folder, ago_s=1.0)
    point = Point.model_validate_json(point_file(config).read_text())
    program = (
        "import sys; from pathlib import Path; from service.runtime.resume import Point, PointWriter\n"
        "path = Path(sys.argv[1]); point = Point.model_validate_json(path.read_text()); path.unlink()\n"
        "writer = PointWriter(path, lambda: point); writer.start(); sys.stdin.read()"
    )
    command = [sys.executable, "-c", program, str(point_file(config))]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as other:
        wait_until(
            lambda: point_file(config).exists() and point_file(config).read_text() != point.model_dump_json()
        )
        assert resumed(config) == (config, None)
        assert f"process {other.pid} is a service of veh1, too" in caplog.text
        other.kill()
    assert resumed(config)[1] == point.pose


@pytest.mark.parametrize("text", ["", "{", '{"folder": 1}', "[]"])
def test_a_damaged_point_begins_a_new_map(config, folder, text):
    point_file(config).write_text(text)
    assert resumed(config) == (config, None)


def test_a_map_that_cannot_be_read_begins_a_new_one_and_says_so(config, tmp_path, caplog):
    killed(config, tmp_path / "gone", ago_s=1.0)
    assert resumed(config) == (config, None)
    assert "a new one begins" in caplog.text


def test_the_map_of_the_config_is_begun_in_and_the_pose_taken_where_it_is_the_same(config, folder, tmp_path):
    killed(config, folder, ago_s=1.0)
    assert resumed(replace(config, begin_in=tmp_path / "other"))[1] is None
    assert resumed(replace(config, begin_in=folder))[1] is not None


def test_the_point_is_written_while_the_service_runs_and_gone_when_it_ended_well(
    config: ServiceConfig, folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(resume, "WRITE_S", 0.01)
    point = Point(folder=folder, unix_ns=time.time_ns(), x_m=1.0, y_m=2.0, theta_rad=0.5)
    points: list[Point | None] = [None, None, point]
    writer = PointWriter(point_file(config), lambda: points.pop(0) if len(points) > 1 else points[0])
    writer.start()
    wait_until(point_file(config).exists)
    writer.stop(10.0)
    assert resumed(config)[1] == point.pose
    writer.remove()
    assert resumed(config) == (config, None)
    assert not [name for name in os.listdir(folder.parent) if "resume" in name]
