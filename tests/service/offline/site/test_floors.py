"""A site whose floors have the same corridors, and places that change between two drives."""

import shutil
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.errors import UsageError
from service.geometry import poses as se2
from service.mapper.graph.model.loops import Loop
from service.mapstore.files import load_map
from service.offline.cluster.engines import Ended
from service.offline.cluster.tasks import AnyTask, Done
from service.offline.maps.work import map_info, utc
from service.offline.site.tasks import Find, FindLoops
from tests.service.mapper.graph.loops import rings
from tests.service.offline.site.ring_drives import FRAMES, HOUR_NS, build, driven, names_in, store

CRATE = (14.1, 4.0, 14.7, 4.7)  # m: from x, y to x, y, beside the path of a and b


def knowing(tasks: Sequence[AnyTask]) -> Ended:
    """An engine that does not search: it knows where each drive lies, and ties key frames of one place."""
    for k, task in enumerate(tasks):
        assert isinstance(task, Find | FindLoops)
        whole, begins = task.graphs()
        if isinstance(task, Find):
            first = list(FRAMES)[whole.stamp_ns[0] // HOUR_NS]
            pose = FRAMES[first] @ FRAMES[task.name].inverse()
            yield k, Done({"pose_first_second": [pose.x_m, pose.y_m, pose.theta_rad]}, {})
            continue
        loops: list[list[Loop]] = []
        true = np.array([true_pose_at(rings.STEP_M * at) for at in whole.stamp_ns % HOUR_NS // 10**8])
        for begin, end in pairwise(begins):
            loops.append([])
            for to in range(begins[-1], len(whole), 10):
                of = int(np.hypot(*(true[begin:end, :2] - true[to, :2]).T).argmin())
                measured = se2.between(true[begin + of], true[to])
                covariance = np.diag([1e-4, 1e-4, 1e-6])
                loops[-1].append(Loop(of, to - begins[-1], measured, covariance, 0.9, 300, 0.0))
        yield k, Done({"loops": loops}, {})


def boxes_along_the_ring(seed: int) -> list[tuple[float, float, float, float]]:
    """At both walls of the corridors."""
    random = np.random.default_rng(seed)
    walls = []
    for path_length_m, side_m in zip(
        random.uniform(0.0, 46.0, 24), random.choice([-0.75, 0.75], 24), strict=True
    ):
        x_m, y_m, _ = se2.compose(np.array(true_pose_at(path_length_m)), np.array([0.0, side_m, 0.0]))
        walls += rings.rectangle(x_m - 0.25, y_m - 0.25, x_m + 0.25, y_m + 0.25)
    return walls


def true_pose_at(path_length_m: float) -> tuple[float, float, float]:
    pose = rings.round_the_ring(path_length_m)
    return pose.x_m, pose.y_m, pose.theta_rad


@pytest.fixture(scope="module")
def floors(few_beams_and_questions: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives through a floor, between which a crate was put down; and one through another floor: the same
    corridors with other furniture.
    """
    folder = tmp_path_factory.mktemp("floors")
    corridors, crate = rings.RING[:8], rings.rectangle(*CRATE)
    this_floor = corridors + boxes_along_the_ring(5)
    worlds = {"a": this_floor, "b": this_floor + crate, "c": corridors + boxes_along_the_ring(7)}
    for seed, (name, walls) in enumerate(worlds.items()):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rings, "RING", walls)
            patch.setattr(rings, "BEAMS", 361)
            patch.setattr(rings, "STEP_RAD", -2.0 * rings.FIRST_RAD / 360)
            store(folder / name, driven(name, seed))
    return folder


@pytest.fixture(scope="module")
def floor(floors: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("floor") / "map"
    return out, build([floors / name for name in ("a", "b", "c")], out, knowing)


def test_a_drive_of_another_floor_of_the_plan_is_left_out_by_its_name(floor):
    _, report = floor
    assert names_in(report) == ["a", "b"]
    assert list(report["left_out"]) == ["c"]
    assert "another floor" in report["left_out"]["c"]
    assert "--join c adds it" in report["left_out"]["c"]


def test_what_was_put_down_between_two_drives_is_a_changed_place_with_its_dates(floor, floors):
    out, report = floor
    assert report["changed_places"] == 1
    [place] = map_info(out)["changed_places"]
    assert (place["change"], place["session"]) == ("new", "b")
    assert CRATE[0] <= place["x_m"] <= CRATE[2]
    assert CRATE[1] <= place["y_m"] <= CRATE[3]
    stamps = {name: load_map(floors / name).graph.stamp_ns for name in ("a", "b")}
    expected = {"seen_from": stamps["a"].min(), "seen_to": stamps["a"].max(), "changed": stamps["b"].min()}
    assert {key: place[key] for key in expected} == {key: utc(int(ns)) for key, ns in expected.items()}


def test_a_drive_is_added_in_spite_of_what_changed_where_the_user_says_so(floor, floors, tmp_path):
    out = Path(shutil.copytree(floor[0], tmp_path / "map", symlinks=True))
    with pytest.raises(UsageError, match="--join d: no such session"):
        build([floors / "c"], out, knowing, ["d"])
    report = build([floors / "c"], out, knowing, ["c"])
    assert names_in(report) == ["a", "b", "c"]
    assert report["left_out"] == {}
    assert len(report["warnings"]) == 1
    assert report["warnings"][0].startswith("c: of ")
    assert report["changed_places"] > 10
