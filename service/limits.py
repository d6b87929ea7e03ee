"""How much is taken in of a file that is read: its sizes and counts are claims. All limits stand here.

CORRIDOR_FILE_LIMITS in the environment multiplies all of them, for files whose writer is trusted.
"""

import os

from service.errors import InputError, UsageError

SETTING = "CORRIDOR_FILE_LIMITS"

MAX_TEXT_BYTES = 256 << 20  # of a text that is read whole: a trajectory of 20 hours at 50 Hz has 250 MB
MAX_YAML_BYTES = 1 << 20  # of maps of ROS, and of bags; the parser takes 10 s for them
MAX_LINE_BYTES = 1 << 20  # of a CARMEN log: a scan of 100 000 beams
MAX_LOG_BYTES = 2 << 30  # of a CARMEN log, unpacked; all of it is kept in memory to be put in order
MAX_ARRAYS_BYTES = 1 << 30  # of one file of a stored map, unpacked: 16 km2 at 5 cm have 6 GB, an office 1 MB
MAX_MAP_BYTES = 16 << 30  # files of one version of a stored map
MAX_IMAGE_BYTES = 1 << 30  # of the picture of a ROS map, unpacked
MAX_MEMBERS = 100_000  # arrays of one file, and files of one map
MAX_CHUNK_BYTES = 256 << 20  # of a recording, unpacked; writers use 1 to 4 MB
MAX_CHUNK_RECORDS = 1_000_000  # in one chunk; messages of an IMU are 300 bytes
MAX_WAITING_BYTES = 1 << 30  # messages read ahead, where chunks of a recording overlap in time
MAX_SENSOR_TOPICS = 200  # of a recording: its beginning is read once for each
MAX_MESSAGE_BYTES = 256 << 20  # that was compressed alone
MAX_RATIO = 1000  # unpacked to packed, of a whole file; a laser before which nothing stands comes to 300
FREE_BYTES = 16 << 20  # that any file may become, whatever its own size
MAX_XZ_BYTES = 256 << 20  # memory of the decompressor; xz -9 needs 65 MB


class TooLargeError(InputError):
    """A file asks for more than a limit allows."""


def factor() -> float:
    """By which all limits are multiplied. Raises UsageError."""
    given = os.environ.get(SETTING, "1")
    try:
        value = float(given)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e9:
        raise UsageError(f"{SETTING}={given}: expected a factor above 0 and below 1e9, such as 4")
    return value


def check(figure: int, limit: int, what: str, unit: str = "bytes") -> None:
    """Raises TooLargeError where `figure` is beyond the limit; `what` names the file, and what is large."""
    if figure > limit and figure > limit * factor():
        needed = -(-figure // limit)
        raise TooLargeError(
            f"{what}: {figure} {unit}, at most {round(limit * factor())} are read; "
            f"{SETTING}={needed} in the environment lifts that, for a file that is trusted"
        )


class Unpacking:
    """Counts what one file becomes when it is unpacked."""

    def __init__(self, what: object, packed_bytes: int) -> None:
        self._what = what
        self._limit = FREE_BYTES + MAX_RATIO * packed_bytes
        self._so_far = 0

    @property
    def left(self) -> int:
        """Bytes that may still come."""
        return max(round(self._limit * factor()) - self._so_far, 0)

    def take(self, count: int) -> None:
        """Before so many bytes more. Raises TooLargeError."""
        self._so_far += count
        check(self._so_far, self._limit, f"{self._what}: unpacked")
