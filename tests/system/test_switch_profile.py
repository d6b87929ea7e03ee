"""Another profile in the middle of a drive, and what a replay makes of its recordings."""

import signal
from collections.abc import Callable
from pathlib import Path

from service.encoding import decode_diagnostics, encode_pose
from service.mapstore.files import load_map
from service.offline.replay.replay import ReplayOptions, replay
from service.recording.mcap_reader import Recording
from tests.system.machine import LiveService, Subscriber


def test_a_drive_with_two_profiles(live_service: LiveService, subscribe: Callable[[str], Subscriber]):
    subscriber = subscribe(live_service.endpoint)
    subscriber.wait_for("pose", 50)
    refused = subscriber.ask("switch_profile", profile="corridor")
    assert "corridor is the profile that maps now" in refused["error"]
    switched = ask_until_done(subscriber, profile="imle")
    folders = Path(switched["folder_before"]), Path(switched["folder"])
    assert (switched["profile"], folders[1]) == ("imle", Path(f"{folders[0]}_2"))
    subscriber.wait_for("pose", 50)
    subscriber.wait_until(lambda: profile_reported(subscriber) == "imle")
    assert (
        "the profile imle cannot begin in a stored map"
        in (subscriber.ask("load_map", map=folders[0].name)["error"])
    )
    (first,) = [Path(path) for path in subscriber.ask("stop_recording")["files"]]
    (active,) = subscriber.ask("start_recording")["files"]
    subscriber.wait_for("pose", 25)
    live_service.signal(signal.SIGTERM)
    assert live_service.wait() == 0, live_service.log

    assert [load_map(folder).about["profile"] for folder in folders] == ["corridor", "imle"]
    assert load_map(folders[0]).graph is not None  # a later session can go on in it
    done = replay([first], ReplayOptions())
    recorded = [m.payload for m in Recording([first]).messages(["/pose"])]
    again = [encode_pose(output, 0).payload for output in done.outputs]
    assert len(recorded) > 90
    assert again[: len(recorded)] == recorded  # to the last bit, over the switch
    assert [facts["profile"] for facts in done.summary["profile_switches"]] == ["imle"]
    second = replay([Path(active.removesuffix(".active"))], ReplayOptions())
    assert second.summary["profile"] == "imle"  # though its config says corridor
    assert second.outputs[0].pose_map_base.x_m == 0.0


def ask_until_done(subscriber: Subscriber, **request: str) -> dict[str, str]:
    """The first switch to a profile may compile its kernels for longer than an answer waits."""
    facts = subscriber.ask("switch_profile", id="1", **request)
    while "taken up, but not finished" in facts.get("error", ""):
        facts = subscriber.ask("switch_profile", id="1", **request)
    assert facts["ok"], facts
    return facts


def profile_reported(subscriber: Subscriber) -> str:
    statuses = decode_diagnostics(subscriber.heard["health"][-1][1])
    return next(status.values["profile"] for status in statuses if status.name == "mapping")
