"""The profile imle and the two matchers it is measured against, on drives whose truth is known."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from drivers.frames import LaserScan
from service.mapper.papers.imle.icp_then_search import IcpThenSearch
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from service.outputs import MapperOutput
from tests.service.mapper.drives import MOUNTING, ROOM, Drive, drive, round_the_room

ROOT = Path(__file__).parents[5]


@pytest.fixture(scope="module")
def room_drive() -> Drive:
    return drive(ROOM, round_the_room, 5.0)


def new_mapper(matcher: str = "icp_then_search", **settings: object) -> Mapper:
    section = {"profile": "imle", "components": {"matcher": matcher}, "settings": {"matcher": settings}}
    return build_mapper(mapping_config(section), {"front": MOUNTING})


def run(mapper: Mapper, frames: list) -> list[MapperOutput]:
    return [output for frame in frames if (output := mapper.process(frame)) is not None]


def worst_m(outputs: list[MapperOutput], what: Drive) -> float:
    away = [what.truth[output.stamp_ns].inverse() @ output.pose_map_base for output in outputs]
    return max(math.hypot(e.x_m, e.y_m) for e in away)


def slow(what: Drive) -> list:
    """Every tenth scan, 5 Hz, and no wheels."""
    return [frame for frame in what.frames if isinstance(frame, LaserScan)][::10]


@pytest.mark.parametrize("wheels", [True, False])
def test_a_drive_round_a_room_is_followed_to_a_centimetre(room_drive: Drive, wheels: bool) -> None:
    frames = [f for f in room_drive.frames if not isinstance(f, LaserScan)] if wheels else []
    frames = sorted([*frames, *slow(room_drive)], key=lambda frame: frame.arrived_ns)
    outputs = run(new_mapper(), frames)
    assert {output.state for output in outputs} == {"ok"}
    assert worst_m(outputs, room_drive) < 0.012
    for output in outputs[1:]:
        assert np.linalg.eigvalsh(output.covariance)[0] > 0.0


# C34
def test_both_others_follow_a_room_less_well(room_drive: Drive) -> None:
    best = worst_m(run(new_mapper(), slow(room_drive)), room_drive)
    for matcher in ("icp_scan_to_scan", "monte_carlo"):
        outputs = run(new_mapper(matcher), slow(room_drive))
        assert best < worst_m(outputs, room_drive) < 2.0


def test_the_same_frames_give_the_same_poses_bit_for_bit(room_drive: Drive) -> None:
    for matcher in ("icp_then_search", "monte_carlo"):
        frames = slow(room_drive)[:12]
        first, second = run(new_mapper(matcher), frames), run(new_mapper(matcher), frames)
        assert [o.pose_odom_base for o in first] == [o.pose_odom_base for o in second]
        assert [o.covariance.tobytes() for o in first] == [o.covariance.tobytes() for o in second]


# C4
def test_the_window_is_three_times_the_error_of_icp_between_its_bounds(room_drive: Drive) -> None:
    scans = slow(room_drive)
    noisy = np.random.default_rng(1)
    rough = [
        replace(s, range_m=(s.range_m + 0.05 * noisy.standard_normal(541)).astype(np.float32)) for s in scans
    ]
    windows = []
    for frames in (scans, rough):
        mapper = new_mapper()
        matcher = mapper.components.matcher
        assert isinstance(matcher, IcpThenSearch)
        run(mapper, frames[:8])
        windows.append(matcher.window_m)
    assert 0.05 <= windows[0] < windows[1] <= 0.5


# C6
def test_narrowing_asks_a_fraction_of_the_candidates_of_the_literal_search() -> None:
    still = drive(ROOM, lambda _: round_the_room(0.0), 0.1, wheel_scale=None)
    counts, poses = [], []
    for search in ("narrowing", "exhaustive"):
        mapper = new_mapper(search=search, least_window_m=0.2, refine=False)
        run(mapper, still.frames[:1])
        components = mapper.components
        predicted = components.motion_model.predict(still.frames[1].stamp_ns)
        points = components.deskew(still.frames[1], predicted)
        measured = components.matcher.match(points, predicted, components.local_map).measured
        counts.append(components.matcher.evaluated)
        poses.append(measured.pose_odom_base)
    assert counts[1] >= 41 * 41 * 81
    assert counts[0] < counts[1] / 30
    assert poses[0] == poses[1]


def test_a_scan_without_returns_is_degraded_and_the_next_is_found_again(room_drive: Drive) -> None:
    scans = slow(room_drive)
    blind = replace(scans[3], range_m=np.full(541, np.nan, np.float32))
    for matcher in ("icp_then_search", "icp_scan_to_scan", "monte_carlo"):
        outputs = run(new_mapper(matcher), [*scans[:3], blind, *scans[4:6]])
        assert [o.state for o in outputs] == ["ok"] * 3 + ["degraded"] + ["ok"] * 2
        assert "0 of 541 beams returned" in outputs[3].reason


def test_a_place_never_seen_is_lost_and_not_drawn(room_drive: Drive) -> None:
    scans = slow(room_drive)
    elsewhere = replace(scans[1], range_m=np.full(541, 19.0, np.float32))
    outputs = run(new_mapper(), [scans[0], elsewhere, *scans[2:5]])
    assert outputs[1].state == "lost"
    assert "of 541 returns lie on the map" in outputs[1].reason
    assert worst_m(outputs[2:], room_drive) < 0.03


def test_the_example_names_every_parameter_with_its_default() -> None:
    example = yaml.safe_load((ROOT / "config/profiles/imle.yaml").read_text())
    defaults = mapping_config({"profile": "imle"}).model_dump(mode="json")
    for box in ("matcher", "local_map"):
        assert example["settings"][box] == defaults["settings"][box]
    assert mapping_config(example).model_dump(mode="json") == defaults


def test_every_parameter_of_its_own_is_documented() -> None:
    page = (ROOT / "docs/profiles/imle.md").read_text()
    for matcher in ("icp_then_search", "icp_scan_to_scan", "monte_carlo"):
        config = mapping_config({"profile": "imle", "components": {"matcher": matcher}})
        sections = {matcher: config.settings.matcher, "patch_map": config.settings.local_map}
        for name, settings in sections.items():
            section = page.split(f"`{name}`\n")[1].split("###")[0]
            for key in settings.model_dump(exclude={"icp"}):
                assert f"`{key}`" in section, f"{name}.{key} is missing in docs/profiles/imle.md"
