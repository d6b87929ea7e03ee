"""Loops that close while the mapping goes on: in another process, and in the replay to the last bit."""

import math
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.config import parse_config
from service.encoding import LogClock, Message, encode_pose, encode_tf_static
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper
from service.mapstore.tiles import TileStore
from service.offline.replay.replay import Replay, ReplayOptions, replay
from service.recording.mcap_recorder import McapRecorder
from service.runtime.back_end import BackEndProcess
from service.runtime.channel import wait_for
from service.runtime.host_time import HostTime
from service.runtime.intake import Intake
from service.runtime.mapping_outputs import MappingOutputs
from tests.service.mapper.drives import cast
from tests.service.mapper.graph.loops.rings import BEAMS, FIRST_RAD, RING, STEP_RAD, round_the_ring
from tests.service.recording.sessions import events_of
from tests.service.runtime.inline_link import InlineLink

CONFIG = """\
vehicle: v
sensors: {front: {type: sick_lms100, host: a}}
recording: {directory: s}
map: {directory: m}
mapping: {settings: {graph: {solve_at_rad: 0.000001}}}
"""
SCANS, SPACING_M, PERIOD_NS = 420, 0.15, 100_000_000
MOUNTINGS = {"front": SE2()}


def frames(scans: int) -> Iterator[Frame]:
    """1.4 rounds at 1.5 m/s; wheels that turn a little too far."""
    noise = np.random.default_rng(1)
    angle = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    odometry, before = SE2(), round_the_ring(0.0)
    for k in range(scans):
        pose = round_the_ring(k * SPACING_M)
        step, before = before.inverse() @ pose, pose
        odometry = odometry @ SE2(step.x_m, step.y_m, step.theta_rad * 1.02)
        stamp_ns = 10**9 + k * PERIOD_NS
        wheels = (odometry.x_m, odometry.y_m, odometry.theta_rad)
        yield OdometrySample("base", stamp_ns, stamp_ns, *wheels, (1.5, 0.0, 0.0), (0.0,) * 9)
        directions = np.column_stack((np.cos(angle + pose.theta_rad), np.sin(angle + pose.theta_rad)))
        range_m = cast(RING, np.tile([pose.x_m, pose.y_m], (BEAMS, 1)), directions)
        range_m = (range_m + 0.005 * noise.standard_normal(BEAMS)).astype(np.float32)
        times = (stamp_ns, stamp_ns + 1, 0, PERIOD_NS)
        yield LaserScan("front", *times, FIRST_RAD, STEP_RAD, 0.05, 30.0, range_m, NO_INTENSITY)


class Live:
    """Intake and mapper of a service over the drive, with its recorder and its back end's process.

    Some frames arrive only when the back end is done, so that its answers arrive at varying times.
    """

    def __init__(self, folder: Path, scans: int) -> None:
        self.process = BackEndProcess(patience_s=60.0)
        recorder = McapRecorder(folder, "v", keep_free_bytes=0, metadata={"config": {"yaml": CONFIG}})
        recorder.start()
        self._recorder = recorder
        recorder.put(encode_tf_static(MOUNTINGS, 1, 1))
        self.poses: list[bytes] = []
        mapping = parse_config(CONFIG, "config").mapping
        mapper = MappingSession(
            lambda: build_mapper(mapping, MOUNTINGS, new_worker=self.process.new_worker), ["front"], None
        )
        log_clock = LogClock()
        self.outputs = MappingOutputs(
            ["front"], TileStore(), self._put, lambda *_: None, lambda: log_clock.next_ns(10**9)
        )
        link = InlineLink(mapper, self.outputs)
        intake = Intake(link, HostTime(0), recorder.put)  # type: ignore[arg-type]
        try:
            for k, frame in enumerate(frames(scans)):
                if k % 37 == 36:
                    self._let_the_back_end_finish()
                intake.put(frame)
            link.finish()
        finally:
            (self.session,) = recorder.finish()
            self.process.stop()

    def _let_the_back_end_finish(self) -> None:
        deadline_s = time.monotonic() + 60.0
        while self.process.behind_s and time.monotonic() < deadline_s:
            wait_for(self.process.ends, 1.0)
            self.process.look()

    def _put(self, message: Message, arrived_ns: int | None) -> None:
        self._recorder.put(message)
        if message.channel == "pose":
            self.poses.append(message.payload)


def jumps(done: Replay) -> int:
    moved = [output.pose_map_odom for output in done.outputs]
    return sum(a != b for a, b in pairwise(moved))


def test_a_drive_whose_loops_closed_while_driving_replays_to_the_last_bit(tmp_path: Path):
    live = Live(tmp_path, SCANS)
    assert live.outputs.counters["loop_closures"] >= 3
    assert live.outputs.graph_fault == ""
    assert [event["event"] for event in events_of(live.session)].count("apply_result") > 20
    done = replay([live.session], ReplayOptions())
    assert [encode_pose(output, 0).payload for output in done.outputs] == live.poses
    assert jumps(done) >= 1  # a correction arrived during the drive
    odom = [output.pose_odom_base for output in done.outputs]
    steps_m = [math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairwise(odom)]
    assert max(steps_m) < 2.0 * SPACING_M
    assert done.summary["loop_closures"] == live.outputs.counters["loop_closures"]
    truth = [round_the_ring(k * SPACING_M) for k in range(SCANS)]
    off = [t.inverse() @ p for t, p in zip(truth, done.poses_map_base, strict=True)]
    assert max(math.hypot(e.x_m, e.y_m) for e in off) < 0.03
