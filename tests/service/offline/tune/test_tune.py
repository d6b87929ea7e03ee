"""Settings by a search: what is searched, what counts as good, and that a search can be stopped."""

import math
from collections.abc import Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from service.cli import main
from service.errors import CorridorError, InputError, UsageError
from service.mapper.profiles import mapping_config
from service.mapper.saved_graph import SavedGraph
from service.offline.cluster.engines import Ended, in_turn
from service.offline.cluster.session_task import Task
from service.offline.cluster.tasks import Done
from service.offline.replay.setup import ReplayOptions
from service.offline.score.trajectory import write_tum
from service.offline.tune import search
from service.offline.tune.measures import Measured, map_entropy, pass_offset_m
from service.offline.tune.page import page_of, patch_of, verdict
from service.offline.tune.search import Drive, Outcome, geometric_mean, tune
from service.offline.tune.space import parameters_of
from service.outputs import TileUpdate
from simulators.worlds import WORLDS
from tests.recorded_drive import record
from tests.service.offline.recorded_drives import T0_NS, RecordDrive
from tests.simulated import FORWARD, LMS100_50HZ, Wheels, drives

MAPPING = mapping_config()
PARAMETERS = parameters_of(MAPPING, ["wall_sigma_m=0.0001:1", "odometry_position_walk=0.0001:1"])
TRUE = {"matcher": {"wall_sigma_m": 0.03}, "motion_model": {"odometry_position_walk": 0.003}}


def test_a_parameter_is_named_by_its_end_and_searched_about_its_present_value():
    (one,) = parameters_of(MAPPING, ["wall_sigma_m"])
    assert (one.name, one.present, one.low, one.high) == ("matcher.wall_sigma_m", 0.004, 0.0004, 0.04)
    (whole,) = parameters_of(MAPPING, ["keep_passes"])
    assert (whole.is_whole, whole.low, whole.high) == (True, 1, 60)
    (bounded,) = parameters_of(MAPPING, ["matcher.lost_ratio"])
    assert bounded.high <= 1.0
    assert len(parameters_of(MAPPING, [])) > 10


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ("wall_sigma", "wall_sigma_m"),
        ("keyframe_distance_m", "local_map.keyframe_distance_m or graph.keyframe_distance_m"),
        ("no_such", r"unknown; known here: (\w+, )+\w+$"),
        ("wall_sigma_m=1", "expected LOW:HIGH"),
        ("wall_sigma_m=2:1", "expected LOW:HIGH"),
        ("wall_sigma_m=-1:1", "expected LOW:HIGH"),
    ],
)
def test_what_is_no_parameter_is_refused_with_what_there_is(wanted: str, words: str):
    with pytest.raises(UsageError, match=words):
        parameters_of(MAPPING, [wanted])


def test_what_samples_decide_that_no_session_has_is_not_searched():
    without = {one.name for one in parameters_of(MAPPING, [], ())}
    assert {one.name for one in parameters_of(MAPPING, [], ("odom", "imu"))} > without
    assert not any(name.startswith(("motion_model.odometry_", "motion_model.gyro_")) for name in without)
    with pytest.raises(UsageError, match="gyro_walk: no session has samples of imu; leave it out"):
        parameters_of(MAPPING, ["gyro_walk"], ("odom",))


def test_walls_that_two_passes_see_apart_are_measured():
    """A wall along x seen by the first key frame, and 20 m of path later by one that is 2 cm off."""
    x = np.arange(0.0, 2.0, 0.02)
    wall = np.column_stack((x, np.full_like(x, 1.13)))
    normals = np.tile([0.0, -1.0, 1.0], (len(x), 1))
    arrays = {field.name: np.zeros(0) for field in fields(SavedGraph) if field.default_factory is MISSING}
    graph = SavedGraph(
        **arrays
        | {
            "stamp_ns": np.arange(2),
            "map": np.array([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0]]),
            "path_length_m": np.array([0.0, 20.0]),
            "point_count": np.array([len(x), len(x)]),
            "xy_base": np.vstack((wall, wall)),
            "normals": np.vstack((normals, normals)),
        }
    )
    assert pass_offset_m(graph) == pytest.approx(0.02, abs=1e-6)
    assert pass_offset_m(replace(graph, path_length_m=np.array([0.0, 1.0]))) == 0.0


def test_the_entropy_of_a_map_is_that_of_its_known_cells():
    cells = np.array([[50, 50], [-1, 100]], np.int8)
    tile = TileUpdate(0, 0, 0, 1, 0.05, cells)
    sure = -0.995 * math.log2(0.995) - 0.005 * math.log2(0.005)
    assert map_entropy([tile]) == pytest.approx((2.0 + sure) / 3.0)


def quadratic(tasks: Sequence[Task]) -> Ended:
    """An engine whose results are the better, the nearer both settings are to TRUE; it maps nothing."""
    for k in reversed(range(len(tasks))):
        settings = tasks[k].options.mapping["settings"]
        away = [
            math.log10(settings[slot][name] / value)
            for slot, of_slot in TRUE.items()
            for name, value in of_slot.items()
        ]
        cost = 10.0 ** sum(one**2 for one in away)
        yield k, Done({"cost": cost * (1 + k), "scan_cpu_ms": {"p50": 1.0}}, {})


@pytest.fixture
def drives_given(monkeypatch: pytest.MonkeyPatch) -> list[Drive]:
    facts: Any = lambda folder, summary, truth: Measured(summary["cost"], {"cost": summary["cost"]})  # noqa: E731
    monkeypatch.setattr(search, "measure", facts)
    return [Drive((Path(f"d{k}.mcap"),), None, is_held_out=k == 1) for k in range(3)]


def searched(given: list[Drive], out: Path, trials: int, engine: Any = quadratic) -> Outcome:
    return tune(given, ReplayOptions(), PARAMETERS, out, trials, 1, engine, lambda *_: None)


def test_a_search_finds_both_values_and_prunes_what_is_worse_than_the_median(
    drives_given: list[Drive], tmp_path: Path
):
    outcome = searched(drives_given, tmp_path, 14)
    assert 0.01 < outcome.best["matcher.wall_sigma_m"] < 0.1
    assert 0.001 < outcome.best["motion_model.odometry_position_walk"] < 0.01
    trials = outcome.study.trials
    assert trials[0].params == outcome.present
    assert {trial.state.name for trial in trials} == {"COMPLETE", "PRUNED"}
    assert len(trials) == 14
    after = outcome.costs(is_held_out=True)
    assert after[1] < after[0]
    patch = yaml.safe_load(patch_of(outcome, "corridor"))
    assert patch["mapping"]["settings"]["matcher"]["wall_sigma_m"] == outcome.best["matcher.wall_sigma_m"]
    for words in ("Importances", "Trade-off", "matcher.wall_sigma_m", "d1.mcap"):
        assert words in page_of(outcome, "corridor")


def test_a_search_that_was_stopped_goes_on_as_if_it_had_not_been(drives_given: list[Drive], tmp_path: Path):
    whole = searched(drives_given, tmp_path / "whole", 5)

    def stopped(tasks: Sequence[Task]) -> Ended:
        if not calls.pop():
            raise KeyboardInterrupt
        yield from quadratic(tasks)

    calls = [False, *[True] * 3]
    with pytest.raises(KeyboardInterrupt):
        searched(drives_given, tmp_path / "cut", 5, stopped)
    went_on = searched(drives_given, tmp_path / "cut", 5)
    assert [t.params for t in went_on.study.trials if t.state.name != "FAIL"] == [
        t.params for t in whole.study.trials
    ]
    assert went_on.best == whole.best


def test_another_search_in_the_same_folder_is_refused_before_its_results_are_replaced(
    drives_given: list[Drive], tmp_path: Path
):
    config = tmp_path / "c.yaml"
    config.write_text("mapping: {cell_m: 0.05}\n")
    out, options = tmp_path / "out", ReplayOptions(config=config)
    phases: list[str] = []
    tune(drives_given, options, PARAMETERS, out, 1, 1, quadratic, lambda _, phase, note: phases.append(phase))
    assert list(dict.fromkeys(phases)) == [
        "replays with the present settings",
        "trials",
        "replays with the best settings",
    ]
    config.write_text("mapping: {cell_m: 0.1}\n")
    none_of: Any = None  # no engine: nothing may be replayed
    for given, seed in ((options, 1), (ReplayOptions(), 1), (options, 2)):
        with pytest.raises(UsageError, match="has a search of other sessions"):
            tune(drives_given, given, PARAMETERS, out, 2, seed, none_of, lambda *_: None)


def test_settings_that_are_refused_are_no_result_and_end_no_search(drives_given: list[Drive], tmp_path: Path):
    calls = iter([False, True, True, True, *[False] * 4, True])

    def refusing(tasks: Sequence[Task]) -> Ended:
        if next(calls):
            yield 0, Done(InputError("nothing to map"), {})
        else:
            yield from quadratic(tasks)

    outcome = searched(drives_given, tmp_path, 6, refusing)
    assert [trial.state.name for trial in outcome.study.trials].count("FAIL") == 3
    with pytest.raises(CorridorError, match="nothing to map"):  # with the present settings
        searched(drives_given, tmp_path / "other", 6, refusing)


def test_held_out_sessions_that_become_worse_are_reported(drives_given: list[Drive]):
    good, bad = Measured(1.0, {}), Measured(2.0, {})
    measured = {"d0.mcap": (bad, good), "d1.mcap": (good, bad), "d2.mcap": (bad, good)}
    outcome = Outcome(None, PARAMETERS, drives_given, {}, measured)
    assert verdict(outcome)[-1].startswith("the held-out sessions became worse")
    assert "nothing that was tried is better" not in "".join(verdict(outcome))
    as_before = replace(outcome, measured=dict.fromkeys(measured, (good, good)))
    assert "nothing that was tried is better than the present values: keep them" in verdict(as_before)
    once = Measured(1.0, {"pass_offset_m": 0.0})
    assert (
        "errors of the pose do not show"
        in verdict(replace(outcome, measured=dict.fromkeys(measured, (once, good))))[2]
    )
    none_held_out = replace(outcome, drives=drives_given[::2])
    assert verdict(none_held_out)[-1].startswith("no session was held out")
    assert geometric_mean([Measured(0.01, {}), Measured(1.0, {})]) == pytest.approx(0.1)


def test_the_command_searches_real_drives_without_a_truth(
    record_drive: RecordDrive, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    sessions, out = [str(record_drive(name, scans=12)) for name in "ab"], tmp_path / "out"
    options = ["--trials", "1", "--out", str(out), "--parameter", "wall_sigma_m"]
    assert main(["tune", *sessions, "--self", *options]) == 0
    printed = capfd.readouterr()
    assert "cost by the results themselves" in printed.out
    assert "1 of 1 trials" in printed.err
    assert yaml.safe_load(printed.out)["mapping"]["profile"] == "corridor"
    assert (out / "tune.html").read_text().startswith("<!DOCTYPE html>")
    best, present = ({path.name for path in (out / name).iterdir()} for name in ("best", "present"))
    assert best == present
    bad = [str(tmp_path / f"bad {name}.mcap") for name in "ab"]
    for path in bad:
        Path(path).write_bytes(b"garbage")
    assert main(["tune", *sessions, *bad, "--self", *options]) == InputError.exit_code
    refused = capfd.readouterr().err
    assert all(f"{path} is no recording" in refused for path in bad)  # each, not only the first
    assert main(["tune", sessions[0], "--truth", str(tmp_path)]) == InputError.exit_code
    assert "the truth of" in capfd.readouterr().err
    assert main(["tune", *sessions, "--truth", sessions[0]]) == UsageError.exit_code
    assert main(["tune", *sessions, "--truth", "no.tum", "no.tum"]) == InputError.exit_code
    assert capfd.readouterr().err.endswith("no.tum: no such file or folder\n")
    assert main(["tune", *sessions, "--self", "--profile", "contour_lm"]) == UsageError.exit_code
    assert "stores no pose graph" in capfd.readouterr().err


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_wrong_settings_are_found_again_within_30_trials(tmp_path: Path):
    """Along a corridor without features the odometry decides, in an office the walls."""
    given = []
    for world, seeds in (("featureless", (1, 2, 3, 4)), ("office", (1, 2))):
        laser, wheels = replace(LMS100_50HZ, rate_hz=25.0), Wheels(sigma_m_per_sqrt_m=0.02)
        for seed, driven in zip(seeds, drives(WORLDS[world](), laser, 12.0, seeds, wheels), strict=True):
            session = record(driven.frames, {"front": FORWARD}, tmp_path / f"{world}{seed}", T0_NS)
            truth = tmp_path / f"{world}{seed}.tum"
            write_tum(truth, [(stamp_ns + T0_NS, pose) for stamp_ns, pose in driven.truth.items()])
            given.append(Drive((session,), truth, is_held_out=seed % 2 == 0))
    wrong = {"matcher.wall_sigma_m": 0.1, "motion_model.odometry_position_walk": 1.0}
    ranges = parameters_of(MAPPING, ["wall_sigma_m=0.001:0.2", "odometry_position_walk=0.001:2"])
    parameters = [replace(one, present=wrong[one.name]) for one in ranges]
    outcome = tune(given, ReplayOptions(), parameters, tmp_path, 30, 1, in_turn, lambda *_: None)
    assert outcome.best["matcher.wall_sigma_m"] < 0.02
    assert 0.002 < outcome.best["motion_model.odometry_position_walk"] < 0.2
    for is_held_out in (False, True):
        costs = outcome.costs(is_held_out)
        assert costs[1] < 0.4 * costs[0]
