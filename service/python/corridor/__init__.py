"""Live 2D laser mapping for a vehicle, from Python: docs/api.md has it with examples.

Stamps are ns; lengths m; angles rad, counter-clockwise; axes x forward, y left (ROS REP 103).
"""

from drivers.frames import Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service.api.frames import fix, imu, odometry, scan
from service.api.mapper import Mapper
from service.api.poses import Pose
from service.api.recordings import Recording, read
from service.api.replays import Result, replay
from service.api.stored_map import Map
from service.api.subscription import Subscription, subscribe
from service.errors import ConfigError, CorridorError, InputError, StorageError, UsageError
from service.offline.score.trajectory import Trajectory
from service.outputs import Grid, TileUpdate
from service.version import VERSION

__version__ = VERSION

__all__ = [
    "ConfigError",
    "CorridorError",
    "Frame",
    "GnssFix",
    "Grid",
    "ImuSample",
    "InputError",
    "LaserScan",
    "Map",
    "Mapper",
    "OdometrySample",
    "Pose",
    "Recording",
    "Result",
    "StorageError",
    "Subscription",
    "TileUpdate",
    "Trajectory",
    "UsageError",
    "__version__",
    "fix",
    "imu",
    "odometry",
    "read",
    "replay",
    "scan",
    "subscribe",
]
