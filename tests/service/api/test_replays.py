import json

import pytest

import corridor
from service.cli import main


def test_a_result_has_what_the_command_writes(recording, replayed, tmp_path, capsys):
    assert main(["replay", str(recording), "--out", str(tmp_path / "command"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    for name in ("scans", "state", "keyframes", "map_tiles", "warnings"):
        assert replayed.summary[name] == summary[name]
    replayed.save(tmp_path / "api")
    for name in ("trajectory.tum", "trajectory_live.tum", "states.csv", "map.pgm", "map.yaml", "graph.g2o"):
        assert (tmp_path / "api" / name).read_bytes() == (tmp_path / "command" / name).read_bytes()
    assert corridor.Map.load(tmp_path / "api" / "map").version == 1


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


def test_a_stored_map_is_gone_on_in(recording, stored):
    again = corridor.replay(recording, map=stored, localize=True)
    assert again.summary["state"]["lost"] < 10  # half a second, until the place comes that was searched for
    assert again.summary["mapping"]["mode"] == "localization"
    assert again.poses[-1].x_m == pytest.approx(0.8, abs=0.02)
