"""A drive through streets with a receiver is replayed; a fix that says nothing changes no bit."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import Frame, GnssFix
from service.config import mountings, parse_config
from service.encoding import encode_frame, encode_tf_static
from service.mapstore.geo_file import read_geo
from service.offline.export.export import export
from service.offline.replay.replay import ReplayOptions, replay, write_replay
from service.recording.mcap_recorder import McapRecorder
from simulators.truth import Ride
from tests.accuracy.anchored import ANTENNA, LASER, STAND_S, YAW_RAD, fixes
from tests.gnss_receiver import GnssModel, Receiver
from tests.simulated import Drive, Wheels, drives
from tests.streets import streets

T0_NS = 1_700_000_000_000_000_000
SECONDS = 28.0
RECEIVER = GnssModel(lasting_sigma_m=0.3, reported_sigma_m=0.5)
CONFIG = f"""\
vehicle: v
sensors:
  front: {{type: hokuyo_utm30lx, host: a, mounting: {{x_m: 0.2}}}}
  imu: {{type: xsens_mtig, device: /dev/x, lever_arm_m: [{ANTENNA.x_m}, {ANTENNA.y_m}, 0.5]}}
  base: {{type: irobot_create, device: /dev/y}}
recording: {{directory: s}}
map: {{directory: m}}
"""


@pytest.fixture(scope="module")
def drive() -> Drive:
    """126 m."""
    world, laser = streets(), replace(LASER, beams=271, step_deg=1.0, rate_hz=10.0)
    bare = drives(world, laser, SECONDS, [1], Wheels(), stand_s=STAND_S)[0]
    receiver = Receiver(RECEIVER, 1, world_yaw_rad=YAW_RAD)
    frames: list[Frame] = [*bare.frames, *fixes(Ride(world, 0, STAND_S), receiver, SECONDS)]
    moved = [
        replace(frame, stamp_ns=frame.stamp_ns + T0_NS, arrived_ns=frame.arrived_ns + T0_NS)
        for frame in frames
    ]
    truth = {stamp_ns + T0_NS: pose for stamp_ns, pose in bare.truth.items()}
    return Drive(sorted(moved, key=lambda frame: frame.arrived_ns), truth, bare.world_first)


def record(folder: Path, frames: Sequence[Frame], config: str = CONFIG) -> Path:
    recorder = McapRecorder(folder, "v", keep_free_bytes=0, metadata={"config": {"yaml": config}})
    recorder.start()
    recorder.put(encode_tf_static(mountings(parse_config(config, "c").sensors), T0_NS, T0_NS))
    for frame in frames:
        recorder.put(encode_frame(frame))
    (session,) = recorder.finish()
    return session


@pytest.fixture(scope="module")
def replayed(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Folder of the replay with each fix changed, or left out; of all or of the first seconds."""

    def make(
        name: str, change: Callable[[GnssFix], GnssFix | None], seconds: float = SECONDS + STAND_S
    ) -> Path:
        folder = tmp_path_factory.getbasetemp() / f"replayed_{name}"
        if not folder.exists():
            frames = [frame for frame in drive.frames if frame.stamp_ns < T0_NS + seconds * 1e9]
            changed = (change(frame) if isinstance(frame, GnssFix) else frame for frame in frames)
            session = record(folder / "in", [frame for frame in changed if frame is not None])
            write_replay(replay([session], ReplayOptions()), folder)
        return folder

    return make


def test_a_replay_says_where_the_map_lies_and_export_uses_it(
    drive: Drive, replayed: Callable[..., Path], tmp_path: Path
):
    folder = replayed("anchored", lambda fix: fix)
    reference = read_geo(folder / "geo.json")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["geo_reference"] == json.loads((folder / "geo.json").read_text())
    assert summary["fixes"]["anchoring"] == reference.fixes > 20
    assert (folder / "map.pgw").exists()
    assert (folder / "map.png.aux.xml").exists()
    export(folder, "geojson", tmp_path / "path.geojson")
    feature, walls = json.loads((tmp_path / "path.geojson").read_text())["features"]
    assert walls["properties"]["name"] == "walls"
    origin, off_m = Receiver(GnssModel(), 1).origin, []
    for (longitude, latitude), pose in zip(
        feature["geometry"]["coordinates"], drive.truth.values(), strict=True
    ):
        east_m, north_m, _ = origin.to_enu(latitude, longitude, origin.height_m)
        c, s = np.cos(YAW_RAD), np.sin(YAW_RAD)
        at = drive.world_first @ pose
        off_m.append(np.hypot(east_m - c * at.x_m + s * at.y_m, north_m - s * at.x_m - c * at.y_m))
    assert max(off_m) < 2.0


def test_fixes_of_no_use_change_no_bit_and_an_older_reference_does_not_stay(replayed: Callable[..., Path]):
    bare = replayed("bare", lambda fix: None, 8.0)
    poor = replayed("poor", lambda fix: replace(fix, covariance=tuple(1e4 * c for c in fix.covariance)), 8.0)
    for name in ("trajectory.tum", "trajectory_live.tum", "graph.g2o", "map.pgm", "map.yaml"):
        assert (bare / name).read_bytes() == (poor / name).read_bytes()
    assert not (bare / "geo.json").exists()
    assert json.loads((poor / "summary.json").read_text())["fixes"] == {"too_poor": 32}
    assert json.loads((bare / "summary.json").read_text())["geo_reference"] is None
