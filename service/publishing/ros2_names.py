"""Names and types of the ROS 2 topics that the service publishes."""

from collections.abc import Iterable

from service.encoding import DIAGNOSTICS, OCCUPANCY_GRID, ODOMETRY, TF

MAP = "map"
# In the graph from the start, each with its type; the topics of a sensor are there from its first message on.
TOPICS = {
    "pose": ODOMETRY,
    "odom": ODOMETRY,
    "tf": TF,
    "tf_static": TF,
    MAP: OCCUPANCY_GRID,
    "diagnostics": DIAGNOSTICS,
}
OF_SENSORS = frozenset({"scan", "imu", "odom", "fix"})  # last part of "<sensor>/scan"


def own_topics(namespace: str, sensors: Iterable[str]) -> set[str]:
    """Full names of what may be published, with these sensors."""
    names = {*TOPICS, *(f"{sensor}/{last}" for sensor in sensors for last in OF_SENSORS)}
    return {f"{namespace}/{name}" for name in names}
