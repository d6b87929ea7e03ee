"""The back end on hand-made sub-maps: there and back in one room, with a growing error."""

import pickle

import numpy as np
import pytest

from service.estimator.motion import Motion
from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.background import InlineWorker
from service.mapper.components import GraphRequestError, MappedScan, Match
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.papers.submap_graph.counted_submaps import (
    ClosedSubmap,
    CountedChange,
    CountedSubmapsConfig,
)
from service.mapper.papers.submap_graph.graph.landmark_back_end import (
    Batch,
    LandmarkBackEnd,
    LandmarkGraphConfig,
)
from service.mapper.papers.submap_graph.graph.landmark_graph import LandmarkGraph
from service.mapper.papers.submap_graph.graph.submap_match import extract_walls, find
from service.mapper.papers.submap_graph.key_scan import KeyScan
from tests.service.mapper.drives import ROOM, cast
from tests.service.mapper.maps.points import points_of

MAPS = CountedSubmapsConfig()
CONFIG = LandmarkGraphConfig(drift_m_per_sqrt_m=0.05, drift_rad_per_sqrt_m=0.02)  # of these paths
BEAMS = np.linspace(-np.pi, np.pi, 361)[:-1]
STEP = float(BEAMS[1] - BEAMS[0])


def seen_from(pose: np.ndarray, seed: int) -> np.ndarray:
    """End points in the base frame of a scan of the room, 1 cm noise."""
    angle = BEAMS + pose[2]
    paths = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    range_m = cast(ROOM, np.tile(pose[:2], (len(angle), 1)), paths)
    range_m += 0.01 * np.random.default_rng(seed).standard_normal(len(angle))
    return range_m[:, None] * np.stack((np.cos(BEAMS), np.sin(BEAMS)), axis=1)


def submap(number: int, truth: np.ndarray, tracks: np.ndarray) -> ClosedSubmap:
    """A sub-map with scans from `truth`, inserted along another path."""
    scans = tuple(
        KeyScan(1000 * number + k + 1, seen_from(pose, 100 * number + k).astype(np.float32), (0.0, 0.0), STEP)
        for k, pose in enumerate(truth)
    )
    return ClosedSubmap(number, 0, scans, tracks, MAPS)


def round_trip() -> tuple[list[ClosedSubmap], np.ndarray]:
    """Four sub-maps there and back, each 8 cm and 1 deg farther off than the last; the true paths."""
    x = np.linspace(0.0, 1.5, 6)
    paths = [np.stack((x + 1.0, np.full(6, y), np.zeros(6)), axis=1) for y in (0.0, 0.4, -0.4, 0.1)]
    askew = [np.array([0.06 * k, -0.05 * k, np.radians(k)]) for k in range(4)]
    tracks = [se2.compose(error, path) for error, path in zip(askew, paths, strict=True)]
    return [submap(k, paths[k], tracks[k]) for k in range(4)], np.concatenate(paths)


@pytest.fixture(scope="module")
def trip() -> tuple[list[ClosedSubmap], np.ndarray]:
    return round_trip()


def furthest_m(found: np.ndarray, truth: np.ndarray) -> float:
    """With the first pose of one on that of the other."""
    moved = se2.compose(truth[0], se2.between(found[0], found))
    return float(np.hypot(*(moved - truth).T[:2]).max())


# D3, D12
def test_landmarks_take_out_what_the_paths_disagree_in(trip) -> None:
    closed, truth = trip
    back_end = LandmarkBackEnd(CONFIG, OccupancyTiles(OccupancyConfig(), 0.05).renderer)
    results = [pickle.loads(pickle.dumps(back_end.work(Batch("submap", closed=one)))) for one in closed]
    assert [result.submaps for result in results] == [1, 2, 3, 4]
    assert results[1].links == 0  # neighbours in time share scans
    assert results[3].links >= 2
    assert results[3].fault == ""
    tracks = np.concatenate([one.track for one in closed])
    assert furthest_m(tracks, truth) > 0.12
    assert furthest_m(results[3].poses, truth) < 0.07
    assert any(result.rendered_map is not None for result in results)
    picture = results[3].picture
    assert len(picture.borders) == 4
    assert len(picture.accepted) == results[3].links
    for border, one in zip(picture.borders, closed, strict=True):  # around the path driven in it
        own = results[3].poses[
            np.isin(results[3].stamps, [scan.stamp_ns for scan in one.scans[one.carried :]])
        ]
        assert (own[:, :2] > border.min(axis=0) - 0.3).all()
        assert (own[:, :2] < border.max(axis=0) + 0.3).all()
    last = back_end.work(Batch("finish"))
    assert last.g2o.count("EDGE_SE2_XY") == 2 * last.landmarks
    again = LandmarkBackEnd(CONFIG, None)
    for one in closed:
        repeated = again.work(Batch("submap", closed=one))
    np.testing.assert_array_equal(repeated.poses, results[3].poses)


def corrected(graph: LandmarkGraph) -> np.ndarray:
    poses = [correction.pose_map_base for correction in graph.finish().corrections]
    return np.array([(pose.x_m, pose.y_m, pose.theta_rad) for pose in poses])


def graph_of(closed: list[ClosedSubmap]) -> LandmarkGraph:
    """A graph that was handed these sub-maps, and has taken them in."""
    blind = CONFIG.model_copy(update={"neighbour_m": 1e-3})  # so that it finds nothing by itself
    graph = LandmarkGraph(blind, None, InlineWorker)
    points = points_of(np.ones((1, 2)))
    for one in closed:
        for k, (scan, pose) in enumerate(zip(one.scans, one.track, strict=True)):
            motion = Motion(SE2(*pose), (0.0, 0.0, 0.0), np.eye(3))
            is_last = k == len(one.scans) - 1
            change = (
                CountedChange(is_keyframe=True, closed=one) if is_last else CountedChange(is_keyframe=True)
            )
            graph.add(MappedScan(scan.stamp_ns, points, Match(motion, points, 1.0), change, np.eye(3)))
        graph.apply_result()
    return graph


# D13
def test_pairs_that_a_person_names_tie_sub_maps_and_can_be_taken_back(trip) -> None:
    closed, truth = trip
    graph = graph_of(closed)
    before = graph.request("optimize", {})
    assert before["submaps"] == 4
    assert before["pairs"] == []
    graph.apply_result()
    tracks = np.concatenate([one.track for one in closed])
    free = furthest_m(tracks, truth)
    marks = np.array([[4.0, 1.5], [4.0, -1.5]])
    for xy in marks:
        shown = corrected(graph)[::6]  # the first of each sub-map, in the map as it is now
        ends = [se2.points_from(shown[k], se2.points_seen(truth[6 * k], xy)) for k in range(4)]
        ask = {
            name: {"submap": k, "x_m": float(ends[k][0]), "y_m": float(ends[k][1])}
            for name, k in (("first", 0), ("second", 3))
        }
        number = graph.request("add_landmark_pair", ask)["pair"]
        graph.apply_result()
    assert number == 1
    answer = graph.request("optimize", {})
    graph.apply_result()
    assert [pair["pair"] for pair in answer["pairs"]] == [0, 1]
    assert max(pair["apart_m"] for pair in answer["pairs"]) < 0.05
    tied = corrected(graph)
    assert furthest_m(tied, truth) < 0.6 * free
    assert graph.request("undo", {})["pair"] == 1
    assert [pair["pair"] for pair in graph.request("remove_landmark_pair", {"pair": 0})["pairs"]] == []
    while graph.waiting:
        graph.apply_result()
    bare = corrected(graph)
    np.testing.assert_allclose(furthest_m(bare, truth), free, atol=0.01)


@pytest.mark.parametrize(
    ("name", "payload", "words"),
    [
        ("add_landmark_pair", {}, "first: Field required"),
        (
            "add_landmark_pair",
            {"first": {"submap": 1, "x_m": 0, "y_m": 0}, "second": {"submap": 1, "x_m": 1, "y_m": 0}},
            "both points are of sub-map 1",
        ),
        (
            "add_landmark_pair",
            {"first": {"submap": 1, "x_m": 0, "y_m": 0}, "second": {"submap": 9, "x_m": 1, "y_m": 0}},
            "no sub-map 9 in the graph yet; it holds 4",
        ),
        ("remove_landmark_pair", {"pair": 3}, "no landmark pair 3; there are: none"),
        ("undo", {}, "no landmark pair to take back"),
        ("fly", {}, "this graph knows add_landmark_pair"),
    ],
)
def test_a_request_that_cannot_be_granted_is_answered_in_words(trip, name, payload, words) -> None:
    graph = graph_of(trip[0])
    with pytest.raises(GraphRequestError, match=words):
        graph.request(name, payload)
    assert not graph.waiting


# D9, D10, D11
def test_a_sub_map_is_found_in_another_with_landmarks_in_corners(trip) -> None:
    first, second = (extract_walls(trip[0][k], CONFIG.match) for k in (0, 2))
    found = find(second, first, np.array([0.4, -0.3, 0.02]), (0.8, 0.1), CONFIG.match)
    assert found is not None
    np.testing.assert_allclose(
        se2.compose(found.pose, np.array([0.12, -0.10, np.radians(2)])), 0.0, atol=0.015
    )
    assert 2 <= len(found.landmarks) <= CONFIG.match.landmarks
    apart = found.landmarks[1:] - found.landmarks[0]
    assert (np.hypot(*apart.T) >= CONFIG.match.landmark_spacing_m).all()
    spread = np.linalg.svd(found.landmarks - found.landmarks.mean(axis=0), compute_uv=False)
    assert spread[1] > 0.3  # not on one line
    for xy in found.landmarks:
        k = int(np.argmin(np.hypot(*(second.xy - xy).T)))
        assert second.probability[k] > 0.95
        assert second.cornerness[k] > np.median(second.cornerness)
