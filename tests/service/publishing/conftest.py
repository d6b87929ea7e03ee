"""A publisher on a free port, and clients that are always closed."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from drivers.zenoh_config import zenoh_config
from service.mapstore.tiles import TileStore
from service.offline.security.authority import Holder, init_site
from service.publishing.commands import Answer, refusal
from service.publishing.config import PublishingConfig
from service.publishing.zenoh_publisher import ZenohPublisher

ANY_PORT = PublishingConfig(listen=("tcp/127.0.0.1:0",))
TIMEOUT_S = 30.0
HOSTS = ("localhost", "127.0.0.1")


class Inbox:
    """Samples of one subscriber; waits on a condition, with a timeout."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.samples: list[zenoh.Sample] = []

    def __call__(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self.samples.append(sample)
            self._changed.notify_all()

    def wait_for(self, count: int, timeout_s: float = TIMEOUT_S) -> list[zenoh.Sample]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.samples) >= count, timeout_s), (
                f"{len(self.samples)} samples after {timeout_s} s, expected {count}"
            )
            return list(self.samples)

    def wait_for_one(self, wanted: Callable[[zenoh.Sample], bool]) -> zenoh.Sample:
        """The first that is wanted."""
        with self._changed:
            found = self._changed.wait_for(lambda: list(filter(wanted, self.samples)), TIMEOUT_S)
            assert found, f"none of {len(self.samples)} samples after {TIMEOUT_S} s"
            return found[0]


class Asked:
    """What came in; answers with it, or fails, or waits to be let go."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self.entered = threading.Semaphore(0)
        self.go = threading.Event()
        self.go.set()

    def __call__(self, verb: str, payload: bytes) -> Answer:
        self.heard.append((verb, payload))
        self.entered.release()
        assert self.go.wait(20.0)
        if verb == "break":
            raise KeyError("boards")
        return refusal("no") if verb == "refuse" else Answer(True, b'{"ok": true}')


def wait_for_subscriber(publisher: zenoh.Publisher) -> None:
    """Until it knows of one: what is put before is not sent."""
    with publisher.declare_matching_listener() as matching:
        while not publisher.matching_status.matching:
            matching.recv()


def client_config(endpoint: str) -> zenoh.Config:
    return zenoh_config({"mode": "client", "connect/endpoints": [endpoint], "connect/timeout_ms": 20_000})


@pytest.fixture
def store() -> TileStore:
    return TileStore()


@pytest.fixture
def open_publisher(store) -> Iterator[Callable[..., ZenohPublisher]]:
    with ExitStack() as opened:

        def open_one(config: PublishingConfig = ANY_PORT, **settings: object) -> ZenohPublisher:
            source = settings.pop("map_source", store)
            return opened.enter_context(ZenohPublisher(config, "veh1", source, **settings))

        yield open_one


@pytest.fixture
def publisher(open_publisher) -> ZenohPublisher:
    return open_publisher(picture_period_s=0.1)


@pytest.fixture
def requested() -> Asked:
    return Asked()


@pytest.fixture
def served(publisher: ZenohPublisher, requested: Asked) -> Iterator[ZenohPublisher]:
    publisher.answer_commands(requested)
    yield publisher
    requested.go.set()


@pytest.fixture
def open_session() -> Iterator[Callable[[zenoh.Config], zenoh.Session]]:
    """Closed by `close`: the `with` of a session that another thread uses raises, and leaves it open."""
    with ExitStack() as closing:

        def open_one(config: zenoh.Config) -> zenoh.Session:
            session = zenoh.open(config)
            closing.callback(session.close)
            return session

        yield open_one


@pytest.fixture
def open_client(open_session) -> Callable[[str], zenoh.Session]:
    return lambda endpoint: open_session(client_config(endpoint))


@pytest.fixture
def client(publisher, open_client) -> zenoh.Session:
    return open_client(publisher.endpoints[0])


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Certificates by name, those of another site in `other`, and a file of users."""
    folder = tmp_path_factory.mktemp("site")
    names = {"veh1": "vehicle", "veh2": "vehicle", "operator": "operator", "viewer": "viewer"}
    init_site(folder, [Holder(name, role, HOSTS) for name, role in names.items()], days=30)
    init_site(folder / "other", [Holder("operator", "operator", HOSTS)], days=30)
    (folder / "users").write_text("viewer:v1\noperator:o1\nidle:i1\n")
    (folder / "users").chmod(0o600)
    return folder


def tls(site: Path, name: str) -> dict[str, str]:
    return {"ca": str(site / "ca.pem"), "certificate": f"{site}/{name}.pem", "key": f"{site}/{name}.key"}


@pytest.fixture
def client_of(site, open_session) -> Callable[..., zenoh.Session]:
    """A client with the certificate of a name, or with none."""

    def open_one(endpoint: str, name: str = "", folder: Path = site, timeout_ms=20_000) -> zenoh.Session:
        settings = {"root_ca_certificate": str(site / "ca.pem")}
        if name:
            files = tls(folder, name)
            settings |= {"connect_certificate": files["certificate"], "connect_private_key": files["key"]}
            settings |= {"enable_mtls": True}
        return open_session(
            zenoh_config(
                {
                    "mode": "client",
                    "connect/endpoints": [endpoint],
                    "connect/timeout_ms": timeout_ms,
                    "transport/link/tls": settings,
                }
            )
        )

    return open_one
