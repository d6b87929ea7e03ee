"""State of each vehicle at a site's router."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import PurePath
from typing import Any

import zenoh

from drivers.counted import counted
from drivers.rmw_zenoh import Attachment
from service.encoding import ERROR, WARNING, decode_diagnostics, decode_pose
from service.errors import InputError, StorageError
from service.publishing.config import PublishingConfig
from service.publishing.keys import ROOT, vehicle_key
from service.publishing.uplink import PRESENCES, Presence, open_client, presences

LOCAL = "tcp/127.0.0.1:7447"
ANSWER_S = 5.0  # a vehicle has so long to answer
MAX_AGE_S = 60.0  # of a health message; a vehicle sends one a second
FAULTS = {ERROR: "error", WARNING: "warning"}


@contextmanager
def connected(config: PublishingConfig | None) -> Iterator[zenoh.Session]:
    """A client of the router in `connect`; of this machine's own where there is no config or no `connect`.

    Raises StorageError where it does not answer.
    """
    config = config or PublishingConfig()
    session = open_client(config.model_copy(update={"connect": config.connect or (LOCAL,)}))
    try:
        yield session
    finally:
        session.close()  # type: ignore[no-untyped-call]


@dataclass(frozen=True, slots=True)
class Vehicle:
    """State of a vehicle by its last health message. Without one: state "silent"."""

    name: str
    state: str  # of the mapping
    reason: str
    x_m: float | None  # base in map
    y_m: float | None
    heading_deg: float | None
    map: str  # folder of the map, without its path
    map_version: int | None  # of its newest tile
    age_s: float | None  # of the health message, by the clocks of both machines
    free_gb: float | None  # on the disk of the recordings
    corridor: str  # version
    faults: tuple[str, ...]  # rows of its health that are no "ok"
    sessions: tuple[str, ...]  # host and address; two are two vehicles of one name, the first is in the fleet

    @property
    def is_well(self) -> bool:
        """It answers with a health message of now, its name is its own, and it maps."""
        is_now = self.age_s is None or abs(self.age_s) <= MAX_AGE_S
        maps = self.state not in ("silent", "lost", "stale") and not any(
            fault.startswith(f"{FAULTS[ERROR]} mapping:") for fault in self.faults
        )
        return is_now and maps and len(self.sessions) < 2

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "is_well": self.is_well}

    def __str__(self) -> str:
        parts = [f"{self.name}: {self.state}"]
        if self.x_m is not None and self.y_m is not None and self.heading_deg is not None:
            parts.append(f"x {self.x_m:.2f} y {self.y_m:.2f} m, {self.heading_deg:.0f} deg")
        if self.map_version is not None:
            parts.append(f"map {self.map}@{self.map_version}")
        if self.age_s is not None:
            parts.append(f"{self.age_s:.1f} s ago")
        if self.free_gb is not None:
            parts.append(f"{self.free_gb:.1f} GB free")
        parts += [f"corridor {self.corridor}"] if self.corridor else []
        parts += self.faults
        if len(self.sessions) > 1:
            first, *refused = self.sessions
            parts.append(
                f"{counted(len(self.sessions), 'vehicle')} by this name: {first} is in the fleet, "
                f"{'; '.join(refused)} refused; give one another name"
            )
        elif self.sessions:
            parts.append(self.sessions[0])
        return " | ".join(parts)


def read_vehicles(session: zenoh.Session, names: Sequence[str] = ()) -> list[Vehicle]:
    """All that are there, and those of `names` besides, by name."""
    here = present(session)
    health, poses = last_of(session, "health"), last_of(session, "pose")
    known = sorted({*here, *health, *names}) if not names else sorted(set(names))
    return [vehicle_of(name, health.get(name), poses.get(name), here.get(name, ())) for name in known]


def present(session: zenoh.Session) -> dict[str, list[Presence]]:
    """Sessions that are at the router, by vehicle. Raises StorageError where it does not report which."""
    keys = []
    for reply in session.liveliness().get(PRESENCES, timeout=ANSWER_S):
        if reply.ok is None:  # some may be missing
            raise StorageError(
                f"the router did not say within {ANSWER_S:.0f} s which vehicles are there; is it "
                "overloaded, or the link slow? Try again"
            )
        keys.append(str(reply.ok.key_expr))
    return presences(keys)


def vehicle_of(
    name: str, health: zenoh.Sample | None, pose: zenoh.Sample | None, sessions: Sequence[Presence]
) -> Vehicle:
    """health, pose: the last of each; what cannot be read of them counts as silence."""
    rows: Mapping[str, Any] = {}
    faults: tuple[str, ...] = ()
    age_s = None
    if health is not None:
        try:
            statuses = decode_diagnostics(health.payload.to_bytes())
            age_s = round(time.time() - _source_ns(health) / 1e9, 2)
            if abs(age_s) > MAX_AGE_S:
                faults = (
                    "error clock: health message of another time; is its clock right, or does it hang?",
                )
        except (InputError, ValueError) as error:
            statuses, faults = [], (f"health cannot be read: {error}",)
        rows = {status.name: status for status in statuses}
        faults += tuple(
            f"{FAULTS.get(row.level, 'stale')} {row.name}: {row.message}" for row in statuses if row.level
        )
    values = {
        row: dict(rows[row].values) if row in rows else {} for row in ("mapping", "map", "fleet", "recording")
    }
    at = read_pose(pose)
    return Vehicle(
        name=name,
        state=values["mapping"].get("state", "waiting") if rows else "silent",
        reason=rows["mapping"].message if "mapping" in rows else "",
        x_m=at and round(at[0], 3),
        y_m=at and round(at[1], 3),
        heading_deg=at and round(math.degrees(at[2]), 1),
        map=PurePath(values["map"].get("folder", "")).name,
        map_version=_number(values["fleet"].get("map_version"), int),
        age_s=age_s,
        free_gb=_number(values["recording"].get("free_gb"), float),
        corridor=values["fleet"].get("corridor", ""),
        faults=faults,
        sessions=tuple(map(str, sessions)),
    )


def vehicle_in(key: str) -> str:
    """Name of the vehicle whose key it is."""
    return key.removeprefix(f"{ROOT}/").partition("/")[0]


def last_of(session: zenoh.Session, channel: str) -> dict[str, zenoh.Sample]:
    """Last messages by vehicle, from the vehicles themselves."""
    replies = session.get(
        vehicle_key("*", channel), timeout=ANSWER_S, consolidation=zenoh.ConsolidationMode.NONE
    )
    return {vehicle_in(str(reply.ok.key_expr)): reply.ok for reply in replies if reply.ok is not None}


def _source_ns(sample: zenoh.Sample) -> int:
    if sample.attachment is None:
        raise ValueError("no attachment")
    return Attachment.decode(sample.attachment.to_bytes()).source_ns


def read_pose(sample: zenoh.Sample | None) -> tuple[float, float, float] | None:
    """x, y (m) and heading (rad); None of what is no pose."""
    if sample is None:
        return None
    try:
        pose = decode_pose(sample.payload.to_bytes()).pose
    except InputError:
        return None
    at = (pose.x_m, pose.y_m, pose.theta_rad)
    return at if all(map(math.isfinite, at)) else None


def _number(text: str | None, kind: type[Any]) -> Any:
    try:
        return kind(text)
    except (TypeError, ValueError):
        return None
