"""Clients without and with each role at a service, by real Zenoh sessions over TLS or with passwords."""

import json
import os
from collections.abc import Callable
from functools import partial

import pytest
import zenoh
from pydantic import ValidationError

from drivers.zenoh_config import zenoh_config
from service.errors import StorageError
from service.publishing.commands import Answer
from service.publishing.config import PublishingConfig
from service.publishing.security import SecurityConfig, access_control, link_settings
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.docs.blocks import written_in
from tests.service.publishing.conftest import Inbox, tls
from tests.service.publishing.test_zenoh_publisher import message
from tests.waiting import wait_until

ROOT = "corridor/v1/veh1"
REFUSED_MS = 500  # a client tries for so long
ROLES = {"viewer": ["viewer"], "operator": ["operator"], "vehicle": ["veh1"]}


@pytest.fixture
def requested() -> list[tuple[str, bytes]]:
    return []


@pytest.fixture
def service(site, open_publisher, store, requested) -> ZenohPublisher:
    config = PublishingConfig(
        listen=("tls/127.0.0.1:0",), security={"tls": tls(site, "veh1"), "roles": ROLES}
    )
    opened = open_publisher(config)

    def answer(verb: str, payload: bytes) -> Answer:
        requested.append((verb, payload))
        return Answer(True, b"{}")

    opened.answer_commands(answer)
    put_health(opened)
    return opened


def put_health(service: ZenohPublisher) -> None:
    """And wait until it is the answer to a get."""
    service.put(message("health", 1))
    wait_until(lambda: service.counts()["sent"]["health"])


def answers(session: zenoh.Session, key: str) -> list[str]:
    return [str(reply.ok.key_expr) for reply in session.get(key, timeout=20.0) if reply.ok is not None]


def test_a_viewer_reads_and_commands_nothing(service, client_of, requested):
    viewer = client_of(service.endpoints[0], "viewer")
    assert answers(viewer, f"{ROOT}/health") == [f"{ROOT}/health"]
    for key in (
        f"{ROOT}/cmd/pause",
        f"{ROOT}/cmd/*",
        f"{ROOT}/**",
        "corridor/v1/*/cmd/pause",
        f"{ROOT}/*/pause",
    ):
        assert f"{ROOT}/cmd/pause" not in answers(viewer, key)
    viewer.put(f"{ROOT}/initialpose", b"\0\1\0\0")
    assert answers(viewer, f"{ROOT}/health")  # what it put before has passed, if it passes
    service.close()  # and is judged
    assert requested == []
    assert service.pose_refused == ""


def test_subscribers_of_every_role_get_what_is_published(service, client_of):
    inboxes = []
    for name in ("viewer", "operator", "veh1"):
        inboxes.append(Inbox())
        client = client_of(service.endpoints[0], name)
        client.declare_subscriber(f"{ROOT}/pose", inboxes[-1])
        assert answers(client, f"{ROOT}/health")  # the service knows of the subscriber then
    service.put(message("pose", 1))
    for inbox in inboxes:
        inbox.wait_for(1)


@pytest.mark.parametrize("name", ["viewer", "operator", "veh2"])
def test_a_pose_or_a_map_that_someone_else_sends_reaches_no_subscriber(service, client_of, name):
    """They get those of the service alone. veh2 is of this site, and has no role here."""
    heard, client = Inbox(), client_of(service.endpoints[0], name)
    viewer = client_of(service.endpoints[0], "viewer")
    viewer.declare_subscriber(f"{ROOT}/**", heard)
    assert answers(viewer, f"{ROOT}/health")  # the service knows of the subscriber then
    service.put(message("pose", 1))
    heard.wait_for_one(lambda sample: str(sample.key_expr).endswith("/pose"))
    for key in (f"{ROOT}/pose", f"{ROOT}/map", f"{ROOT}/**", "**"):
        client.put(key, b"FAKE")
    client.delete(f"{ROOT}/pose")
    client.declare_queryable(f"{ROOT}/**", lambda query: query.reply(f"{ROOT}/map", b"FAKE"), complete=True)
    client.liveliness().declare_token(f"{ROOT}/alive/mapping")
    for key in ("map", "graph", "nothing"):  # the service has no map yet, and no answer
        assert answers(viewer, f"{ROOT}/{key}") == []
    assert list(viewer.liveliness().get(f"{ROOT}/alive/**")) == []
    service.put(message("odom", 1))
    heard.wait_for_one(lambda sample: str(sample.key_expr).endswith("/odom"))
    assert b"FAKE" not in [sample.payload.to_bytes() for sample in heard.samples]


def test_a_certificate_of_the_site_without_a_role_reads_nothing(service, client_of):
    assert answers(client_of(service.endpoints[0], "veh2"), f"{ROOT}/health") == []


@pytest.mark.parametrize("name", ["", "other"])
def test_who_has_no_certificate_of_the_site_does_not_connect(service, client_of, site, name):
    with pytest.raises(zenoh.ZError):
        client_of(service.endpoints[0], name and "operator", site / name, timeout_ms=REFUSED_MS)


def test_a_vehicle_publishes_below_its_own_name_alone(site, client_of, open_session):
    """At a router of the site, by the same rules."""
    roles = {"viewer": ["viewer"], "vehicle": ["veh1", "veh2"]}
    security = SecurityConfig(tls=tls(site, "veh1"), roles=roles)
    settings = {"mode": "router", "listen/endpoints": ["tls/127.0.0.1:0"], "adminspace/enabled": True}
    settings |= {"access_control": access_control(security, None), **link_settings(security)}
    router = open_session(zenoh_config(settings))
    (reply,) = list(router.get(f"@/{router.zid()}/router"))
    endpoint = json.loads(reply.ok.payload.to_string())["locators"][0]
    heard = Inbox()
    client_of(endpoint, "viewer").declare_subscriber("corridor/v1/**", heard)
    veh2 = client_of(endpoint, "veh2")
    with (
        veh2.declare_publisher("corridor/v1/veh2/pose") as publisher,
        publisher.declare_matching_listener() as seen,
    ):
        while not publisher.matching_status.matching:
            seen.recv()
        veh2.put("corridor/v1/veh1/pose", b"FAKE")
        publisher.put(b"of veh2")
    heard.wait_for(1)
    assert [sample.payload.to_bytes() for sample in heard.samples] == [b"of veh2"]


@pytest.mark.parametrize(
    ("user", "password", "verbs"), [("operator", "o1", ["pause"]), ("viewer", "v1", []), ("idle", "i1", [])]
)
def test_a_user_has_the_role_of_its_name(
    site, open_publisher, open_session, user, password, verbs, requested
):
    security = {"users": {"file": str(site / "users")}}
    service = open_publisher(PublishingConfig(listen=("tcp/127.0.0.1:0",), security=security))
    service.answer_commands(lambda verb, payload: requested.append(verb) or Answer(True, b"{}"))
    settings = {"mode": "client", "connect/endpoints": service.endpoints}
    by_password = {"transport/auth/usrpwd": {"user": user, "password": password}}
    with pytest.raises(zenoh.ZError):
        open_session(zenoh_config(settings | {"connect/timeout_ms": REFUSED_MS}))
    answers(open_session(zenoh_config(settings | by_password)), f"{ROOT}/cmd/pause")
    assert requested == verbs


def test_programs_of_this_machine_need_no_certificate_at_an_endpoint_of_it(site, open_publisher, open_client):
    listen = ("tcp/127.0.0.1:0", "tls/127.0.0.1:0")
    service = open_publisher(PublishingConfig(listen=listen, security={"tls": tls(site, "veh1")}))
    put_health(service)
    (local,) = [endpoint for endpoint in service.endpoints if endpoint.startswith("tcp/")]
    assert answers(open_client(local), f"{ROOT}/health") == [f"{ROOT}/health"]


def test_on_topics_of_ros_2_viewers_read_operators_call_and_the_vehicles_nodes_publish():
    """By the rules alone: which messages of a role come in, on which keys."""
    rules = security_rules(ros2_domain=7)
    pause, scan, token = "7/corridor/pause/t/h", "7/front/scan/t/h", "@ros2_lv/7/z/0/0/NN/x"
    assert rules["viewer"](scan) == {"declare_subscriber", *LIVELINESS}
    assert rules["viewer"]("7/map/t/h/@adv/pub/z/1/_") == {"query", "declare_subscriber", *LIVELINESS}
    assert rules["operator"](pause) == {"query", "declare_subscriber", *LIVELINESS}
    assert rules["operator"]("7/initialpose/t/h") == {"put", "query", "declare_subscriber", *LIVELINESS}
    assert rules["operator"](token) == {"declare_subscriber", "liveliness_token", *LIVELINESS}
    assert {"put", "reply", "declare_queryable"} < rules["vehicle-veh1"](scan)
    assert rules["vehicle-veh1"]("8/front/scan/t/h") == set()  # another domain
    assert security_rules(None)["operator"](pause) == set()


def test_a_vehicle_commands_itself_and_follows_others():
    rules = security_rules(None)["vehicle-veh1"]
    assert {"query", "put", "reply"} < rules(f"{ROOT}/cmd/pause")
    assert rules("corridor/v1/veh2/cmd/pause") == {"declare_subscriber", *LIVELINESS}
    assert rules("corridor/v1/veh2/pose") == {"declare_subscriber", *LIVELINESS}


def test_the_program_of_docs_security_md_commands_by_a_certificate(
    service, site, monkeypatch, capsys, requested
):
    for kind in ("pem", "key"):
        (site / f"anna.{kind}").write_bytes((site / f"operator.{kind}").read_bytes())
    monkeypatch.chdir(site)
    (block,) = [block for block in written_in("python") if block.page == "docs/security.md"]
    here = block.text.replace("tls/192.168.1.7:7448", service.endpoints[0])
    exec(compile(here, "docs/security.md", "exec"), {})
    assert (capsys.readouterr().out, requested) == ("{}\n", [("pause", b"")])


LIVELINESS = ("declare_liveliness_subscriber", "liveliness_query")


def security_rules(ros2_domain: int | None) -> dict[str, Callable[[str], set[str]]]:
    """Subject -> key -> messages that are let in."""
    security = SecurityConfig(tls={"ca": "a", "certificate": "b", "key": "c"}, roles=ROLES)
    control = access_control(security, ros2_domain)
    rules = {rule["id"]: rule for rule in control["rules"]}

    def let_in(names: list[str], key: str) -> set[str]:
        fitting = [
            rules[name]
            for name in names
            if "ingress" in rules[name]["flows"]
            and any(zenoh.KeyExpr(k).includes(zenoh.KeyExpr(key)) for k in rules[name]["key_exprs"])
        ]
        by = {
            kind: {one for rule in fitting if rule["permission"] == kind for one in rule["messages"]}
            for kind in ("allow", "deny")
        }
        return by["allow"] - by["deny"]

    return {
        policy["subjects"][0].removesuffix("-cert_common_names"): partial(let_in, policy["rules"])
        for policy in control["policies"]
    }


def test_a_late_advanced_subscriber_gets_the_last_message_of_a_viewers_topic(service, client_of):
    heard = Inbox()
    zenoh.ext.declare_advanced_subscriber(
        client_of(service.endpoints[0], "viewer"),
        f"{ROOT}/health",
        heard,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
    )
    heard.wait_for(1)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"listen": ["tcp/0.0.0.0:7447"]},
            r"tcp/0\.0\.0\.0:7447 is open to the network without security; write tls/",
        ),
        ({"connect": ["tcp/site:7447"]}, "or security: none where each machine on the network may command"),
        ({"listen": ["tls/0.0.0.0:7447"]}, "needs security: .*`corridor security init` makes the files"),
        ({"listen": ["tls/[::]:7447"], "security": "none"}, "needs security"),
        ({"listen": ["udp/[::]:7447"], "security": {"users": {"file": "users"}}}, "open to the network"),
        ({"connect": ["tcp/[::1]:1"], "security": {"users": {"file": "users"}}}, "write the user by which"),
        ({"security": {"roles": {"viewer": ["a"], "operator": ["a"]}}}, "a has two roles"),
        ({"security": "None"}, "should be 'none'"),
        ({"security": None}, "should be 'none'"),
        ({"security": {"roles": {"viewer": ["a:b"]}}}, "should match pattern"),
    ],
)
def test_an_endpoint_open_to_any_client_is_refused_with_what_to_write(settings, words):
    with pytest.raises(ValidationError, match=words):
        PublishingConfig(**settings)


def test_security_can_be_declined_in_words():
    config = PublishingConfig(listen=["tcp/0.0.0.0:7447"], security="none")
    assert config.secured is None
    assert PublishingConfig(security={"tls": None, "users": None}).secured is None


def test_files_that_others_may_read_are_refused(site, tmp_path):
    key = tmp_path / "key"
    key.write_bytes((site / "veh1.key").read_bytes())
    key.chmod(0o640)
    security = SecurityConfig(tls=tls(site, "veh1") | {"key": str(key)})
    with pytest.raises(
        StorageError, match=r"others may read the key of publishing.security \(mode 0640\); chmod 600"
    ):
        link_settings(security)
    with pytest.raises(StorageError, match="no line veh1:<password>"):
        link_settings(SecurityConfig(users={"file": str(site / "users"), "name": "veh1"}))
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(StorageError, match=r"pipe: passwords .* a pipe; expected a regular file"):
        link_settings(SecurityConfig(users={"file": str(tmp_path / "pipe"), "name": "veh1"}))
