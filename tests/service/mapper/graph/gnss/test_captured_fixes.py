"""Fixes of a stationary MTi-G-710, 3 s in three files, through all stages before the map."""

from pathlib import Path

import numpy as np
import pytest

from drivers.frames import GnssFix
from drivers.xsens_mtig.protocol import MessageDecoder, encode
from service.encoding import decode_frame, encode_frame
from service.geometry.geo_reference import LocalFrame
from service.geometry.se2 import SE2
from service.mapper.graph.gnss.fix_track import FixTrack
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from tests.drivers.mtig import fixes, mtdata2, talk
from tests.service.mapper.graph.gnss.outdoors import NO_SEARCH
from tests.service.mapper.graph.key_frames import key_frame

STEP_NS = 10_000_000


def captured(shared: Path) -> list[GnssFix]:
    """As the mapper gets them: decoded, encoded for the recording, and decoded again."""
    session = (t := talk(mtdata2(), up_axis="-y").run(1.0)).session
    frames = []
    for name in ("t1", "t2", "t3"):
        wire = (shared / f"captures/xsens/einride_xsens-go_{name}_output.bin").read_bytes()
        for message in MessageDecoder().receive_data(wire):
            t.now_ns += STEP_NS
            frames += session.receive_data(encode(message.mid, message.data), t.now_ns)
    again = []
    for fix in fixes(frames):
        message = encode_frame(fix)
        frame = decode_frame(message.type, message.payload, "imu", message.log_ns)
        assert isinstance(frame, GnssFix)
        again.append(frame)
    return again


def test_the_unit_stood_and_its_fixes_wander_by_less_than_they_claim(shared: Path):
    found = captured(shared)
    assert len(found) == 12
    assert {fix.status for fix in found} == {0}
    sigma_m = [fix.covariance[0] ** 0.5 for fix in found]
    assert min(sigma_m) == pytest.approx(2.259, abs=1e-3)
    assert max(sigma_m) == pytest.approx(2.280, abs=1e-3)
    origin = LocalFrame(found[0].latitude_deg, found[0].longitude_deg, found[0].altitude_m)
    enu = np.array([origin.to_enu(f.latitude_deg, f.longitude_deg, f.altitude_m) for f in found])
    assert 0.5 < np.hypot(*enu[-1, :2]) < 1.0  # in 3 s: what lasts changes, noise is millimetres
    assert np.hypot(*np.diff(enu[:4, :2], axis=0).T).max() < 0.1


def ended(found: list[GnssFix], speed_mps: float) -> Result:
    """A drive of as long, with those fixes and a key frame each tenth of a second."""
    track, back_end = FixTrack(), LoopBackEnd(NO_SEARCH, None)
    first_ns = found[0].stamp_ns - 10**8 if found else 0
    frames = []
    covariance = np.diag([1e-6, 1e-6, 1e-8])
    for k in range(50):
        stamp_ns, pose = first_ns + k * 10**8, SE2(0.1 * k * speed_mps, 0.0, 0.0)
        frames.append(key_frame(stamp_ns, pose, covariance=covariance))
        track.add_scan(stamp_ns, pose, k)
    verdicts = {track.add_fix(fix, (0.0, 0.0)) for fix in found}
    assert verdicts <= {"fixes_taken"}
    back_end.work(Batch(frames, fixes=track.take()))
    return back_end.work(Batch([], is_last=True))


@pytest.mark.parametrize("speed_mps", [0.0, 12.0])
def test_fixes_of_a_unit_that_stood_move_no_map(shared: Path, speed_mps):
    """Neither that of a stationary vehicle, nor of one that drove 59 m: they contradict it."""
    result, bare = ended(captured(shared), speed_mps), ended([], speed_mps)
    assert result.geo is None
    assert [c.pose_map_base for c in result.all] == [c.pose_map_base for c in bare.all]
