import os
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.config import ServiceConfig, parse_config
from service.encoding import OK, Status
from service.offline.doctor.certificates import look_at_certificates, look_at_loaded
from service.offline.doctor.findings import Finding
from service.offline.security.authority import Holder, init_site
from service.publishing.certificate import UNTIL, Validity
from tests.service.offline.doctor.conftest import FakeTree

NOW = datetime.fromtimestamp(1.8e9, UTC)  # of the machine
PLACE = "/etc/corridor/security"


@pytest.fixture
def site(tree: FakeTree) -> Path:
    folder = tree.root / PLACE.lstrip("/")
    init_site(folder, [Holder("veh1", "vehicle"), Holder("viewer", "viewer")], days=100, now=NOW)
    return folder


def config(security: str = "", web: str = "") -> ServiceConfig:
    files = f"tls: {{ca: {PLACE}/ca.pem, certificate: {PLACE}/veh1.pem, key: {PLACE}/veh1.key}}"
    text = f"""\
vehicle: veh1
sensors: {{front: {{type: sick_lms100, host: 127.0.0.1}}}}
recording: {{directory: /data/sessions}}
map: {{directory: /data/maps}}
publishing: {{security: {{{security or files + ", roles: {vehicle: [veh1]}"}}}}}
web: {{{web}}}
"""
    return parse_config(text, "v.yaml")


def faults(tree: FakeTree, given: ServiceConfig, **changes: object) -> list[Finding]:
    return [one for one in look_at_certificates(tree.machine(**changes), given) if one.severity != "ok"]


def test_good_files_are_good_with_the_days_that_are_left(tree, site):
    found = look_at_certificates(tree.machine(), config())
    assert [one.severity for one in found] == ["ok", "ok"]
    assert found[0].measured == f"{PLACE}/veh1.pem is valid for 100 days"
    assert look_at_certificates(tree.machine(), config("tls: null")) == []


def test_a_certificate_that_was_renewed_is_noted_until_the_service_is_restarted(tree, site):
    web = f"tls_certificate: {PLACE}/veh1.pem, tls_key: {PLACE}/veh1.key"
    given = config(web=web)
    statuses = [
        Status(name, OK, "ok", {UNTIL: Validity(site / "veh1.pem", site / "veh1.key").until})
        for name in ("zenoh", "web")
    ]
    assert look_at_loaded(tree.machine(), given, statuses) == []
    init_site(site, [], days=200, renew=True, now=NOW)
    found = look_at_loaded(tree.machine(), given, statuses)
    assert [(one.severity, one.who) for one in found] == [("note", "zenoh"), ("note", "web")]
    assert "has loaded a certificate that is valid until 2027-04-25 08:00:00 UTC; " in found[0].measured
    assert "by one until 2027-08-03" in found[0].measured
    assert found[0].remedy == "restart the service to use it"


def replaced(site: Path, name: str, by: bytes) -> None:
    (site / name).write_bytes(by)
    (site / name).chmod(0o600)


def piped(site: Path, name: str) -> None:
    (site / name).unlink()
    os.mkfifo(site / name, 0o600)


def other(site: Path) -> Path:
    init_site(site / "other", [Holder("veh1", "vehicle")], days=100, now=NOW)
    return site / "other"


@pytest.mark.parametrize(
    ("damage", "measured"),
    [
        (lambda site: (site / "veh1.key").unlink(), "driver cannot read .*veh1.key: No such file"),
        (lambda site: (site / "veh1.pem").unlink(), "veh1.pem cannot be read: No such file"),
        (lambda site: (site / "ca.pem").unlink(), "ca.pem cannot be read: No such file"),
        (lambda site: piped(site, "veh1.pem"), "veh1.pem: a pipe; expected a regular file"),
        (lambda site: piped(site, "veh1.key"), "veh1.key: a pipe; expected a regular file"),
        (lambda site: replaced(site, "veh1.pem", b"x"), "veh1.pem: no certificate in PEM"),
        (lambda site: replaced(site, "veh1.key", b"x"), "veh1.key is not the key of .*veh1.pem"),
        (lambda site: (site / "veh1.key").chmod(0o644), r"others may read .*veh1.key \(mode 0644\)"),
        (
            lambda site: replaced(site, "veh1.key", (site / "viewer.key").read_bytes()),
            "veh1.key is not the key of .*veh1.pem: .*mismatch",
        ),
        (
            lambda site: replaced(site, "ca.pem", (other(site) / "ca.pem").read_bytes()),
            "veh1.pem is not signed by .*ca.pem",
        ),
    ],
)
def test_a_file_that_is_missing_open_to_others_or_of_another_is_a_fault(tree, site, damage, measured):
    damage(site)
    (found,) = faults(tree, config())
    assert (found.severity, found.who) == ("fault", "zenoh")
    assert re.search(measured, found.measured), found.measured
    assert found.remedy


@pytest.mark.parametrize(
    ("days", "severity", "measured"),
    [
        (71, "note", f"{PLACE}/veh1.pem ends in 29 days, on 2027-04-25"),
        (101, "fault", f"{PLACE}/veh1.pem has expired on 2027-04-25 08:00 UTC"),
        (-1, "fault", "is valid from 2027-01-15 07:00 UTC on, and the clock says 2027-01-14 08:00"),
    ],
)
def test_a_certificate_at_its_end_is_noted_and_past_it_a_fault(tree, site, days, severity, measured):
    at_s = (NOW + timedelta(days=days)).timestamp()
    found = faults(tree, config(), unix_s=lambda: at_s)[0]
    assert found.severity == severity
    assert measured in found.measured


def test_a_name_without_a_role_is_a_fault(tree, site):
    tls = f"tls: {{ca: {PLACE}/ca.pem, certificate: {PLACE}/veh1.pem, key: {PLACE}/veh1.key}}"
    (found,) = faults(tree, config(tls))
    assert found.measured == f"the name 'veh1' of {PLACE}/veh1.pem has no role"
    assert found.remedy.startswith("write roles: {vehicle: [veh1], ...}")


def test_a_vehicle_of_a_fleet_needs_a_certificate_of_its_name_and_no_role_of_its_own(tree, site):
    tls = f"tls: {{ca: {PLACE}/ca.pem, certificate: {PLACE}/%s.pem, key: {PLACE}/%s.key}}"
    fleet = "}, fleet: {connect: [tls/site.example:7448]"
    assert faults(tree, config(tls % ("veh1", "veh1") + fleet)) == []
    (found,) = faults(tree, config(tls % ("viewer", "viewer") + fleet))
    assert found.measured == f"{PLACE}/viewer.pem is of 'viewer', the vehicle is called 'veh1'"


def test_users_and_roles_are_compared(tree):
    path = tree.write(f"{PLACE}/users", "viewer:a\nguest:b\nbroken\n")
    path.chmod(0o600)
    wrong, broken, guest, operator = faults(tree, config(f"users: {{file: {PLACE}/users}}"))
    assert (wrong.severity, wrong.measured) == ("fault", f"{PLACE}/users: no user in line 3")
    assert [one.severity for one in (guest, broken, operator)] == ["note"] * 3
    assert "'guest'" in guest.measured
    assert operator.measured == f"'operator' has a role and no password in {PLACE}/users"
    path.chmod(0o644)
    (found,) = faults(tree, config(f"users: {{file: {PLACE}/users}}"))
    assert "others may read" in found.measured


def test_the_certificate_of_the_page_is_looked_at_too(tree, site):
    web = f"tls_certificate: {PLACE}/veh1.pem, tls_key: {PLACE}/viewer.key"
    (found,) = faults(tree, config("tls: null", web))
    assert (found.severity, found.who) == ("fault", "web")
    assert faults(tree, config("tls: null", f"enabled: false, {web}")) == []
