"""What the stamps of all topics and the time fields of scans are worth: judged in one place, in front of the
mapper, live and in a replay. It reads no clock; log times are all it knows of when a message came.
"""

from service.timing.timing import Timed, Timing

__all__ = ["Timed", "Timing"]
