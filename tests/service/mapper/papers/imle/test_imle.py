"""The search window of the profile imle."""

from dataclasses import replace

import numpy as np

from tests.service.mapper.drives import ROOM, drive, mapper_of, outputs_of, round_the_room, scans_of


# C4
def test_the_window_is_three_times_the_error_of_icp_between_its_bounds() -> None:
    scans = scans_of(drive(ROOM, round_the_room, 1.5).frames)[::10]
    noisy = np.random.default_rng(1)
    rough = [
        replace(s, range_m=(s.range_m + 0.05 * noisy.standard_normal(541)).astype(np.float32)) for s in scans
    ]
    windows = []
    for frames in (scans, rough):
        mapper = mapper_of("imle")
        outputs_of(mapper, frames)
        windows.append(mapper.components.matcher.window_m)
    assert 0.05 <= windows[0] < windows[1] <= 0.5


# C6
def test_narrowing_asks_a_fraction_of_the_candidates_of_the_literal_search() -> None:
    still = drive(ROOM, lambda _: round_the_room(0.0), 0.1, wheel_scale=None)
    counts, poses = [], []
    for search in ("narrowing", "exhaustive"):
        settings = {"search": search, "least_window_m": 0.2, "refine": False}
        mapper = mapper_of("imle", settings={"matcher": settings})
        outputs_of(mapper, still.frames[:1])
        components = mapper.components
        predicted = components.motion_model.predict(still.frames[1].stamp_ns)
        points = components.deskew(still.frames[1], predicted)
        measured = components.matcher.match(points, predicted, components.local_map).measured
        counts.append(components.matcher.evaluated)
        poses.append(measured.pose_odom_base)
    assert counts[1] >= 41 * 41 * 81
    assert counts[0] < counts[1] / 30
    assert poses[0] == poses[1]
