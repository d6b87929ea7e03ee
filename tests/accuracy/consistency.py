"""Whether the pose errs by as much as its covariance says."""

from collections.abc import Sequence

import numpy as np

from simulators.worlds import WORLDS
from tests.accuracy.driving import Trip, nees_of
from tests.accuracy.sensors import GOOD_WHEELS, LUX_AHEAD
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, Imu

EXPECTED = 3.0  # of the normalised squared error of a pose
TRIPS = {
    "ring": Trip(WORLDS["ring"], LMS100_50HZ),
    "ring, UTM-30LX": Trip(WORLDS["ring"], UTM30LX_40HZ),
    "ring, laser alone": Trip(WORLDS["ring"], LMS100_50HZ, wheels=None),
    "office": Trip(WORLDS["office"], LMS100_50HZ),
    "office, LUX": Trip(WORLDS["office"], LUX_AHEAD, wheels=GOOD_WHEELS, imu=Imu()),
    "library": Trip(WORLDS["library"], LMS100_50HZ),
    "spins": Trip(WORLDS["spins"], LMS100_50HZ),
    "corridor100": Trip(WORLDS["corridor100"], LMS100_50HZ),
    "corridor100, LUX": Trip(WORLDS["corridor100"], LUX_AHEAD, wheels=GOOD_WHEELS, imu=Imu()),
    "bare corridor": Trip(WORLDS["featureless"], LMS100_50HZ, 100.0),
}


def consistency(seeds: Sequence[int]) -> Section:
    nees = {
        name: [nees_of(done.outputs, done.errors) for _, done in trip.runs(seeds)]
        for name, trip in TRIPS.items()
    }
    every = np.concatenate(list(nees.values()))
    mean, unit = [float(every.mean())], f"of {EXPECTED:.0f}"
    within = 100.0 * float(np.mean((every >= EXPECTED / 3.0) & (every <= 2.0 * EXPECTED)))
    return Section(
        "NEES of the pose",
        f"The normalised squared error of the live pose against the first scan, of every tenth scan; "
        f"{EXPECTED:.0f} is expected: more, and the pose errs by more than its covariance says; less, and it "
        "errs by less. One lap each.",
        [
            *(Row(name, values, unit, digits=2) for name, values in nees.items()),
            Row("mean of all drives", mean, unit, at_most=4.0, digits=2),
            Row("mean of all drives", mean, unit, at_least=2.0, digits=2),
            Row("drives within 1 to 6", [within], "%", at_least=90.0),
        ],
    )
