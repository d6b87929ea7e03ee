import json
import sys

import numpy as np
import pytest

import corridor
from service import kernel_warm_up
from service.cli import main
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
        ({"map": "nowhere"}, corridor.InputError, "nowhere"),
        ({"profile": "x"}, corridor.ConfigError, "x is no profile"),
        ({"config": "none.yaml"}, corridor.ConfigError, "none.yaml"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_words(recording, settings, error, words):
    with pytest.raises(error, match=words):
        corridor.replay(recording, **settings)


def test_that_kernels_are_compiled_is_logged_once_and_is_no_warning_of_the_result(
    recording, monkeypatch, caplog
):
    def compile_two(mapping, progress):
        progress.compiled("service.kernels.a")
        progress.compiled("service.kernels.b")

    monkeypatch.setattr(kernel_warm_up, "_loaded", set())
    monkeypatch.setattr(kernel_warm_up, "warm_up", compile_two)
    warnings = corridor.replay(recording).summary["warnings"]
    assert [record.name for record in caplog.records if "compiling" in record.getMessage()] == ["corridor"]
    assert not any("compiling" in warning for warning in warnings)


def test_a_plot_shows_map_and_trajectory_in_metres(replayed):
    figure = pytest.importorskip("matplotlib.figure", reason="pip install matplotlib")
    axes = figure.Figure().add_subplot()
    assert replayed.plot(axes) is axes
    (image,) = axes.get_images()
    grid = replayed.map
    assert image.get_extent()[:1] + image.get_extent()[2:3] == [grid.x_min_m, grid.y_min_m]
    shown = np.concatenate([line.get_xydata() for line in axes.get_lines()])
    assert sorted(map(tuple, shown)) == sorted(map(tuple, replayed.trajectory.pose[:, :2]))
    assert [line.get_label() for line in axes.get_lines()] == [
        state for state in ("ok", "degraded", "lost") if replayed.summary["state"][state]
    ]


def test_a_plot_without_matplotlib_says_what_to_install(replayed, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(corridor.CorridorError, match="pip install matplotlib"):
        replayed.plot()


def test_a_stored_map_is_gone_on_in(recording, stored):
    again = corridor.replay(recording, map=stored, localize=True)
    assert again.summary["state"]["lost"] < 10  # half a second, until the place comes that was searched for
    assert again.summary["mapping"]["mode"] == "localization"
    assert again.poses[-1].x_m == pytest.approx(0.8, abs=0.02)
