import json

import numpy as np
import pytest

import corridor
from service.cli import main
from service.compile.signatures import Job
from service.offline.replay import replay
from tests.service.api.rooms import driven


def test_a_result_has_what_the_command_writes(recording, replayed, tmp_path, capsys):
    assert main(["replay", str(recording), "--out", str(tmp_path / "command"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    for name in ("scans", "state", "keyframes", "map_tiles", "warnings"):
        assert replayed.summary[name] == summary[name]
    replayed.save(tmp_path / "api")
    for name in ("trajectory.tum", "trajectory_live.tum", "states.csv", "map.pgm", "map.yaml", "graph.g2o"):
        assert (tmp_path / "api" / name).read_bytes() == (tmp_path / "command" / name).read_bytes()
    assert corridor.Map.load(tmp_path / "api" / "map").version == 1


def test_poses_are_those_of_the_drive(replayed):
    assert replayed.trajectory.pose.shape == (50, 3)
    assert set(replayed.lasers) == {"front"}
    first_ns = min(driven().truth)
    true = [driven().truth[stamp - replayed.poses[0].stamp_ns + first_ns] for stamp in
            replayed.trajectory.stamp_ns.tolist()]  # fmt: skip
    away = replayed.trajectory.pose[:, :2] - [(pose.x_m, pose.y_m) for pose in true]
    assert np.hypot(*away.T).max() < 0.02
    assert {pose.state for pose in replayed.poses} <= {"ok", "degraded"}


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"localize": True}, corridor.UsageError, "--map"),
        ({"version": 2}, corridor.UsageError, "version 2 is of a stored map; name its folder by map"),
        ({"map": "nowhere"}, corridor.InputError, "nowhere"),
        ({"profile": "x"}, corridor.ConfigError, "x is no profile"),
        ({"config": "none.yaml"}, corridor.ConfigError, "none.yaml"),
        ({"from_raw": True}, corridor.InputError, "raw"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_words(recording, settings, error, words):
    with pytest.raises(error, match=words):
        corridor.replay(recording, **settings)


def test_that_kernels_are_compiled_is_logged_once_and_is_no_warning_of_the_result(
    recording, monkeypatch, caplog
):
    def compile_two(progress):
        for name in ("a", "b"):
            progress.done(Job("service.kernels", name, 0, 1))

    monkeypatch.setattr(replay, "warm_up_in_turn", compile_two)
    warnings = corridor.replay(recording).summary["warnings"]
    assert [record.name for record in caplog.records if "compiling" in record.getMessage()] == ["corridor"]
    assert not any("compiling" in warning for warning in warnings)


def test_a_stored_map_is_gone_on_in(recording, stored):
    again = corridor.replay(recording, map=stored, localize=True)
    assert again.summary["state"]["lost"] < 10  # half a second, until the place comes that was searched for
    assert again.summary["mapping"]["mode"] == "localization"
    assert again.poses[-1].x_m == pytest.approx(0.8, abs=0.02)
