"""A client of the service as a node of ROS 2: lists, subscribes, calls, and stays while it is restarted.

Types, hashes and quality of service are computed here from the definitions that rosbags brings.
"""

import threading
import time
from itertools import pairwise

import numpy as np
from reporting import expect, facts, report
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_service_names_and_types, get_topic_info, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.utils import compute_service_type_hash, get_type_hash

TIMEOUT_S = 30.0
GAP_S = 0.3  # of silence is a restart: nothing here comes that seldom, but for /diagnostics
# As published with ROS 2; the SDK computes no hash of a service with an empty request.
TRIGGER = "std_srvs/srv/Trigger"
TRIGGER_HASH = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
INITIAL_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
SERVICES = {  # nav2_msgs as it stands in navigation2
    "nav2_msgs/srv/LoadMap": ("string map_url", "nav_msgs/OccupancyGrid map\nuint8 result"),
    "nav2_msgs/srv/SaveMap": (
        "string map_topic\nstring map_url\nstring image_format\nstring map_mode\n"
        "float32 free_thresh\nfloat32 occupied_thresh",
        "bool result",
    ),
}
JAZZY = get_typestore(Stores.ROS2_JAZZY)


def definitions(message_type: str) -> dict[str, str]:
    """Definition text of a message and of all it contains, by type."""
    whole, _ = JAZZY.generate_msgdef(message_type, ros_version=2)
    head, *nested = whole.split("=" * 80 + "\nMSG: ")
    parts = {message_type: head}
    for part in nested:
        name, _, text = part.partition("\n")
        package, _, short = name.partition("/")
        parts[f"{package}/msg/{short.rpartition('/')[2]}"] = text
    return parts


def message_hash(message_type: str) -> str:
    parts = definitions(message_type)
    return get_type_hash(message_type, parts.pop(message_type), parts)


def common(message_type: str) -> dict[str, object]:
    """Arguments of publishers and subscribers of the SDK."""
    whole, _ = JAZZY.generate_msgdef(message_type, ros_version=2)
    described = {"msg_type": message_type, "msg_definition": whole, "type_hash": message_hash(message_type)}
    return described | ROUTER


class Inbox:
    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.messages: list[object] = []
        self.arrived_s: list[float] = []

    def __call__(self, message: object) -> None:
        with self._changed:
            self.messages.append(message)
            self.arrived_s.append(time.time())
            self._changed.notify_all()

    def wait(self, what: str, count: int) -> None:
        with self._changed:
            there = self._changed.wait_for(lambda: len(self.messages) >= count, TIMEOUT_S)
        expect(there, f"{what}: {len(self.messages)} messages, expected {count}")

    def first_after_gap(self, topic: str, since_s: float) -> float:
        """When the first message came after the longest silence since then; two must have come."""
        deadline_s = time.monotonic() + TIMEOUT_S
        while True:
            with self._changed:
                at_s = [since_s, *(at for at in self.arrived_s if at > since_s)]
                gap_s, after_s = max(((b - a, b) for a, b in pairwise(at_s)), default=(0.0, 0.0))
                if gap_s > GAP_S and at_s[-1] > after_s:
                    return after_s
                expect(time.monotonic() < deadline_s, f"{topic} did not come back")
                self._changed.wait(0.1)


WANTED = facts()
ROUTER = {"router_ip": "127.0.0.1", "router_port": WANTED["port"], "domain_id": WANTED["domain"]}


def subscribe(topic: str, inbox: Inbox, qos: QosProfile | None = None) -> ROS2Subscriber:
    return ROS2Subscriber(topic=topic, callback=inbox, qos=qos, **common(WANTED["topics"][topic][0]))


def check_topics() -> None:
    listed = {topic: types for topic, types in get_topic_names_and_types(**ROUTER)}
    for topic, (message_type, qos) in WANTED["topics"].items():
        expect(listed.get(topic) == [message_type], f"{topic} has the types {listed.get(topic)}")
        info = get_topic_info(topic, verbose=True, **ROUTER)
        expect(info.publisher_count == 1, f"{topic} has {info.publisher_count} publishers")
        (shown,) = info.publishers
        seen = QosProfile.decode(shown.qos)
        expect(
            [seen.reliability.name, seen.durability.name, seen.history_depth] == qos, f"{topic} offers {seen}"
        )
        expect(shown.type_hash == message_hash(message_type), f"{topic} has the hash {shown.type_hash}")
        expect(shown.node_name == "corridor", f"{topic} belongs to {shown.node_name}")
    expect(listed.get("/initialpose") == [INITIAL_POSE], "/initialpose is missing")
    services = {name: types for name, types in get_service_names_and_types(**ROUTER)}
    wanted = {name: [kind] for name, kind in WANTED["services"].items()}
    expect(services == wanted, f"services are {services}")


def call(name: str, **request: object) -> object:
    """The response of one call."""
    service_type = WANTED["services"][name]
    if service_type == TRIGGER:
        request_text, response_text, type_hash = "", "bool success\nstring message", TRIGGER_HASH
    else:
        request_text, response_text = SERVICES[service_type]
        nested = definitions("nav_msgs/msg/OccupancyGrid") if "OccupancyGrid" in response_text else {}
        type_hash = compute_service_type_hash(service_type, request_text, response_text, nested)
    client = ROS2ServiceClient(
        name,
        service_type,
        request_definition=request_text,
        response_definition=response_text,
        type_hash=type_hash,
        timeout=TIMEOUT_S,
        **ROUTER,
    )
    response = client.call(**request)
    client.close()
    expect(response is not None, f"{name} was not answered")
    return response


def check_services() -> None:
    for verb in ("pause", "resume", "save"):
        response = call(f"/corridor/{verb}")
        expect(response.success, f"{verb}: {response.message}")
    common = {"map_topic": "", "map_mode": "trinary", "free_thresh": 0.25, "occupied_thresh": 0.65}
    response = call("/corridor/save_map", map_url="office", image_format="pgm", **common)
    expect(response.result, "save_map failed")
    expect(call("/corridor/load_map", map_url="nowhere").result == 1, "load_map finds what is not there")


def check_pose(diagnostics: Inbox) -> None:
    """A pose on /initialpose becomes a command, which /diagnostics counts."""
    publisher = ROS2Publisher(topic="/initialpose", **common(INITIAL_POSE))
    types = publisher.session_mgr.store.types
    make = {name.rpartition("/")[2]: made for name, made in types.items()}
    publisher.publish(
        header=make["Header"](stamp=make["Time"](sec=1, nanosec=0), frame_id="map"),
        pose=make["PoseWithCovariance"](
            pose=make["Pose"](
                position=make["Point"](x=0.25, y=0.5, z=0.0),
                orientation=make["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            ),
            covariance=np.zeros(36),
        ),
    )
    for _ in range(10):
        diagnostics.wait("/diagnostics", len(diagnostics.messages) + 1)
        if was_set(diagnostics.messages):
            return
    expect(False, "the pose on /initialpose did not arrive")


def was_set(diagnostics: list[object]) -> bool:
    """Whether the service counts a command set_pose."""
    rows = {row.name: row for message in diagnostics[-1:] for row in message.status}
    return any(value.key == "set_pose" for value in rows["commands"].values)


def main() -> None:
    boxes = {topic: Inbox() for topic in WANTED["topics"] if topic not in ("/map", "/tf_static")}
    subscribers = [subscribe(topic, box) for topic, box in boxes.items()]
    for topic, box in boxes.items():
        box.wait(topic, 3)
    check_topics()
    latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
    late = {topic: Inbox() for topic in ("/map", "/tf_static")}
    began_s = time.monotonic()
    subscribers += [subscribe(topic, box, latched) for topic, box in late.items()]
    for topic, box in late.items():
        box.wait(topic, 1)
    late_s = time.monotonic() - began_s
    known = int((late["/map"].messages[0].data >= 0).sum())
    expect(known > 100, f"the map has {known} known cells")
    check_services()
    check_pose(boxes["/diagnostics"])
    heard = {topic: len(box.messages) for topic, box in boxes.items()}
    print("restart", flush=True)
    gone_s = time.time()
    input()  # until it is done
    back_at_s = {topic: box.first_after_gap(topic, gone_s) for topic, box in boxes.items()}
    check_topics()
    for subscriber in subscribers:
        subscriber.close()
    report(messages=sum(heard.values()), late_s=late_s, known=known, back_at_s=back_at_s)


main()
