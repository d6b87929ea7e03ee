import math
import re
from collections import Counter
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.link import LinkHealth
from service.encoding import ERROR, OK, STALE, WARNING, Status, decode_diagnostics
from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, REASON_PLACES, Reason
from service.runtime.health import MAX_BEHIND_S, GnssHealth, HealthReport, SensorHealth
from service.runtime.mapper_messages import Mapped
from service.runtime.metrics import LatencyHistogram

S = 1_000_000_000
FEW = Reason("off_map", "few beams agree")
WELL = Mapped(1, 1, 1, "ok", NO_REASON, 0.9, 1, ())
REFERENCE = GeoReference(
    LocalFrame(60.1, 24.5, 51.0), SE2(0.0, 0.0, math.radians(30.0)), 0.84, math.radians(0.31), 62
)


def streaming(frames: int = 100, last_frame_ns: int = 10 * S, delay_ns: int = 20_000_000) -> LinkHealth:
    return LinkHealth(
        "front",
        state="streaming",
        status="measuring",
        frames=frames,
        last_frame_ns=last_frame_ns,
        delay_ns=delay_ns,
    )


# What a person reads: who, measured, expected, what to do.
NAMES_ALL = re.compile(r"\bfront\b.*\(expected [^)]+\).*[;,?.] .*(check|run|start|[Rr]esume|\?)")


class Report(HealthReport):
    """A report whose parts the test can change."""

    def __init__(self, links: dict[str, LinkHealth], **parts: Any) -> None:
        super().__init__(links, **parts)
        self.parts = SimpleNamespace(**parts)


def report(*links: LinkHealth) -> Report:
    """A report on parts that only have what it looks at."""
    outputs = SimpleNamespace(
        graph_fault="",
        graph_behind_s=0.0,
        is_localizing=False,
        counters={"scans": 90, "scans_dropped_late": 2, "samples_dropped_late": 1},
        states=Counter(ok=90),
        unusable=Counter(),
        unusable_scans=0,
        scan_cpu=LatencyHistogram(),
        lasers=("front",),
        last=None,
        last_ns=11 * S,
        geo_reference=None,
        passed_over=Counter(),
        overload=lambda: "",
        restarts=1,
        restart_reason="ended",
        time_warnings=(),
    )
    sinks = SimpleNamespace(
        health=lambda: [Status("zenoh", OK, "ok", {}), Status("recording", WARNING, "stopped", {})],
        status_words=lambda: ["recording: stopped"],
    )
    return Report(
        {link.name: link for link in links},
        intake=SimpleNamespace(paused=False),
        link=SimpleNamespace(waiting=3, pid=123, silent_s=0.1),
        outputs=outputs,
        sinks=sinks,
        latency=LatencyHistogram(),
        dispatcher=SimpleNamespace(counts=lambda: Counter(mark=2, refused=1)),
        mapping=lambda: SimpleNamespace(profile="corridor", mode="mapping"),
    )


def is_explained(facts: Status) -> bool:
    """Whether the manual explains why it is not ok."""
    is_own = facts.name in ("mapping", "clock") or facts.name.startswith("sensor/")
    return not is_own or facts.level == OK or facts.values["reason_id"] in REASON_PLACES


def status(made: HealthReport, name: str, now_ns: int = 11 * S) -> Any:
    made.update(now_ns, 0)
    assert all(map(is_explained, made.statuses))
    return next(status for status in made.statuses if status.name == name)


@pytest.mark.parametrize(
    ("link", "level", "words"),
    [
        (streaming(), OK, "measuring"),
        (LinkHealth("front"), WARNING, "front: connecting, no frame yet"),
        (LinkHealth("front", state="starting", status="logging in"), WARNING, "front: logging in, "),
        (
            LinkHealth("front", state="down", last_error="cable out; reconnecting in 1 s"),
            ERROR,
            "front: cable out",
        ),
        (streaming(last_frame_ns=7 * S), STALE, "front: no frame for 4.0 s"),
        (streaming(delay_ns=1_030_000_000), WARNING, "front: frames arrive 1.0 s after they were measured"),
        (streaming(delay_ns=60_000_000), OK, "measuring"),
    ],
)
def test_a_sensor_says_in_words_how_it_is(link: LinkHealth, level: int, words: str):
    facts = SensorHealth(link).status(dropped=0, unusable=0, now_ns=11 * S)
    assert facts.level == level
    assert facts.message.startswith(words)
    assert level == OK or NAMES_ALL.search(facts.message)
    assert is_explained(facts)


def test_rates_drops_offset_counters_and_identity_are_reported():
    link = streaming()
    sensor = SensorHealth(link)
    sensor.status(0, 0, 10 * S)
    link.frames, link.bytes_read, link.last_frame_ns = 150, 80_000, 11 * S
    link.clock_offset_ns, link.clock_sigma_ns = 1_500_000, 40_000
    link.counters, link.identity = Counter(resync=2), {"serial": "123"}
    values = sensor.status(dropped=3, unusable=1, now_ns=11 * S).values
    assert (values["rate_hz"], values["kilobytes_per_s"]) == ("50.0", "80.0")
    assert (values["dropped"], values["unusable"], values["clock_offset_ms"]) == ("3", "1", "1.500")
    assert (values["clock_sigma_ms"], values["delay_ms"]) == ("0.040", "20.0")
    assert values["device_clock_s"] == "11"
    assert (values["count.resync"], values["identity.serial"]) == ("2", "123")
    assert sensor.mean_rate_hz == 50.0


@pytest.mark.parametrize(("state", "level"), [("ok", OK), ("degraded", WARNING), ("lost", ERROR)])
def test_the_pose_s_state_is_the_mapping_s_health(state: Any, level: int):
    made = report(streaming())
    assert status(made, "mapping").message.startswith("no scan of front mapped yet (expected within 5 s): ")
    assert NAMES_ALL.search(status(made, "mapping").message)
    assert status(made, "mapping").values["lasers"] == "front"
    made.parts.outputs.lasers = ()
    made.update(0, 0)
    assert status(made, "mapping").message.startswith("no laser is mapped (expected one at least)")
    reason = NO_REASON if state == "ok" else FEW
    made.parts.outputs.last = Mapped(1, 1, 1, state, reason, 0.8, 1, ())
    facts = status(made, "mapping")
    assert (facts.level, facts.message) == (level, reason or "ok")
    assert facts.values["reason_id"] == reason.id
    assert (facts.values["inlier_ratio"], facts.values["mode"]) == ("0.800", "mapping")
    made.parts.outputs.is_localizing = True
    assert status(made, "mapping").values["mode"] == "localization"
    assert made.line.startswith(f"mapping {state}, 1/1 sensors, ")


def test_without_a_first_pose_devices_may_log_in_for_some_seconds_then_it_is_an_error():
    made = report(LinkHealth("front", state="starting"))
    made.parts.outputs.last_ns = 0
    assert [status(made, "mapping", s * S).level for s in (1, 6, 7, 60)] == [WARNING, WARNING, ERROR, ERROR]
    assert made.mapping_state[0] == "waiting"
    made.parts.outputs.last_ns = 60 * S  # then the map was reset
    assert [status(made, "mapping", s * S).level for s in (61, 66)] == [WARNING, ERROR]


def test_a_stepped_wall_clock_is_reported():
    made = report(streaming())
    made.update(11 * S, -3_600 * S)
    facts = next(status for status in made.statuses if status.name == "clock")
    assert facts.level == WARNING
    assert "stepped by -3600.000 s" in facts.message


def test_a_mapping_that_goes_to_and_fro_is_reported_at_most_each_ten_seconds():
    made = report(streaming())
    made.parts.outputs.last = WELL
    facts = []
    for second in range(11, 61):
        made.parts.outputs.last_ns = second * S
        made.parts.outputs.overload = lambda is_so=second % 2: (
            "12 scans in 3.0 s were not mapped" if is_so else ""
        )
        made.update(second * S, 0)
        facts.append(made.take_mapping_change())
    seconds = [k for k, change in enumerate(facts) if change is not None]
    assert len(seconds) > 2
    assert min(np.diff(seconds)) >= 10
    states = [change[0] for change in facts if change is not None]
    assert all(before != after for before, after in pairwise(states))


def test_the_message_holds_all_of_it():
    made = report(streaming())
    made.update(11 * S, 0)
    message = made.message(1)
    assert message.channel == "diagnostics"
    assert [status.name for status in decode_diagnostics(message.payload)] == [
        "sensor/front",
        "mapping",
        "timing",
        "zenoh",
        "recording",
        "clock",
        "commands",
    ]


def test_a_pause_is_a_warning_until_it_ends():
    made = report(streaming())
    made.parts.intake.paused = True
    facts = status(made, "mapping")
    assert (facts.level, facts.values["state"]) == (WARNING, "paused")
    assert made.line.startswith("mapping paused, 1/1 sensors, ")


def test_times_that_cannot_be_are_a_warning_of_their_own():
    made = report(streaming())
    assert status(made, "timing").level == OK
    made.parts.outputs.time_warnings = (
        "/base/odom: its clock was set",
        "/front/scan: 9 of 89 messages are dropped",
    )
    facts = status(made, "timing")
    assert (facts.level, facts.values["warnings"]) == (WARNING, "2")
    assert facts.message == "/base/odom: its clock was set; /front/scan: 9 of 89 messages are dropped"


def test_a_graph_that_does_no_work_is_a_warning():
    made = report(streaming())
    made.parts.outputs.last = WELL
    made.parts.outputs.graph_fault = "the process died"
    facts = status(made, "mapping")
    assert facts.level == WARNING
    assert facts.message.startswith(
        "no loops are closed (expected where a place is seen again): the process died; "
    )


def test_a_back_end_that_is_far_behind_is_a_warning():
    made = report(streaming())
    made.parts.outputs.last = WELL
    made.parts.outputs.graph_behind_s = MAX_BEHIND_S
    assert status(made, "mapping").level == OK
    made.parts.outputs.graph_behind_s = 488.25
    facts = status(made, "mapping")
    assert (facts.level, facts.values["reason_id"]) == (WARNING, "graph_behind")
    assert facts.values["graph_behind_s"] == "488.2"
    assert facts.message.startswith("loops are closed 488 s late (expected within 30 s); ")


def test_a_mapper_that_is_restarted_again_and_again_is_a_warning_for_a_minute():
    made = report(streaming())
    outputs = made.parts.outputs
    outputs.last = WELL
    outputs.restart_reason = "said nothing for 10 s while 7 items waited"

    def reported_at(seconds: int, restarts: int) -> tuple[int, str]:
        outputs.restarts, outputs.last_ns = restarts, seconds * S
        facts = status(made, "mapping", seconds * S)
        return facts.level, facts.message

    assert reported_at(11, 1) == (OK, "ok")
    level, words = reported_at(20, 3)
    assert level == WARNING
    assert words.startswith(
        "the mapper was restarted 3 times in the last minute (expected at most 1); at the last time "
        "its process"
    )
    assert "process said nothing for 10 s while 7 items waited" in words
    assert reported_at(79, 3)[0] == WARNING
    assert reported_at(81, 3) == (OK, "ok")


@pytest.mark.parametrize(
    ("pid", "silent_s", "overload", "words"),
    [
        (123, 0.8, "", "the mapper has not answered for 0.8 s while 3 items wait for it"),
        (0, 0.8, "", "the mapper's process has ended and no stand-by has taken over yet"),
        (123, 0.1, "", "the mapper maps none of them"),
        (123, 0.1, "50 scans in 3.0 s", "50 scans in 3.0 s"),
    ],
)
def test_scans_that_come_and_give_no_pose_are_not_the_sensor_s_fault(
    pid: int, silent_s: float, overload: str, words: str
):
    link = streaming()
    made = report(link)
    made.parts.link.pid, made.parts.link.silent_s = pid, silent_s
    made.parts.outputs.overload = lambda: overload
    status(made, "mapping", 10 * S)
    link.frames, link.last_frame_ns = 150, 11 * S
    facts = status(made, "mapping")
    unmapped = (
        f"no scan of front mapped yet (expected within 5 s): front sends 50 scans/s, but {words}; if it stays"
    )
    assert facts.message.startswith(unmapped)
    made.parts.outputs.last, made.parts.outputs.last_ns = WELL, 11 * S - 800_000_000
    link.frames = 200
    facts = status(made, "mapping", 11 * S)
    assert facts.message.startswith("no pose for 0.8 s (expected one each 0.5 s at least): front sends ")
    assert f" scans/s, but {words}; if it stays so, start the service again" in facts.message


def test_the_lasers_without_scans_are_named():
    made = report(streaming(last_frame_ns=7 * S), LinkHealth("rear", state="down"))
    made.parts.outputs.lasers = ("front", "rear")
    made.parts.outputs.last, made.parts.outputs.last_ns = WELL, 7 * S
    assert "no scan of front or rear comes; the status sensor/front or sensor/rear says" in (
        status(made, "mapping").message
    )


def test_the_state_is_reported_before_and_after_the_map_is_referenced():
    health = GnssHealth()
    before = health.status({"fixes_taken": 3}, None, 0)
    assert before.message.startswith("not referenced yet")
    assert before.values["referenced"] == "false"
    after = health.status({"fixes_taken": 9}, REFERENCE, 1)
    assert (after.level, after.message) == (0, "referenced to 0.8 m and 0.3 deg by 62 fixes")
    assert after.values["yaw_sigma_deg"] == "0.31"
    assert after.values["map_yaw_enu_deg"] == "30.00"


def test_a_fault_of_the_map_before_is_forgotten_when_another_is_loaded():
    """Its graph counts again, and does not know the counter yet."""
    health = GnssHealth()
    health.status({"fixes_taken": 3, "fixes_out_of_order": 5}, REFERENCE, 0)
    loaded = health.status({"fixes_taken": 1}, None, 1)
    assert (loaded.level, "stamps do not rise" in loaded.message) == (0, False)
