"""The default profile on drives with known truth."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from drivers.frames import ImuSample, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.components import ComponentKind, Method, NoSettings
from service.mapper.judgement import GAP_S, TIGHT_SIGMA_M, judge_blank
from service.mapper.profiles import METHODS, mapping_config
from service.outputs import MapperOutput, Reason
from tests.service.mapper.drives import (
    CORRIDOR,
    DOORS,
    ROOM,
    Drive,
    down_the_corridor,
    drive,
    errors,
    mapper_of,
    outputs_of,
    round_the_room,
    scans_of,
)
from tests.soaked import in_soak

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def room_drive() -> Drive:
    return drive(ROOM, round_the_room, 5.0)


def digest(output: MapperOutput) -> tuple:
    return (
        output.pose_odom_base,
        output.twist_base,
        output.covariance.tobytes(),
        output.state,
        output.inlier_ratio,
    )


@pytest.mark.parametrize(
    ("profile", "has_wheels", "every", "rms_m", "most_m", "most_deg"),
    [
        ("corridor", True, 1, 0.0015, 0.006, 0.1),
        ("corridor", False, 1, 0.004, 0.006, 0.1),
        ("contour_lm", False, 4, 0.01, 0.02, 0.6),
        ("imle", True, 10, 0.006, 0.012, 0.2),
        ("imle", False, 10, 0.006, 0.012, 0.2),
        ("owolm_eskf", True, 2, 0.015, 0.03, 0.4),
        in_soak("owolm_eskf", False, 2, 0.015, 0.03, 0.4),
        ("submap_graph", True, 2, 0.04, 0.05, 0.6),
    ],
)
def test_a_drive_round_a_room_is_followed(
    room_drive: Drive,
    profile: str,
    has_wheels: bool,
    every: int,
    rms_m: float,
    most_m: float,
    most_deg: float,
) -> None:
    """By each profile, with every so many scans."""
    left_out = {scan.stamp_ns for k, scan in enumerate(scans_of(room_drive.frames)) if k % every}
    kinds = (LaserScan, OdometrySample) if has_wheels else LaserScan
    frames = [f for f in room_drive.frames if isinstance(f, kinds) and f.stamp_ns not in left_out]
    outputs = outputs_of(mapper_of(profile), frames)
    away = errors(outputs, room_drive.truth)
    forward_m, left_m, turn_rad = away.T
    off_m = np.hypot(forward_m, left_m)
    assert {o.state for o in outputs} == {"ok"}
    assert all(np.linalg.eigvalsh(o.covariance)[0] > 0.0 for o in outputs[1:])
    assert np.sqrt((off_m**2).mean()) < rms_m
    assert off_m.max() < most_m
    assert np.degrees(np.abs(turn_rad).max()) < most_deg
    if profile == "corridor" and has_wheels:
        covariance = np.array([output.covariance for output in outputs])
        np.testing.assert_allclose(covariance, covariance.swapaxes(1, 2), atol=1e-12)
        nees = np.einsum("ni,nij,nj->n", away[5:], np.linalg.inv(covariance[5:]), away[5:])
        assert nees.mean() < 3.0  # 3 were perfect; below it is caution
        assert math.sqrt(covariance[:, 0, 0].max()) < 0.01


def test_the_open_direction_of_a_corridor_follows_odometry() -> None:
    corridor = drive(CORRIDOR, down_the_corridor, 6.0, wheel_scale=1.05)
    outputs = outputs_of(mapper_of(), corridor.frames)
    away = errors(outputs, corridor.truth)
    path_length_m = 5.08
    # The distance of the wheels, less a small share by noise of the normals.
    assert away[-1, 0] == pytest.approx(0.05 * path_length_m, abs=0.06)
    assert np.abs(away[:, 1]).max() < 0.02
    assert np.degrees(np.abs(away[:, 2]).max()) < 0.15
    last = outputs[-1]
    warned = [output for output in outputs if "does not fix the position along" in output.reason]
    assert {output.state for output in warned} == {"degraded"}
    assert len(warned) > len(outputs) // 2
    along_m, across_m = np.sqrt(np.diag(last.covariance)[:2])
    assert along_m > 5.0 * across_m
    assert abs(away[-1, 0]) < 3.0 * along_m
    grown = [o.covariance[0, 0] for o in outputs[10::50]]
    assert grown == sorted(grown)


def test_without_odometry_the_features_of_a_corridor_are_used() -> None:
    """A stop in the middle: a prediction by the last speed alone would continue.

    Over 120 seeds the worst is 0.19 m off along the path and 0.13 m at the end, the median 0.04 and 0.015 m.
    """

    def stopping(time_s: float) -> SE2:
        return down_the_corridor(min(time_s, 3.0))

    farthest_m, end_m = [], []
    for seed in range(1, 4):
        corridor = drive(DOORS, stopping, 5.0, wheel_scale=None, seed=seed)
        away = np.abs(errors(outputs_of(mapper_of(), corridor.frames), corridor.truth))
        farthest_m.append(away[:, 0].max())
        end_m.append(away[-25:, 0].mean())
        assert away[:, 1].max() < 0.01
    assert np.median(farthest_m) < 0.06
    assert np.median(end_m) < 0.03
    assert max(farthest_m) < 0.2


@pytest.mark.parametrize("profile", METHODS)
def test_the_same_frames_give_the_same_outputs_bit_for_bit(profile: str, room_drive: Drive) -> None:
    def mapped() -> tuple[list[tuple], list[tuple]]:
        mapper = mapper_of(profile)
        outputs = [digest(output) for output in outputs_of(mapper, room_drive.frames[:50])]
        return outputs, [(t.ix, t.iy, t.version, t.cells.tobytes()) for t in mapper.changed_tiles()]

    assert mapped() == mapped()


def test_late_frames_and_samples_of_a_stamp_that_was_there_are_dropped_and_counted(room_drive: Drive) -> None:
    mapper, scans = mapper_of(), scans_of(room_drive.frames)
    samples = [f for f in room_drive.frames if isinstance(f, OdometrySample)]
    turn = ImuSample("imu", samples[1].stamp_ns, samples[1].arrived_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))
    outputs_of(mapper, [samples[0], samples[1], turn, samples[1], turn, turn, samples[0], scans[1]])
    assert outputs_of(mapper, scans[:2]) == []
    assert mapper.counters == {
        "scans": 1, "keyframes": 1, "scans_dropped_late": 2, "samples_dropped_same_stamp": 3,
        "samples_dropped_late": 1,
    }  # fmt: skip


def without_returns(frames: list, stamps_ns: set[int]) -> list:
    """The frames, the scans of these stamps blank."""
    return [
        replace(frame, range_m=np.full_like(frame.range_m, np.nan))
        if isinstance(frame, LaserScan) and frame.stamp_ns in stamps_ns
        else frame
        for frame in frames
    ]


@pytest.mark.parametrize("profile", METHODS)
def test_blank_scans_among_good_ones_are_degraded_and_change_the_path_by_millimetres(profile: str) -> None:
    whole = drive(ROOM, round_the_room, 1.2)
    blank = set(sorted(whole.truth)[20::5])
    mapper = mapper_of(profile)
    outputs = outputs_of(mapper, without_returns(whole.frames, blank))
    assert {o.stamp_ns for o in outputs if o.state == "degraded"} == blank
    assert {o.state for o in outputs} == {"ok", "degraded"}
    assert mapper.counters["scans_blind_front"] == len(blank)
    assert np.hypot(*errors(outputs, whole.truth)[:, :2].T).max() < 0.05
    reason = next(o.reason for o in outputs if o.state == "degraded")
    assert reason.startswith("front: 0 of 541 beams returned (at least 5); is the window covered")
    assert "The pose follows the prediction for 0.02 s, uncertain by 0.0" in reason


def test_ranges_in_millimetres_are_named_as_the_cause_of_few_returns() -> None:
    whole = drive(ROOM, round_the_room, 0.2)
    frames = [
        replace(frame, range_m=frame.range_m * np.float32(1000.0), range_max_m=30_000.0)
        if isinstance(frame, LaserScan)
        else frame
        for frame in whole.frames
    ]
    reason = outputs_of(mapper_of(), frames)[0].reason
    assert reason.id == "few_returns"
    assert re.match(r"front: 0 of \d+ returns lie within the ranges that are mapped", reason)
    assert re.search(r"half of them beyond \d{4} m; are ranges in m", reason)


def test_a_laser_that_stays_blank_is_lost_once_too_long_without_returns() -> None:
    whole = drive(ROOM, round_the_room, 4.0)
    stamps = sorted(whole.truth)
    outputs = outputs_of(mapper_of(), without_returns(whole.frames, set(stamps[25:])))
    blank_s = [(o.stamp_ns - stamps[24]) * 1e-9 for o in outputs if o.state == "lost"]
    assert blank_s[0] == pytest.approx(GAP_S, abs=0.03)
    assert {o.state for o in outputs[25 : -len(blank_s)]} == {"degraded"}


def test_a_blank_scan_is_lost_where_the_prediction_is_loose() -> None:
    few, known, loose = Reason("few_returns", "few."), (0.1, 0.1), (TIGHT_SIGMA_M + 0.01, 0.1)
    assert judge_blank(few, known, 0.1)[0] == "degraded"
    state, reason = judge_blank(few, loose, 0.1)
    assert (state, reason.id) == ("lost", "few_returns")
    assert "uncertain by 0.51 m and 5.7 deg (sigma, expected at most 0.5 m" in reason


@pytest.mark.timeout(800)  # where the cache is cold, on a machine that does other things
@pytest.mark.parametrize("what", ["mapping", in_soak("localizing")])
def test_kernels_are_compiled_once_and_a_live_start_loads_all_but_solver_and_scipy(what: str) -> None:
    child = [sys.executable, "-m", "tests.service.mapper.compiled_kernels", what]
    for _ in range(2):  # the first fills the cache: what compiles counts the types of its callers, too
        ran = json.loads(subprocess.run(child, cwd=ROOT, check=True, capture_output=True, timeout=400).stdout)
        if ran["compiled"] == 0:
            break
    counts = ran["signatures"]
    assert (ran["compiled"], ran["late"], ran["imported"], ran["solver"]) == (0, [], [], 0)
    assert len(counts) > 15
    of_two_kinds_of_cells = {  # bytes and float32
        "branch_and_bound.pool_levels",
        "likelihood_search.search_exhaustive",
        "branch_and_bound.search_branch_and_bound",
        "branch_and_bound.build_pyramid",
    }
    assert {
        name: count for name, count in counts.items() if count > 1 + (name in of_two_kinds_of_cells)
    } == {}


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"settings": {"local_map": {"spacing": 10.0}}}, "spacing"),
        ({"profile": "corridoor"}, 'corridoor is no profile; did you mean "corridor"'),
        (
            {"components": {"matcher": "surfel_gaus"}},
            'surfel_gaus is no matcher; did you mean "surfel_gauss_newton"',
        ),
    ],
)
def test_a_misspelt_name_is_refused_with_what_was_meant(section: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        mapping_config(section)


OWN_KERNELS = {  # what no other profile calls
    "contour_lm": {"velocity_lm", "background", "contour_blur"},
    "imle": {"icp", "line_likelihood"},
    "submap_graph": {"particles", "counted_occupancy"},
    "owolm_eskf": {"orthogonal_weights", "strapdown", "blurred_segments"},
    "corridor": {"range_bias", "static_score", "match"},
}


@pytest.mark.parametrize("chosen", [in_soak("corridor"), "owolm_eskf"])
def test_only_the_imports_of_the_chosen_profile_are_made(chosen: str) -> None:
    script = (
        "import sys, service.runtime.run, service.offline.replay.replay\n"
        "from service.geometry.se2 import SE2\n"
        "from service.mapper.profiles import build_mapper, mapping_config\n"
        f"build_mapper(mapping_config({{'profile': '{chosen}'}}), {{'front': SE2()}})\n"
        "print(*(name for name in sys.modules if name.startswith('service.')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    imported = {name.removeprefix("service.") for name in done.stdout.split()}
    for folder, expected in (("methods", {chosen, "shared"}), ("papers", {chosen} - {"corridor"})):
        names = {name.split(".")[2] for name in imported if name.startswith(f"mapper.{folder}.")}
        assert names == expected
    kernels = {name.removeprefix("kernels.") for name in imported if name.startswith("kernels.")}
    assert OWN_KERNELS[chosen] <= kernels
    assert not kernels & set().union(*(OWN_KERNELS[name] for name in METHODS if name != chosen))


def test_a_component_of_another_profile_is_found_when_it_is_chosen() -> None:
    settings = mapping_config({"components": {"motion_model": "inertial_motion"}}).settings
    assert settings.motion_model.__class__.__name__ == "InertialMotionConfig"


def test_a_matcher_that_cannot_read_the_local_map_is_refused(monkeypatch) -> None:
    class RenderedMap: ...

    rendered_map = ComponentKind("rendered_map", NoSettings, lambda _, __: RenderedMap(), makes=RenderedMap)
    other = Method("other", {**METHODS["corridor"]().components, "local_map": rendered_map}, {})
    monkeypatch.setitem(METHODS, "other", lambda: other)
    with pytest.raises(ValidationError) as refused:
        mapping_config({"components": {"local_map": "rendered_map"}})
    assert (
        "the matcher surfel_gauss_newton cannot read the local_map rendered_map; it reads surfel_submaps. "
        "What reads rendered_map as matcher: nothing"
    ) in str(refused.value)


def test_a_method_may_have_other_defaults_than_its_components(monkeypatch) -> None:
    corridor = METHODS["corridor"]()
    settings = {"local_map": {"spacing_m": 7.0, "dynamic_filter": {"behind_m": 0.5}}}
    monkeypatch.setitem(METHODS, "other", lambda: Method("other", corridor.components, settings))
    local_map = mapping_config(
        {"profile": "other", "settings": {"local_map": {"cell_m": 0.2}}}
    ).settings.local_map
    assert (local_map.spacing_m, local_map.cell_m, local_map.dynamic_filter.behind_m) == (7.0, 0.2, 0.5)
    assert local_map.dynamic_filter.enough_s == mapping_config().settings.local_map.dynamic_filter.enough_s
    with pytest.raises(ValidationError, match="greater than 0"):
        mapping_config({"profile": "other", "settings": {"local_map": {"spacing_m": -1.0}}})


@pytest.mark.parametrize("profile", METHODS)
def test_the_example_names_every_parameter_with_its_default(profile: str) -> None:
    example = yaml.safe_load((ROOT / f"config/profiles/{profile}.yaml").read_text())
    defaults = mapping_config({"profile": profile}).model_dump(mode="json")
    assert example == {key: defaults[key] for key in ("profile", "cell_m", "settings")}


@pytest.mark.parametrize("profile", METHODS)
def test_each_setting_has_its_meaning_beside_it(profile: str) -> None:
    shared = () if profile == "corridor" else ("deskew", "free_space")  # corridor.yaml describes them
    section, without = "", []
    for line in (ROOT / f"config/profiles/{profile}.yaml").read_text().splitlines():
        if heading := re.fullmatch(r"  (\w+):", line):
            section = heading[1]
        elif section and section not in shared and re.fullmatch(r" +\w+: [^#]+", line):
            without.append(line)
    assert without == []


def test_there_are_at_most_forty_settings() -> None:
    assert len(list(leaves(mapping_config().settings.model_dump()))) <= 40


def leaves(settings: dict[str, Any], path: str = "") -> Iterator[str]:
    """Paths of keys that have no keys of their own: matcher.wall_sigma_m."""
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{path}{key}.")
        else:
            yield path + key
