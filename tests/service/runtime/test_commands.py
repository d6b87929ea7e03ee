"""What commands do to real parts: intake, mapping loop, map saver and recorder."""

import json
import time
from pathlib import Path
from typing import Any

import pytest

from service.encoding import STRING, Message, encode_event
from service.encoding.steps import decode_step
from service.errors import StorageError
from service.mapper.mapping_session import GraphRequest, LoadMap
from service.mapstore.files import load_map, save_map
from service.mapstore.in_use import InUse
from service.recording.mcap_reader import Recording
from service.sinks.map_saver import MAX_ASKED
from tests.in_background import started
from tests.service.mapstore.tile_makers import graph_of
from tests.service.recording.sessions import events_of
from tests.service.runtime.machine import Machine, channels
from tests.service.sinks.test_map_saver import tile
from tests.waiting import wait_until


def test_the_known_verbs(machine: Machine):
    facts = machine.ask("fly")
    assert facts == {
        "ok": False,
        "error": "there is no command 'fly'; known: add_landmark_pair, checkpoint, edit_map, load_map, mark, "
        "optimize, pause, remove_landmark_pair, reset_map, resume, save_map, set_mode, set_pose, "
        "start_recording, stop_recording, switch_profile, undo",
    }


def test_a_mark_is_refused_while_nothing_is_recorded(machine: Machine):
    machine.scan()
    assert machine.ask("mark", text="kept")["ok"]
    machine.ask("stop_recording")
    assert machine.ask("mark", text="lost") == {
        "ok": False,
        "error": "the mark would be lost: no session is being recorded; start_recording begins one",
    }
    machine.ask("start_recording")
    assert machine.ask("mark", text="kept too")["ok"]
    marks = [e["text"] for session in machine.stop() for e in events_of(session) if e["event"] == "mark"]
    assert marks == ["kept", "kept too"]


def test_a_pause_and_a_mark_stand_in_the_recording_where_they_came(machine: Machine):
    machine.scan()
    assert machine.ask("pause", id="a") == {"ok": True, "id": "a", "changed": True}
    assert machine.ask("pause") == {"ok": True, "changed": False}
    assert machine.intake.paused
    machine.scan()
    marked = machine.ask("mark", text="der T\u00fcrrahmen, \U0001f6aa \u0000")
    assert machine.ask("resume") == {"ok": True, "changed": True}
    machine.scan()
    (session,) = machine.stop()
    assert channels(session) == [
        "front/scan", "pose", "events", "events", "front/scan", "events", "events", "front/scan", "pose",
    ]  # fmt: skip
    assert events_of(session) == [
        {"event": "pause", "id": "a"},
        {"event": "pause"},
        {"event": "mark", "text": "der T\u00fcrrahmen, \U0001f6aa \u0000"},
        {"event": "resume"},
    ]
    assert marked["log_ns"] in {m.log_ns for m in Recording([session]).messages(["/events"])}


# D13
def test_requests_to_the_graph_stand_in_the_recording_and_are_answered_by_it(machine: Machine):
    pair = {"first": {"submap": 0, "x_m": 1.0, "y_m": 2.0}, "second": {"submap": 3, "x_m": 1.5, "y_m": 2.0}}
    machine.scan()
    facts = machine.ask("add_landmark_pair", **pair)
    assert not facts["ok"]
    assert "this profile has no graph" in facts["error"]
    assert "'second' is missing" in machine.ask("add_landmark_pair", first=pair["first"])["error"]
    for verb, request in (("optimize", {}), ("undo", {}), ("remove_landmark_pair", {"pair": 1})):
        assert "this profile has no graph" in machine.ask(verb, **request)["error"]
    (session,) = machine.stop()
    assert events_of(session) == [
        {"event": "add_landmark_pair", **pair},
        {"event": "optimize"},
        {"event": "undo"},
        {"event": "remove_landmark_pair", "pair": 1},
    ]
    steps = [decode_step(m.payload, m.log_ns) for m in Recording([session]).messages(["/events"])]
    assert [(step.name, step.payload) for step in steps if isinstance(step, GraphRequest)] == [
        ("add_landmark_pair", pair),
        ("optimize", {}),
        ("undo", {}),
        ("remove_landmark_pair", {"pair": 1}),
    ]


def test_save_map_answers_when_every_scan_before_it_is_on_disk(machine: Machine, tmp_path: Path):
    assert "there is no map yet" in machine.ask("save_map")["error"]
    machine.scan(5)
    facts = machine.ask("save_map")
    assert facts == {"ok": True, "folder": str(tmp_path / "map"), "version": 1, "map_version": 5}
    stored = load_map(tmp_path / "map")
    assert (stored.number, [t.version for t in stored.tiles]) == (1, [5])
    assert machine.ask("save_map") == facts  # nothing new
    machine.scan()
    assert machine.ask("save_map")["version"] == 2


def test_a_map_is_saved_with_its_graph_as_it_is_then(machine: Machine, tmp_path: Path):
    machine.checkpoints_in(tmp_path / "graphs")
    machine.scan()
    assert machine.ask("save_map")["ok"]
    assert len(load_map(tmp_path / "map").graph) == 5


def test_a_map_that_cannot_be_saved_is_reported(machine: Machine, tmp_path: Path):
    (tmp_path / "map").write_text("in the way")
    machine.scan()
    assert "cannot save the map to" in machine.ask("save_map")["error"]
    facts = machine.ask("reset_map")
    assert facts["error"].startswith("the map is reset, but the map before is not saved yet: cannot save")
    (tmp_path / "map").unlink()


def test_a_map_is_saved_under_a_name_besides(machine: Machine, tmp_path: Path):
    assert "there is no map yet" in machine.ask("save_map", name="office")["error"]
    machine.scan(2)
    facts = machine.ask("save_map", name="office")
    assert (facts["folder"], facts["version"]) == (str(tmp_path / "office"), 1)
    assert load_map(tmp_path / "office").tiles[0].version == load_map(tmp_path / "map").tiles[0].version
    machine.scan()
    assert machine.ask("save_map", name="office")["version"] == 2
    assert machine.ask("save_map")["folder"] == str(tmp_path / "map")
    with InUse(tmp_path / "office", "corridor map edit"):
        assert "corridor map edit uses this map" in machine.ask("save_map", name="office")["error"]
    for wrong in ("../office", ".hidden", "a/b", ""):
        assert "name" in machine.ask("save_map", name=wrong)["error"]
    assert machine.ask("load_map", map="office")["version"] == 2


def test_a_stored_map_is_loaded_and_the_one_before_is_saved(machine: Machine, tmp_path: Path):
    save_map(tmp_path / "office", [tile(1)], 1)
    save_map(tmp_path / "office", [tile(2)], 2)
    machine.scan(2)
    facts = machine.ask("load_map", map="office", version=1)
    assert facts == {
        "ok": True,
        "folder": str(tmp_path / "office"),
        "version": 1,
        "folder_before": str(tmp_path / "map"),
    }
    assert machine.prepared == [(str(tmp_path / "office"), 1)]
    assert machine.link.loop.mapper.counters["map_resets"] == 1
    assert load_map(tmp_path / "map").number == 1
    machine.scan()
    saved = machine.ask("save_map")
    assert (saved["folder"], saved["version"]) == (str(tmp_path / "office"), 3)
    machine.ask("reset_map")
    assert machine.saver.folder == tmp_path / "map_3"
    path = machine.stop()[0]
    (event,) = [event for event in events_of(path) if event["event"] == "load_map"]
    assert (event["map"], event["version"]) == (str(tmp_path / "office"), 1)
    step = decode_step(encode_event(json.dumps(event), 7, 7).payload, 7)
    assert step == LoadMap(str(tmp_path / "office"), 1, 7)


def test_a_map_that_cannot_be_begun_in_is_refused_and_the_present_one_stays(machine: Machine, tmp_path: Path):
    machine.scan(2)
    assert "no stored map" in machine.ask("load_map", map="nowhere")["error"]
    save_map(tmp_path / "office", [tile(1)], 1)
    assert "no version 7; there are 1" in machine.ask("load_map", map="office", version=7)["error"]
    machine.mapper_fault = "v000001/graph.npz: damaged"
    facts = machine.ask("load_map", map="office")
    assert facts["error"] == "the map before stays: v000001/graph.npz: damaged"
    assert machine.saver.folder == tmp_path / "map"
    assert machine.tiles.number == 1
    is_free(tmp_path / "office")
    machine.intake.close()
    machine.mapper_fault = ""
    assert machine.ask("load_map", map="office")["error"] == "the service is stopping"
    is_free(tmp_path / "office")


@pytest.mark.parametrize(
    ("verb", "request_", "why"),
    [
        ("load_map", {"map": "a\0b"}, "'map' holds a NUL"),
        ("load_map", {"map": "a" * 300}, "File name too long"),
        ("load_map", {"map": "/srv/maps/office"}, "'map' is a path; write the name of a folder"),
        ("load_map", {"map": "../office"}, "'map' is a path"),
        ("load_map", {"map": ".."}, "'map' is a path"),
        (
            "set_pose",
            {"x_m": 100_001.0, "y_m": 0.0, "theta_rad": 0.0},
            "'x_m' should be less than or equal to 100000",
        ),
        ("save_map", {"name": "../a"}, "'name' takes letters, digits, _ . and -"),
        ("set_mode", {"mode": "flying"}, "'mode' should be 'mapping' or 'localization'"),
        ("edit_map", {"who": 101 * "a", "change": {}}, "'who' should have at most 100 characters"),
        (
            "add_landmark_pair",
            {
                "first": {"submap": 0, "x_m": "1", "y_m": True},
                "second": {"submap": 1, "x_m": 0.0, "y_m": 0.0},
            },
            "'first.x_m' should be a valid number; 'first.y_m' should be a valid number",
        ),
    ],
)
def test_a_request_that_cannot_be_meant_is_refused_in_words(
    machine: Machine, verb: str, request_: dict[str, Any], why: str
):
    facts = machine.ask(verb, **request_)
    assert facts["ok"] is False
    assert why in facts["error"]


def is_free(folder: Path) -> None:
    """Raises StorageError where it is not."""
    with InUse(folder, "corridor map edit"):
        pass


def test_a_map_that_another_session_goes_on_in_is_not_loaded(machine: Machine, tmp_path: Path):
    save_map(tmp_path / "office", [tile(1)], 1)
    with InUse(tmp_path / "office", "a session of veh2"):
        assert "a session of veh2 uses this map" in machine.ask("load_map", map="office")["error"]
    assert machine.ask("load_map", map="office")["ok"] is True
    with pytest.raises(StorageError, match="a session of veh1"):
        InUse(tmp_path / "office", "another")


def test_reset_map_answers_when_the_map_before_is_on_disk(machine: Machine, tmp_path: Path):
    empty = machine.ask("reset_map")
    assert empty == {"ok": True, "folder": str(tmp_path / "map"), "folder_before": None}
    machine.scan(3)
    facts = machine.ask("reset_map")
    assert facts == {"ok": True, "folder": str(tmp_path / "map_2"), "folder_before": str(tmp_path / "map")}
    assert [t.version for t in load_map(tmp_path / "map").tiles] == [3]
    machine.scan(2)
    assert machine.ask("save_map") == {
        "ok": True, "folder": str(tmp_path / "map_2"), "version": 1, "map_version": 6,
    }  # fmt: skip
    assert machine.link.loop.mapper.counters["map_resets"] == 2


@pytest.mark.parametrize(
    ("verb", "request_of"),
    [("reset_map", {}), ("load_map", {"map": "office"}), ("switch_profile", {"profile": "contour_lm"})],
)
def test_a_map_between_two_resets_that_no_tile_was_handed_over_of_is_saved_with_its_graph(
    machine: Machine, tmp_path: Path, verb: str, request_of: dict[str, str]
):
    """Tiles are handed over some times a second: a map that ends before has a graph all the same."""
    save_map(tmp_path / "office", [tile(1)], 1, graph=graph_of(4))
    machine.checkpoints_in(tmp_path / "graphs")
    now_ns = time.monotonic_ns()
    machine.scan(3, at_ns=now_ns)
    assert machine.ask("reset_map")["ok"]
    machine.scan(2, at_ns=now_ns)
    assert machine.tiles.finest_count == 0
    assert machine.ask(verb, **request_of)["folder_before"] == str(tmp_path / "map_2")
    assert len(load_map(tmp_path / "map_2").graph) == 5


def test_recording_stops_and_starts_between_two_frames(machine: Machine):
    machine.scan(2)
    stopped = machine.ask("stop_recording")
    (first,) = [Path(path) for path in stopped["files"]]
    assert stopped["changed"]
    assert channels(first) == ["front/scan", "pose", "front/scan", "pose", "events"]
    assert events_of(first) == [{"event": "stop_recording"}]
    machine.scan(2)
    started = machine.ask("start_recording")
    assert started["changed"]
    machine.scan()
    (active,) = started["files"]
    assert machine.stop() == [first, Path(active.removesuffix(".active"))]
    second = Path(active.removesuffix(".active"))
    assert channels(second) == ["events", "front/scan", "pose"]
    assert events_of(second) == [{"event": "start_recording"}]


def test_a_recording_begun_in_a_pause_says_so_first(machine: Machine):
    machine.scan()
    machine.ask("stop_recording")
    machine.ask("pause")
    machine.ask("start_recording")
    machine.scan()
    machine.ask("resume")
    _, second = machine.stop()
    assert [event["event"] for event in events_of(second)] == ["start_recording", "pause", "resume"]


def test_a_disk_that_is_full_is_reported_to_who_wants_to_record(machine: Machine, free_bytes: list[int]):
    machine.scan()
    machine.ask("stop_recording")
    free_bytes[0] = 10
    assert "make room to record again" in machine.ask("start_recording")["error"]


def test_who_asks_while_the_service_stops_hears_so(machine: Machine):
    machine.intake.close()
    assert machine.ask("pause") == {"ok": False, "error": "the service is stopping"}


def test_no_one_is_left_waiting_when_the_mapper_does_not_answer(tmp_path: Path, free_bytes: list[int]):
    machine = Machine(tmp_path, free_bytes, is_deaf=True)
    asking = started(lambda: machine.ask("pause"))
    wait_until(lambda: machine.link.waiting)
    machine.commands.close()
    assert asking.result(10.0) == {"ok": False, "error": "the service is stopping"}


def test_events_are_ros_strings(machine: Machine):
    machine.ask("mark", text="x")
    recording = Recording(machine.stop())
    assert {type(m) for m in recording.messages(["/events"])} == {Message}
    assert [t.type for t in recording.topics if t.name == "/events"] == [STRING]


def test_what_the_disk_of_the_maps_cannot_take_any_more_is_refused_before_it_is_begun(tmp_path: Path):
    machine = Machine(tmp_path, [1 << 40])
    machine.recorder.start()  # the saver is not: nothing that it is asked for is done
    save_map(tmp_path / "office", [tile(1)], 1)
    machine.scan()
    for _ in range(MAX_ASKED):
        machine.saver.ask_to_save(lambda saved, fault: None)
    for verb, request, words in (
        ("save_map", {}, "not saved"),
        ("reset_map", {}, "the present map stays"),
        ("load_map", {"map": "office"}, "the present map stays"),
        ("switch_profile", {"profile": "imle"}, "the profile stays, for the map cannot be saved: not saved"),
    ):
        assert machine.ask(verb, **request)["error"].startswith(f"{words}: {MAX_ASKED} requests wait for")
    with InUse(tmp_path / "office", "somebody who edits it"):
        assert [event["event"] for event in events_of(*machine.stop())] == ["save_map"]
