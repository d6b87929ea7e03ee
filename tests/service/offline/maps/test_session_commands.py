"""The map of a running session, as it is looked at."""

import json

import numpy as np
import pytest

from service.mapstore.files import load_map
from service.offline.maps.session_commands import SessionMapCommands

K = 6


class Asking:
    def __init__(self):
        self._commands = SessionMapCommands()

    def ask(self, verb, folder, **request):
        line = json.dumps({"verb": verb, "map": str(folder), "request": request})
        return self._commands.answer(line.encode())


def test_key_frames_come_with_pose_points_and_stamp(folder, bent):
    commands = Asking()
    facts = commands.ask("look", folder)
    assert (facts["version"], facts["keyframes"]["count"]) == (1, len(bent.graph))
    place = commands.ask("keyframe", folder, seen=facts["seen"], keyframe=K)
    np.testing.assert_allclose(place["pose"], bent.graph.map[K])
    assert len(place["points"]) == 2 * bent.graph.point_count[K]
    assert place["stamp_ns"] == str(bent.graph.stamp_ns[K])


def test_a_key_frame_of_another_look_than_the_newest_is_refused(folder):
    commands = Asking()
    first = commands.ask("look", folder)["seen"]
    commands.ask("look", folder)
    answer = commands.ask("keyframe", folder, seen=first, keyframe=0)
    assert not answer["ok"]
    assert "fetch them again" in answer["error"]


@pytest.mark.parametrize(
    ("verb", "request_", "words"),
    [
        ("keyframe", {"seen": "", "keyframe": -1}, "keyframe"),
        ("keyframe", {"seen": "", "keyframe": 0, "more": 1}, "more"),
        ("edit", {}, "it knows look, keyframe"),
    ],
)
def test_what_cannot_be_done_is_reported_in_words(folder, verb, request_, words):
    answer = Asking().ask(verb, folder, **request_)
    assert not answer["ok"]
    assert words in answer["error"]
    assert load_map(folder).number == 1
