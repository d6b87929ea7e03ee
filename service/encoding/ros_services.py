"""The ROS 2 services that the service offers: requests and responses as CDR, and their type hashes.

Registered with the type store when the first one is used; a service without ROS 2 does not pay for them.
"""

from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from drivers.counted import counted
from service.encoding.ros_messages import Members, members_of
from service.encoding.wire import store
from service.errors import InputError

TRIGGER = "std_srvs/srv/Trigger"
LOAD_MAP = "nav2_msgs/srv/LoadMap"
SAVE_MAP = "nav2_msgs/srv/SaveMap"

SUCCESS, MAP_DOES_NOT_EXIST, UNDEFINED_FAILURE = 0, 1, 255  # results of LOAD_MAP

# By service: the fields of request and response, written as in ros_messages.py
_DEFINITIONS = {
    TRIGGER: ("", "bool success; string message"),
    LOAD_MAP: ("string map_url", "nav_msgs/OccupancyGrid map; uint8 result"),
    SAVE_MAP: (
        "string map_topic, map_url, image_format, map_mode; float32 free_thresh, occupied_thresh",
        "bool result",
    ),
}
_EVENT_INFO = "uint8 event_type; builtin_interfaces/Time stamp; uint8[16] client_gid; int64 sequence_number"


def service_hash(service: str) -> str:
    """ROS 2 type hash (REP 2011), "RIHS01_..."."""
    return _store().hash_rihs01(service)


def read_request(service: str, payload: bytes) -> Any:
    """The request in a payload. Raises InputError where the bytes are none."""
    try:
        return _store().deserialize_cdr(payload, f"{service}_Request")
    except SerdeError as error:
        raise InputError(
            f"{counted(len(payload), 'byte')} cannot be read as a request to {service}: {error}"
        ) from error


def encode_response(service: str, **fields: Any) -> bytes:
    """Raises TypeError where the fields are not those of the response."""
    name = f"{service}_Response"
    return bytes(_store().serialize_cdr(_store().types[name](**fields), name, little_endian=True))


@lru_cache(maxsize=1)
def _store() -> Typestore:
    """The messages of the wire and the services."""
    types: dict[str, Any] = {"service_msgs/msg/ServiceEventInfo": members_of(_EVENT_INFO)}
    for service, (request, response) in _DEFINITIONS.items():
        types |= _types(service, request, response)
    store().register(types)
    return store()


def _types(service: str, request: str, response: str) -> dict[str, Members]:
    """Request and response, and the rest that the type hash of a service covers."""
    at_most_one = {
        part: (Nodetype.SEQUENCE, ((Nodetype.NAME, f"{service}_{part.title()}"), 1))
        for part in ("request", "response")
    }
    event = [("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")), *at_most_one.items()]
    parts = ("request", "response", "event")
    return {
        f"{service}_Request": members_of(request),
        f"{service}_Response": members_of(response),
        f"{service}_Event": ([], event),
        service: ([], [(f"{part}_message", (Nodetype.NAME, f"{service}_{part.title()}")) for part in parts]),
    }
