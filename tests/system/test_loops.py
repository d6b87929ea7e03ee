"""Loops that close while the mapping goes on: in another process, and in the replay to the last bit."""

import json
import math
import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.config import parse_config
from service.encoding import Message, decode_event, encode_pose, encode_tf_static
from service.geometry.se2 import SE2
from service.mapper.background import BackEnd, WorkLostError
from service.mapper.profiles import build_mapper
from service.mapper.steering import SteeredMapper
from service.mapstore.tiles import TileStore
from service.offline.replay import Replay, ReplayOptions, replay
from service.recording.mcap_reader import Recording
from service.recording.mcap_recorder import McapRecorder
from service.runtime.back_end import BackEndProcess, ProcessPending, ProcessWorker
from service.runtime.host_time import HostTime
from service.runtime.mapping import MappingLoop
from service.runtime.queues import Command, FrameQueue
from tests.service.mapper.drives import cast
from tests.service.mapper.graph.rings import BEAMS, FIRST_RAD, RING, STEP_RAD, round_the_ring

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
    believed, before = SE2(), round_the_ring(0.0)
    for k in range(scans):
        pose = round_the_ring(k * SPACING_M)
        step, before = before.inverse() @ pose, pose
        believed = believed @ SE2(step.x_m, step.y_m, step.theta_rad * 1.02)
        stamp_ns = 10**9 + k * PERIOD_NS
        wheels = (believed.x_m, believed.y_m, believed.theta_rad)
        yield OdometrySample("base", stamp_ns, stamp_ns, *wheels, (1.5, 0.0, 0.0), (0.0,) * 9)
        ways = np.column_stack((np.cos(angle + pose.theta_rad), np.sin(angle + pose.theta_rad)))
        range_m = cast(RING, np.tile([pose.x_m, pose.y_m], (BEAMS, 1)), ways)
        range_m = (range_m + 0.005 * noise.standard_normal(BEAMS)).astype(np.float32)
        times = (stamp_ns, stamp_ns + 1, 0, PERIOD_NS)
        yield LaserScan("front", *times, FIRST_RAD, STEP_RAD, 0.05, 30.0, range_m, NO_INTENSITY)


class UnevenQueue(FrameQueue):
    """Now and then a frame comes only when the back end is done, so that answers come at odd places."""

    def __init__(self) -> None:
        super().__init__(scan_capacity=SCANS)
        self.out: list[ProcessPending] = []
        self._taken = 0

    def get(self, timeout_s: float) -> Frame | Command | None:
        self._taken += 1
        if self._taken % 37 == 0 and self.out:
            with suppress(WorkLostError):
                self.out[-1].result()
        return super().get(timeout_s)


class Watched:
    """A worker whose pieces of work a queue knows."""

    def __init__(self, worker: ProcessWorker, queue: UnevenQueue) -> None:
        self._worker, self._queue = worker, queue
        self.close = worker.close

    def submit(self, batch: object) -> ProcessPending:
        self._queue.out.append(self._worker.submit(batch))
        return self._queue.out[-1]


class Live:
    """The mapping loop of a service over the drive, with its recorder and its back end's process."""

    def __init__(self, folder: Path, scans: int, kill_at: int | None = None) -> None:
        self._queue = UnevenQueue()
        self.process = BackEndProcess(patience_s=60.0)
        recorder = McapRecorder(folder, "v", keep_free_bytes=0, metadata={"config": {"yaml": CONFIG}})
        recorder.start()
        recorder.put(encode_tf_static(MOUNTINGS, 1, 1))
        for frame in frames(scans):
            self._queue.put(frame)
        self._queue.close()
        self.poses: list[bytes] = []
        self._kill_at = kill_at
        mapping = parse_config(CONFIG, "config").mapping
        self.mapper = SteeredMapper(
            lambda: build_mapper(mapping, MOUNTINGS, new_worker=self._worker), "front", None
        )
        self.loop = MappingLoop(
            self._queue, self.mapper, TileStore(), HostTime(0), self._publish, recorder.put, lambda *_: None
        )
        self.process.start()
        try:
            self.loop.run()
        finally:
            (self.session,) = recorder.finish()
            self.process.stop()

    def _worker(self, back_end: BackEnd) -> Watched:
        return Watched(self.process.new_worker(back_end), self._queue)

    def _publish(self, message: Message, arrived_ns: int | None) -> None:
        if message.channel == "pose":
            self.poses.append(message.payload)
            if len(self.poses) == self._kill_at:
                assert self.process.pid is not None
                os.kill(self.process.pid, signal.SIGKILL)
                self._queue.out.clear()


def events(session: Path) -> list[str]:
    return [json.loads(decode_event(m.payload))["event"] for m in Recording([session]).messages(["/events"])]


def jumps(done: Replay) -> int:
    moved = [output.pose_map_odom for output in done.outputs]
    return sum(a != b for a, b in pairwise(moved))


def test_a_drive_whose_loops_closed_on_the_way_replays_to_the_last_bit(tmp_path: Path):
    live = Live(tmp_path, SCANS)
    assert live.loop.counters["loop_closures"] >= 3
    assert live.loop.graph_trouble == ""
    assert events(live.session).count("take_in") > 20
    done = replay([live.session], ReplayOptions())
    assert [encode_pose(output, 0).payload for output in done.outputs] == live.poses
    assert jumps(done) >= 1  # a correction came in on the way
    odom = [output.pose_odom_base for output in done.outputs]
    steps_m = [math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairwise(odom)]
    assert max(steps_m) < 2.0 * SPACING_M
    assert done.summary["loop_closures"] == live.loop.counters["loop_closures"]
    truth = [round_the_ring(k * SPACING_M) for k in range(SCANS)]
    off = [t.inverse() @ p for t, p in zip(truth, done.poses_map_base, strict=True)]
    assert max(math.hypot(e.x_m, e.y_m) for e in off) < 0.03


def test_when_the_back_end_dies_mapping_goes_on_and_the_replay_is_still_the_same(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    live = Live(tmp_path, 100, kill_at=50)
    assert len(live.poses) == 100
    assert "died" in live.loop.graph_trouble
    assert live.loop.counters["graph_work_lost"] == 1
    assert events(live.session).count("graph_lost") == 1
    assert "mapping goes on without closing loops" in caplog.text
    done = replay([live.session], ReplayOptions())
    assert [encode_pose(output, 0).payload for output in done.outputs] == live.poses
