"""Topics and frames of a recording that are chosen by name."""

from pydantic import Field, field_validator

from service.conversion import ConversionConfig


class Choice(ConversionConfig):
    """`replay` in a config, and options of the same names.

    scan_topics   whose scans are used: LaserScan, MultiEchoLaserScan or PointCloud2; none: see sources
    odom_topic    nav_msgs/Odometry, or a topic of /tf: the edge from the odometry's frame to the base in it
    imu_topic     sensor_msgs/Imu
    base_frame    what mountings are counted from and the odometry moves
    odom_frame    header.frame_id of the odometry, or the frame above the base in /tf
    """

    scan_topics: tuple[str, ...] = ()
    odom_topic: str | None = Field(default=None, min_length=1)
    imu_topic: str | None = Field(default=None, min_length=1)
    base_frame: str | None = Field(default=None, min_length=1)
    odom_frame: str | None = Field(default=None, min_length=1)

    @field_validator("base_frame", "odom_frame")
    @classmethod
    def _as_in_tf_2(cls, frame: str | None) -> str | None:
        """tf 1 wrote "/base_link"."""
        return None if frame is None else frame.removeprefix("/")

    @property
    def is_open(self) -> bool:
        """Whether no topic and no frame is named."""
        return not (
            self.scan_topics or self.odom_topic or self.imu_topic or self.base_frame or self.odom_frame
        )

    def over(self, other: "Choice") -> "Choice":
        """This choice, and what it leaves open from the other."""
        return other.model_copy(update={name: getattr(self, name) for name in self.model_fields_set})


NO_CHOICE = Choice()
