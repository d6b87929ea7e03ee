"""The map of a running session, as it is looked at."""

import json

import numpy as np

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
