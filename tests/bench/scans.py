"""What a scan costs the mapper, by number of beams, matching and updating apart."""

import numpy as np

from service.compile.warm_up import warm_up
from service.mapper.profiles import build_mapper, mapping_config
from service.offline.replay.figures import ComponentTimes
from simulators.truth import LMS100
from simulators.worlds import build_world
from tests.simulated import Laser, Wheels, drive

DRIVE_S = 30.0


def measure() -> list[tuple[str, float, str]]:
    warm_up()
    rows = []
    wheels = Wheels(sigma_m_per_sqrt_m=0.0, sigma_rad_per_sqrt_m=0.0)
    for beams, rate_hz, step_deg in ((541, 50, 0.5), (1081, 25, 0.25)):
        times = ComponentTimes()
        laser = Laser(LMS100, beams, rate_hz, -135.0, step_deg)
        mapper = build_mapper(mapping_config(), {laser.name: laser.mounting}, times)
        for frame in drive(build_world("office"), laser, DRIVE_S, 1, wheels).frames:
            mapper.process(frame)
        laps_ms = {component: np.array(laps) / 1e6 for component, laps in times.laps_ns.items()}
        whole_ms = np.sum(list(laps_ms.values()), axis=0)
        rows += [
            (f"{beams} beams: scan p50", float(np.median(whole_ms)), "ms"),
            (f"{beams} beams: scan p99", float(np.percentile(whole_ms, 99)), "ms"),
            *(
                (f"{beams} beams: {component} p50", float(np.median(ms)), "ms")
                for component, ms in laps_ms.items()
            ),
            (f"{beams} beams: insert mean", float(laps_ms["insert"].mean()), "ms"),
        ]
    return rows
