"""What switch_profile does to real parts: see machine.Machine."""

import os
import subprocess
import sys
import threading
from multiprocessing import active_children
from pathlib import Path

import pytest

from service.encoding import encode_event
from service.encoding.steps import decode_step
from service.mapper.mapping_session import SwitchProfile
from service.mapper.profiles import mapping_config
from service.mapstore.files import load_map
from service.publishing.commands import CommandError
from service.runtime import profile_switch
from service.runtime.profile_switch import PresentMapping, compile_kernels
from tests.in_background import started
from tests.service.recording.sessions import events_of
from tests.service.runtime.machine import Machine


def test_the_map_before_is_saved_and_another_profile_begins_a_new_one(machine: Machine, tmp_path: Path):
    machine.scan(3)
    facts = machine.ask("switch_profile", profile="imle")
    assert facts == {
        "ok": True,
        "profile": "imle",
        "folder": str(tmp_path / "map_2"),
        "folder_before": str(tmp_path / "map"),
    }
    assert [section["profile"] for section in (*machine.compiled, *machine.profiles)] == ["imle", "imle"]
    assert machine.present.profile == "imle"
    assert machine.link.loop.mapper.counters["map_resets"] == 1
    machine.scan(2)
    assert machine.ask("save_map")["folder"] == str(tmp_path / "map_2")
    assert [load_map(tmp_path / name).about["profile"] for name in ("map", "map_2")] == ["corridor", "imle"]
    (session,) = machine.stop()
    (event,) = [event for event in events_of(session) if event["event"] == "switch_profile"]
    assert event == {"event": "switch_profile", "profile": "imle"}


def test_an_event_of_a_switch_is_a_step_of_a_replay():
    message = encode_event('{"event": "switch_profile", "profile": "imle", "id": "7"}', 5, 5)
    assert decode_step(message.payload, 5) == SwitchProfile("imle", 5)
    assert decode_step(encode_event('{"event": "switch_profile"}', 5, 5).payload, 5) is None


def test_settings_of_the_config_come_back_with_its_profile(machine: Machine):
    section = {"cell_m": 0.1, "outline_m": [(0, 0), (1, 0), (0, 1)]}
    configured = machine.present.configured = mapping_config({**section, "settings": {"motion_model": {}}})
    machine.scan()
    assert machine.ask("switch_profile", profile="contour_lm")["ok"]
    kept = mapping_config({"profile": "contour_lm", **section})
    assert machine.present.config.model_dump() == kept.model_dump()
    assert machine.ask("switch_profile", profile="corridor")["ok"]
    assert machine.present.config is configured


def test_what_cannot_be_switched_to_is_refused_in_words(machine: Machine, tmp_path: Path):
    machine.scan()
    assert machine.ask("switch_profile", profile="imlee")["error"] == (
        'imlee is no profile; did you mean "imle"?'
    )
    assert machine.ask("switch_profile", profile="corridor")["error"].startswith(
        "corridor is the profile that maps now; reset_map"
    )
    assert "'profile' is missing" in machine.ask("switch_profile")["error"]
    machine.compiler_fault = "the kernels of imle could not be compiled"
    assert machine.ask("switch_profile", profile="imle")["error"] == machine.compiler_fault
    machine.compiler_fault = ""
    (tmp_path / "map").write_text("in the way")
    refused = machine.ask("switch_profile", profile="imle")["error"]
    assert refused.startswith("the profile stays, for the map cannot be saved: cannot save the map to")
    (tmp_path / "map").unlink()
    assert (machine.present.profile, machine.profiles, machine.tiles.number) == ("corridor", [], 1)
    (session,) = machine.stop()
    assert "switch_profile" not in [event["event"] for event in events_of(session)]


def test_a_session_that_is_localised_keeps_its_profile():
    present = PresentMapping(mapping_config({"mode": "localization"}))
    with pytest.raises(CommandError, match="only the profile corridor does that"):
        present.with_profile("imle")


def test_a_switch_in_progress_is_waited_for(machine: Machine):
    began, go_on = threading.Event(), threading.Event()

    def compile_slowly() -> None:
        began.set()
        assert go_on.wait(20.0)

    machine.compiler = compile_slowly
    machine.scan()
    asking = started(lambda: machine.ask("switch_profile", profile="imle"))
    assert began.wait(20.0)
    machine.scan()  # mapped meanwhile
    assert machine.outputs.states["ok"] == 2
    assert "another switch is in progress" in machine.ask("switch_profile", profile="contour_lm")["error"]
    go_on.set()
    assert asking.result(20.0)["ok"]
    assert machine.ask("switch_profile", profile="contour_lm")["ok"]


def test_a_recording_begun_after_a_switch_says_so_first(machine: Machine):
    machine.scan()
    machine.ask("stop_recording")
    machine.ask("switch_profile", profile="imle")
    machine.ask("start_recording")
    machine.scan()
    _, second = machine.stop()
    assert [(event["event"], event.get("profile")) for event in events_of(second)] == [
        ("start_recording", None),
        ("switch_profile", "imle"),
    ]


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_a_profile_whose_kernels_were_never_compiled_is_made_ready(tmp_path: Path):
    """By a program without a cache, as after an update of the package."""
    program = "from service.runtime import profile_switch\nprofile_switch.NICENESS = 0\n"  # in the child, too
    program += "if __name__ == '__main__':\n    profile_switch.compile_kernels({'profile': 'imle'})\n"
    (tmp_path / "program.py").write_text(program)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": os.getcwd()}
    subprocess.run([sys.executable, tmp_path / "program.py"], env=environment, check=True)
    assert list((tmp_path / "cache").rglob("*.nbc"))


def test_kernels_that_do_not_compile_are_reported():
    with pytest.raises(CommandError, match=r"the kernels of unknown could not be compiled.*code 1"):
        compile_kernels({"profile": "unknown"})


def test_a_compilation_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(profile_switch, "COMPILE_TIMEOUT_S", 0.0)
    with pytest.raises(
        CommandError, match=r"kernels of imle were not compiled within 0 s; the profile stays"
    ):
        compile_kernels({"profile": "imle"})
    assert not active_children()
