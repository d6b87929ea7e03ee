"""A child process: two hours round a floor, and the memory they take, as JSON. Argument: SEED."""

import heapq
import json
import math
import pickle
import sys
import time
from collections.abc import Iterator

from drivers.frames import Frame, LaserScan, OdometrySample
from service.compile.warm_up import warm_up
from service.mapper.background import InlineWorker
from service.mapper.papers.submap_graph.graph.landmark_back_end import LandmarkBackEnd
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from simulators.truth import LaserTruth, Ride
from simulators.worlds.floor import floor
from tests.papers.imle_halls import resident_mb
from tests.simulated import FORWARD, LMS100_50HZ, Laser, Wheels, begun_beside, odometry, phase_m, scans_at

HOURS_S = 7200.0
REPORTED_S = 600.0
CART = Laser(LMS100_50HZ.model, 541, 5.0, -135.0, 0.5)  # every tenth sweep


def mapper_and_back_ends() -> tuple[Mapper, list[LandmarkBackEnd]]:
    """With the graph in this process; the list holds its back end."""
    back_ends: list[LandmarkBackEnd] = []

    def new_worker(back_end: LandmarkBackEnd) -> InlineWorker:
        back_ends.append(back_end)
        return InlineWorker(back_end)

    config = mapping_config({"profile": "submap_graph"})
    return build_mapper(config, {"front": FORWARD}, new_worker=new_worker), back_ends  # type: ignore[arg-type]


def frames(ride: Ride, wheels: list[OdometrySample], seconds: float, seed: int) -> Iterator[Frame]:
    """In order of arrival; each scan is made when it is due, so that none stays in memory."""
    source = LaserTruth(ride, CART.name, CART.mounting, CART.model, seed)
    stamps_ns = range(0, round(seconds * 1e9), CART.period_ns)
    scans: Iterator[LaserScan] = (
        scan for at_ns in stamps_ns for scan in scans_at(source, CART, at_ns, [seed])
    )
    return heapq.merge(wheels, scans, key=lambda frame: frame.arrived_ns)


def main(seed: int, seconds: float) -> None:
    ride = Ride(begun_beside(floor(layout=seed), *phase_m(seed)), 0, 0.5)
    wheels = odometry(ride, Wheels(scale=1.01, turn_scale=1.01), seconds, seed)
    warm_up()
    mapper, back_ends = mapper_and_back_ends()
    before_mb, first, facts, began_s, worked_s = resident_mb(), ride.pose(0), [], time.thread_time(), 0.0
    for frame in frames(ride, wheels, seconds, seed):
        output = mapper.process(frame)
        while mapper.graph.waiting:
            at_s = time.thread_time()
            mapper.apply_result()
            worked_s += time.thread_time() - at_s
        if (
            output is None
            or output.stamp_ns * 1e-9 < REPORTED_S * (len(facts) + 1) - 1.5 * CART.period_ns * 1e-9
        ):
            continue
        off = (first.inverse() @ ride.pose(output.stamp_ns)).inverse() @ output.pose_map_base
        facts.append(
            {
                "minutes": output.stamp_ns * 1e-9 / 60.0,
                "path_m": back_ends[0].path_length_m[-1],
                "submaps": len(back_ends[0].submaps),
                "resident_mb": resident_mb() - before_mb,
                "off_m": math.hypot(off.x_m, off.y_m),
                "cpu_s": time.thread_time() - began_s,
            }
        )
        print(json.dumps(facts[-1]), file=sys.stderr, flush=True)
    print(json.dumps({"hours": facts, "graph_mb": len(pickle.dumps(back_ends[0])) / 1e6}))


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else HOURS_S)
