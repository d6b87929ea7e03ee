import math

import numpy as np
import pytest

from service.errors import InputError
from service.geometry.se2 import SE2
from service.offline.score.score import score
from service.offline.score.trajectory import write_tum

S = 1_000_000_000


def tum(path, stamps_ns, poses):
    write_tum(path, zip(stamps_ns, poses, strict=True))
    return path


def relations(path, rows):
    """rows: stamp 1, stamp 2 in seconds, SE2."""
    path.write_text(
        "# made by hand\n"
        + "".join(f"{a:.6f} {b:.6f} {r.x_m!r} {r.y_m!r} 0 0 0 {r.theta_rad!r}\n" for a, b, r in rows)
    )
    return path


def wander(count: int, seed: int) -> list[SE2]:
    random = np.random.default_rng(seed)
    poses = [SE2()]
    for _ in range(count - 1):
        poses.append(poses[-1] @ SE2.exp(random.uniform(0.1, 0.5), 0.0, random.normal(0.0, 0.2)))
    return poses


def noisy(poses: list[SE2], seed: int) -> list[SE2]:
    random = np.random.default_rng(seed)
    return [p @ SE2(*random.normal(0.0, 0.05, 2), random.normal(0.0, 0.02)) for p in poses]


def size(error: SE2) -> tuple[float, float]:
    return math.hypot(error.x_m, error.y_m), abs(math.degrees(error.theta_rad))


def assert_spread(spread, values) -> None:
    values = np.array(values)
    expected = [values.mean(), values.std(ddof=1), values.max(), math.sqrt((values**2).mean())]
    np.testing.assert_allclose([spread.mean, spread.std, spread.max, spread.rms], expected, atol=1e-7)


def test_both_orders_of_the_relations_error_agree_with_pose_by_pose_reckoning(tmp_path):
    truth = wander(60, 1)
    estimate = noisy(truth, 2)
    stamps = [1_000 * S + k * S // 4 for k in range(60)]
    random = np.random.default_rng(3)
    pairs = [sorted(random.choice(60, 2, replace=False).tolist()) for _ in range(40)]
    rows = [(stamps[a] / S, stamps[b] / S, truth[a].inverse() @ truth[b]) for a, b in pairs]
    found = score(tum(tmp_path / "e.tum", stamps, estimate), relations(tmp_path / "t.relations", rows))
    assert (found.pairs_scored, found.pairs_outside, found.pairs_not_near) == (40, 0, 0)
    relative = [estimate[a].inverse() @ estimate[b] for a, b in pairs]
    by_order = {
        "kuemmerle: expected^-1 * relative": [
            r.inverse() @ e for (_, _, r), e in zip(rows, relative, strict=True)
        ],
        "cartographer: relative * expected^-1": [
            e @ r.inverse() for (_, _, r), e in zip(rows, relative, strict=True)
        ],
    }
    assert [errors.order for errors in found.errors] == list(by_order)
    for errors in found.errors:
        distance, angle = np.array([size(error) for error in by_order[errors.order]]).T
        assert_spread(errors.translation_m, distance)
        assert_spread(errors.translation_squared_m2, distance**2)
        assert_spread(errors.rotation_deg, angle)
        assert_spread(errors.rotation_squared_deg2, angle**2)


def test_pairs_outside_and_pairs_far_from_a_scan_are_left_out_and_counted(tmp_path):
    estimate = tum(tmp_path / "e.tum", [10 * S, 11 * S, 12 * S], [SE2(), SE2(1.0), SE2(2.0)])
    rows = [
        (10.0, 12.0, SE2(2.0)),
        (12.0, 10.0, SE2(-2.0)),  # backwards in time is as good
        (10.119, 11.881, SE2(1.762)),
        (10.121, 11.0, SE2(0.879)),
        (11.5, 12.0, SE2(0.5)),
        (9.999, 12.0, SE2(2.0)),
        (10.0, 12.001, SE2(2.0)),
    ]
    truth = relations(tmp_path / "t.relations", rows)
    every, near = score(estimate, truth), score(estimate, truth, pairs="near")
    assert (every.pairs_scored, every.pairs_outside, every.pairs_not_near) == (5, 2, 0)
    assert (near.pairs_scored, near.pairs_outside, near.pairs_not_near) == (3, 2, 2)
    assert every.errors[0].translation_m.max == pytest.approx(0.0, abs=1e-9)
    assert "left out: 2 outside the trajectory, 2 not near a scan" in str(near)


def test_a_shift_is_added_to_the_estimates_stamps(tmp_path):
    estimate = tum(tmp_path / "e.tum", [10 * S, 11 * S], [SE2(), SE2(1.0)])
    truth = relations(tmp_path / "t.relations", [(10.3, 11.3, SE2(1.0))])
    assert score(estimate, truth, shift_s=0.3).errors[0].translation_m.max == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(InputError, match=r"none of 1 pair can be scored: 1 lie outside 10.000 .. 11.000 s"):
        score(estimate, truth)


def test_an_offset_scores_the_frame_ahead(tmp_path):
    """The laser sits 0.4 m ahead of the base, which turns on the spot by 90 degrees."""
    estimate = tum(tmp_path / "e.tum", [0, S], [SE2(), SE2(0.0, 0.0, math.pi / 2)])
    truth = relations(tmp_path / "t.relations", [(0.0, 1.0, SE2(-0.4, 0.4, math.pi / 2))])
    assert score(estimate, truth, offset_x_m=0.4).errors[0].translation_m.max == pytest.approx(0.0, abs=1e-9)
    assert score(estimate, truth).errors[0].translation_m.max == pytest.approx(0.4 * math.sqrt(2.0))


def test_ate_after_alignment_is_that_of_the_rotation_by_svd(tmp_path):
    truth = wander(80, 4)
    frame = SE2(-7.0, 3.0, 2.5)
    estimate = [frame @ pose for pose in noisy(truth, 5)]
    stamps = [k * S // 10 for k in range(80)]
    found = score(tum(tmp_path / "e.tum", stamps, estimate), tum(tmp_path / "t.tum", stamps, truth))

    here, there = (np.array([(p.x_m, p.y_m) for p in poses]) for poses in (estimate, truth))
    u, _, vt = np.linalg.svd((here - here.mean(axis=0)).T @ (there - there.mean(axis=0)))
    turn = u @ vt  # of row vectors
    shift = there.mean(axis=0) - here.mean(axis=0) @ turn
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(found.alignment, [*shift, math.atan2(turn[0, 1], turn[0, 0])], atol=1e-6)
    assert_spread(found.ate_aligned_m, np.hypot(*(here @ turn + shift - there).T))
    as_is = [math.hypot(e.x_m - t.x_m, e.y_m - t.y_m) for e, t in zip(estimate, truth, strict=True)]
    assert_spread(found.ate_m, as_is)
    assert found.ate_deg.mean == pytest.approx(math.degrees(2.5), abs=1.0)
    assert found.ate_aligned_deg.mean < 2.0


def test_rpe_and_closure_agree_with_pose_by_pose_reckoning(tmp_path):
    truth = wander(70, 6)
    estimate = [SE2(5.0, 1.0, 1.0) @ pose for pose in noisy(truth, 7)]
    stamps = [k * S // 10 for k in range(70)]
    found = score(tum(tmp_path / "e.tum", stamps, estimate), tum(tmp_path / "t.tum", stamps, truth))

    def error(a: int, b: int) -> tuple[float, float]:
        true_step, step = truth[a].inverse() @ truth[b], estimate[a].inverse() @ estimate[b]
        return size(true_step.inverse() @ step)

    steps = []
    for a in range(70):
        path_length_m = 0.0
        for b in range(a + 1, 70):
            path_length_m += math.hypot(truth[b].x_m - truth[b - 1].x_m, truth[b].y_m - truth[b - 1].y_m)
            if path_length_m >= 1.0:
                steps.append(error(a, b))
                break
    assert found.rpe_pairs == len(steps)
    assert_spread(found.rpe_m, [distance for distance, _ in steps])
    assert_spread(found.rpe_deg, [angle for _, angle in steps])
    assert (found.closure_m, found.closure_deg) == pytest.approx(error(0, 69), abs=1e-6)


def test_poses_without_a_truth_are_left_out_and_counted(tmp_path):
    truth = tum(tmp_path / "t.tum", [0, S, 4 * S, 5 * S], [SE2(), SE2(1.0), SE2(4.0), SE2(5.0)])
    stamps = [-1, S // 2, S, S + 2_000_000, 2 * S, 4 * S - 500_000, 5 * S, 5 * S + 1]
    estimate = tum(tmp_path / "e.tum", stamps, [SE2(ns / S) for ns in stamps])
    found = score(estimate, truth)
    assert (found.poses_scored, found.poses_left_out) == (4, 4)
    assert found.ate_m.max < 1e-6
    later = tum(tmp_path / "l.tum", [9 * S, 10 * S], [SE2(), SE2(0.5)])
    with pytest.raises(InputError, match=r"a truth is known for 0 of 2 poses; it spans 0.000 .. 5.000 s"):
        score(later, truth)
    short = score(later, later)  # than a step
    assert (short.rpe_pairs, short.rpe_m, short.rpe_deg) == (0, None, None)
    assert "(0 pairs)" in str(short)


@pytest.mark.parametrize(
    ("text", "diagnostic"),
    [
        ("1.0 2.0 3.0\n", r"t\.relations:1: 3 columns; expected 8: stamp1 stamp2"),
        ("1.0 2.0 0 0 0 0 0 0\n1.0 x 0 0 0 0 0 0\n", r"t\.relations:2: 'x' is no time"),
        ("# nothing\n", "no relation in it"),
    ],
)
def test_a_bad_relations_file_is_refused_by_line(tmp_path, text, diagnostic):
    estimate = tum(tmp_path / "e.tum", [0, S], [SE2(), SE2(1.0)])
    (tmp_path / "t.relations").write_text(text)
    with pytest.raises(InputError, match=diagnostic):
        score(estimate, tmp_path / "t.relations")
