"""What a user may write; mypy --strict checks it against the wheel.

Where the wheel gave no types, mypy would find nothing to ignore, and say so.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

import corridor


def ends_of(path: Path) -> npt.NDArray[np.float64]:
    recording = corridor.read(path, scan_topics=["/scan"])
    mapper = corridor.Mapper(recording, {"rear": recording.mountings["front"]})
    for frame in recording:
        if isinstance(frame, corridor.LaserScan) and np.isfinite(frame.range_m).sum() < 10:
            continue
        pose = mapper.process(frame)
        if pose is not None:
            x_m: str = pose.x_m  # type: ignore[assignment]
            print(x_m, pose.state, pose.covariance[0, 0])
    grid = mapper.map()
    if grid is not None:
        print(grid.cells.shape, grid.cell_m, mapper.save("map"))
    result = corridor.replay(path, profile="corridor")
    result.plot().set_title("map")
    ends: npt.NDArray[np.float64] = result.trajectory.pose[[0, -1]]
    return ends


def follow(endpoint: str) -> None:
    with corridor.subscribe(endpoint, "pose") as poses:
        for pose in poses:
            print(pose.x_m, pose.y_m, pose.theta_rad)


def where(range_m: list[float]) -> corridor.Pose | None:
    scan = corridor.scan(range_m, -1.5, 0.01, 0)
    try:
        return corridor.Map.load("map").localize(scan, mountings={"laser": (0.2, 0.0, 0.0)})
    except corridor.InputError as error:
        print(error)
        return None
