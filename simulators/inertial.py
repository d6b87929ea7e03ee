"""What an inertial unit with a GNSS receiver measures on the vehicle: the truth with the sensors' errors.

The vehicle rides in a plane: it turns about the vertical, gravity is along it. The world lies on the earth at
a datum. As with the other truths, everything is a function of moment and seed, not of the order of calls.
"""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from simulators.trajectory import Floats
from simulators.truth import Ride, noise_of

HALF_STEP_S = 0.005  # accelerations are differences of the drive's twist over twice this
BIAS_STEP_S = 1.0
BIAS_BLOCK = 600  # steps sampled at a time
GNSS_STEP_S = 30.0  # between independent errors of the receiver; straight in between
VELOCITY_STEP_S = 5.0  # the same of the filter's velocity
RECEIVER_VELOCITY_SIGMA_MPS = 0.1  # each direction; u-blox 6 data sheet, velocity accuracy
FILTER_VELOCITY_SIGMA_MPS = 0.05  # MTi-G leaflet: 0.1 m/s

WGS84_A_M, WGS84_E2 = 6_378_137.0, 6.694_379_990_14e-3


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Samples in the sensor's axes: x forward, y left, z up."""

    rate_radps: Floats  # (N, 3)
    force_mps2: Floats  # (N, 3) specific force: +g on z at rest
    enu_from_sensor: Floats  # (N, 3, 3) rotation to east, north, up


@dataclass(frozen=True, slots=True)
class Place:
    """Solution of the receiver for its antenna, or of the filter for the unit itself."""

    latitude_deg: float
    longitude_deg: float
    height_m: float  # above the ellipsoid
    velocity_enu_mps: tuple[float, float, float]
    horizontal_accuracy_m: float
    vertical_accuracy_m: float
    satellites: int


class InertialSource(Protocol):
    """The measurements of a fake inertial unit."""

    def inertial(self, stamps_ns: npt.NDArray[np.int64]) -> Inertial: ...

    def place(self, stamp_ns: int) -> Place | None:
        """The receiver's solution; None without satellites."""
        ...

    def estimates(self, stamps_ns: npt.NDArray[np.int64]) -> list[Place] | None:
        """Solution of the filter of unit and receiver, one each stamp; None without satellites."""
        ...


@dataclass(frozen=True, slots=True)
class ImuModel:
    """Errors: white noise by density, and a bias with a random start that walks randomly.

    A bias begins with a standard deviation of its stability and walks by as much again in bias_time_s.
    """

    gyro_density_radps: float = math.radians(0.05)  # per square root of Hz
    gyro_stability_radps: float = math.radians(200.0 / 3600.0)
    accelerometer_density_mps2: float = 0.002
    accelerometer_stability_mps2: float = 0.02
    bias_time_s: float = 600.0
    bandwidth_hz: float = 40.0
    attitude_sigma_rad: float = math.radians(0.3)  # roll and pitch of the filter, constant over a run
    heading_sigma_rad: float = math.radians(1.0)
    gravity_mps2: float = 9.81


# Bias stability 200 deg/h and 2000 mGal: as published for the MTi-G in laser mapping with an OWOLM; densities
# and bandwidth from the MTi-G leaflet.
MTI_G = ImuModel()
PERFECT_IMU = ImuModel(0.0, 0.0, 0.0, 0.0, attitude_sigma_rad=0.0, heading_sigma_rad=0.0)


@dataclass(frozen=True, slots=True)
class Datum:
    """Where the world's origin lies on the earth, and the heading of its x axis (0 east, pi/2 north)."""

    latitude_deg: float = 60.161
    longitude_deg: float = 24.546
    height_m: float = 52.0
    heading_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class ImuMounting:
    """Of the sensor in the base frame; the antenna from there as well."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    antenna_x_m: float = 0.0
    antenna_y_m: float = 0.0


@dataclass(slots=True)
class InertialTruth:
    """InertialSource of an inertial unit on the riding vehicle.

    gnss_sigma_m  of the receiver, in each direction; None: no satellites
    """

    ride: Ride
    sensor: str
    mounting: ImuMounting = field(default_factory=ImuMounting)
    model: ImuModel = MTI_G
    seed: int = 0
    datum: Datum = field(default_factory=Datum)
    gnss_sigma_m: float | None = 1.5
    _bias: Floats = field(init=False)
    _attitude_error_rad: Floats = field(init=False)

    def __post_init__(self) -> None:
        m = self.model
        noise = noise_of(self.seed, self.sensor, -1)
        start = noise.standard_normal(6)
        self._bias = (start * self._stability()).reshape(1, 6)  # at each step since the ride began
        sigma = np.array([m.attitude_sigma_rad, m.attitude_sigma_rad, m.heading_sigma_rad])
        self._attitude_error_rad = sigma * noise.standard_normal(3)

    def _stability(self) -> Floats:
        m = self.model
        return np.repeat([m.gyro_stability_radps, m.accelerometer_stability_mps2], 3)

    def inertial(self, stamps_ns: npt.NDArray[np.int64]) -> Inertial:
        """Rates and specific forces at these moments, and the orientation the filter would give."""
        time_s = self._drive_s(stamps_ns)
        drive, mounting, m = self.ride.world.drive, self.mounting, self.model
        speed, turn = drive.twists(time_s).T
        before, after = drive.twists(time_s - HALF_STEP_S), drive.twists(time_s + HALF_STEP_S)
        gain, spin_up = ((after - before) / (2 * HALF_STEP_S)).T
        ahead = gain - spin_up * mounting.y_m - turn**2 * mounting.x_m
        left = speed * turn + spin_up * mounting.x_m - turn**2 * mounting.y_m
        c, s = math.cos(mounting.yaw_rad), math.sin(mounting.yaw_rad)
        zero = np.zeros_like(turn)
        gravity = np.full_like(turn, m.gravity_mps2)
        exact = np.column_stack([zero, zero, turn, c * ahead + s * left, c * left - s * ahead, gravity])
        density = np.repeat([m.gyro_density_radps, m.accelerometer_density_mps2], 3)
        white = density * math.sqrt(m.bandwidth_hz) * self._white(stamps_ns)
        felt = exact + self.bias_at(stamps_ns) + white
        heading = drive.poses(time_s)[:, 2] + self.datum.heading_rad + mounting.yaw_rad
        return Inertial(felt[:, :3], felt[:, 3:], self._rotations(heading))

    def _drive_s(self, stamps_ns: npt.NDArray[np.int64]) -> Floats:
        since_s: Floats = (stamps_ns - self.ride.start_ns).astype(np.float64) * 1e-9
        return since_s + self.ride.drive_s(self.ride.start_ns)

    def _white(self, stamps_ns: npt.NDArray[np.int64]) -> Floats:
        moments = (stamps_ns - self.ride.start_ns).tolist()
        return np.array([noise_of(self.seed, self.sensor, k).standard_normal(6) for k in moments])

    def bias_at(self, stamps_ns: npt.NDArray[np.int64]) -> Floats:
        """(N, 6) of the gyroscopes, rad/s, and the accelerometers, m/s^2."""
        place = np.maximum((stamps_ns - self.ride.start_ns) * (1e-9 / BIAS_STEP_S), 0.0)
        step = place.astype(np.int64)
        while step.max() + 1 >= len(self._bias):
            noise = noise_of(self.seed, f"{self.sensor} bias", len(self._bias) // BIAS_BLOCK)
            walk = noise.standard_normal((BIAS_BLOCK, 6))
            walk *= self._stability() * math.sqrt(BIAS_STEP_S / self.model.bias_time_s)
            self._bias = np.vstack([self._bias, self._bias[-1] + np.cumsum(walk, axis=0)])
        share = (place - step)[:, None]
        bias: Floats = (1.0 - share) * self._bias[step] + share * self._bias[step + 1]
        return bias

    def _rotations(self, heading: Floats) -> Floats:
        roll, pitch, yaw_error = self._attitude_error_rad
        (cr, sr), (cp, sp) = (math.cos(roll), math.sin(roll)), (math.cos(pitch), math.sin(pitch))
        tilt = np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
        c, s = np.cos(heading + yaw_error), np.sin(heading + yaw_error)
        turn = np.zeros((len(heading), 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
        rotations: Floats = turn @ tilt
        return rotations

    def place(self, stamp_ns: int) -> Place | None:
        """The receiver's solution at this moment; None without satellites."""
        sigma_m = self.gnss_sigma_m
        if sigma_m is None:
            return None
        time_s = self._drive_s(np.array([stamp_ns], dtype=np.int64))
        x, y, theta = self.ride.world.drive.poses(time_s)[0]
        speed, turn = self.ride.world.drive.twists(time_s)[0]
        arm_x, arm_y = self.mounting.antenna_x_m, self.mounting.antenna_y_m
        c, s = math.cos(theta), math.sin(theta)
        velocity = _turned(self.datum.heading_rad + theta, speed - turn * arm_y, turn * arm_x)
        at = _turned(self.datum.heading_rad, x + c * arm_x - s * arm_y, y + s * arm_x + c * arm_y)
        error = sigma_m * self.receiver_error(stamp_ns)
        noise = noise_of(self.seed, f"{self.sensor} doppler", stamp_ns - self.ride.start_ns)
        wrong_mps = self._velocity_sigma(RECEIVER_VELOCITY_SIGMA_MPS) * noise.standard_normal(3)
        return self._found(at, error, (*velocity, 0.0), wrong_mps)

    def estimates(self, stamps_ns: npt.NDArray[np.int64]) -> list[Place] | None:
        """Position and velocity of the unit by the filter at these moments; it follows the receiver's slow
        errors. None without satellites.
        """
        sigma_m = self.gnss_sigma_m
        if sigma_m is None:
            return None
        time_s, mounting = self._drive_s(stamps_ns), self.mounting
        poses, twists = self.ride.world.drive.poses(time_s), self.ride.world.drive.twists(time_s)
        errors_m = sigma_m * self._straight("gnss", GNSS_STEP_S, stamps_ns)
        wrong_mps = self._velocity_sigma(FILTER_VELOCITY_SIGMA_MPS) * self._straight(
            "filter velocity", VELOCITY_STEP_S, stamps_ns
        )
        found = []
        for (x, y, theta), (speed, turn), error, wrong in zip(
            poses.tolist(), twists.tolist(), errors_m, wrong_mps, strict=True
        ):
            c, s = math.cos(theta), math.sin(theta)
            at = _turned(
                self.datum.heading_rad,
                x + c * mounting.x_m - s * mounting.y_m,
                y + s * mounting.x_m + c * mounting.y_m,
            )
            velocity = _turned(
                self.datum.heading_rad + theta, speed - turn * mounting.y_m, turn * mounting.x_m
            )
            found.append(self._found(at, error, (*velocity, 0.0), wrong))
        return found

    def _found(
        self,
        at: tuple[float, float],
        error_m: Floats,
        velocity: tuple[float, float, float],
        wrong_mps: Floats,
    ) -> Place:
        """at: east and north of the datum, m; velocity and its error east, north, up."""
        sigma_m = self.gnss_sigma_m or 0.0
        latitude, longitude = _on_earth(self.datum, at[0] + error_m[0], at[1] + error_m[1])
        east, north, up = (v + float(wrong) for v, wrong in zip(velocity, wrong_mps, strict=True))
        return Place(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=self.datum.height_m + 2.0 * float(error_m[2]),
            velocity_enu_mps=(east, north, up),
            horizontal_accuracy_m=max(1.5 * sigma_m, 0.5),
            vertical_accuracy_m=max(2.5 * sigma_m, 0.8),
            satellites=11,
        )

    def _velocity_sigma(self, sigma_mps: float) -> float:
        """A receiver without position errors has none of velocity."""
        return sigma_mps if self.gnss_sigma_m else 0.0

    def receiver_error(self, stamp_ns: int) -> Floats:
        """(3,) in standard deviations: east, north, up."""
        error: Floats = self._straight("gnss", GNSS_STEP_S, np.array([stamp_ns], dtype=np.int64))[0]
        return error

    def _straight(self, what: str, step_s: float, stamps_ns: npt.NDArray[np.int64]) -> Floats:
        """(N, 3) normal numbers sampled each step_s since the ride began, straight in between."""
        place = (stamps_ns - self.ride.start_ns) * (1e-9 / step_s)
        step = np.floor(place).astype(np.int64)
        first = int(step.min())
        knots = np.array(
            [
                noise_of(self.seed, f"{self.sensor} {what}", k).standard_normal(3)
                for k in range(first, int(step.max()) + 2)
            ]
        )
        share = (place - step)[:, None]
        straight: Floats = (1.0 - share) * knots[step - first] + share * knots[step - first + 1]
        return straight


def _turned(angle_rad: float, x: float, y: float) -> tuple[float, float]:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * x - s * y, s * x + c * y


def _on_earth(datum: Datum, east_m: float, north_m: float) -> tuple[float, float]:
    """Latitude and longitude, deg, of a position near the datum, by the ellipsoid's radii of curvature."""
    sine = math.sin(math.radians(datum.latitude_deg))
    root = math.sqrt(1.0 - WGS84_E2 * sine * sine)
    meridian_m = WGS84_A_M * (1.0 - WGS84_E2) / root**3 + datum.height_m
    parallel_m = (WGS84_A_M / root + datum.height_m) * math.cos(math.radians(datum.latitude_deg))
    return (
        datum.latitude_deg + math.degrees(north_m / meridian_m),
        datum.longitude_deg + math.degrees(east_m / parallel_m),
    )
