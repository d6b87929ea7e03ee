import json
import ssl
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import yaml
import zenoh
from cryptography import x509

from service.config import parse_config
from service.errors import InputError
from service.offline.security.authority import Holder, common_name, init_site, read_certificate
from tests.docs.test_yaml import WHOLE

VEH1 = Holder("veh1", "vehicle", ("veh1.local", "10.0.0.7"))
OPERATOR = Holder("operator", "operator")


def ends(path: Path) -> datetime:
    return read_certificate(path).not_valid_after_utc


def test_certificates_are_of_the_authority_with_name_role_hosts_and_key(tmp_path):
    done = init_site(tmp_path, [VEH1, OPERATOR], days=30)
    assert (done.made, done.renewed, done.kept) == (("ca", "veh1", "operator"), (), ())
    certificate = read_certificate(tmp_path / "veh1.pem")
    certificate.verify_directly_issued_by(read_certificate(tmp_path / "ca.pem"))
    assert certificate.subject.rfc4514_string() == "CN=veh1,OU=vehicle"
    hosts = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(host.value) for host in hosts] == ["veh1.local", "10.0.0.7"]
    ssl.create_default_context().load_cert_chain(tmp_path / "veh1.pem", tmp_path / "veh1.key")
    for key in tmp_path.glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600


def test_python_takes_such_a_certificate_for_a_web_page(tmp_path):
    """A strict check of the chain, as Python 3.13 does it by itself."""
    init_site(tmp_path, [VEH1], days=30)
    client = ssl.create_default_context(cafile=tmp_path / "ca.pem")
    client.verify_flags |= ssl.VERIFY_X509_STRICT
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    server.load_cert_chain(tmp_path / "veh1.pem", tmp_path / "veh1.key")
    pipes = [ssl.MemoryBIO() for _ in range(2)]
    sides = [
        client.wrap_bio(pipes[0], pipes[1], server_hostname="veh1.local"),
        server.wrap_bio(pipes[1], pipes[0], server_side=True),
    ]
    done = 0
    while done < 2:
        done = 0
        for side in sides:
            try:
                side.do_handshake()
                done += 1
            except ssl.SSLWantReadError:
                pass


def test_a_second_call_renews_what_ends_soon_and_keeps_the_rest(tmp_path):
    init_site(tmp_path, [OPERATOR], days=700)
    init_site(tmp_path, [VEH1], days=30)
    before = {name: (tmp_path / f"{name}.pem").read_bytes() for name in ("veh1", "operator", "ca")}
    key = (tmp_path / "veh1.key").read_bytes()
    done = init_site(tmp_path, [], days=500)
    assert (done.made, done.renewed, done.kept) == ((), ("veh1",), ("operator",))
    assert ends(tmp_path / "veh1.pem") > datetime.now(UTC) + timedelta(days=499)
    assert (tmp_path / "veh1.key").read_bytes() == key
    assert [
        (tmp_path / f"{name}.pem").read_bytes() == before[name] for name in ("veh1", "operator", "ca")
    ] == [False, True, True]
    assert init_site(tmp_path, [], days=500, renew=True).renewed == ("operator", "veh1")


def test_no_certificate_outlives_its_authority(tmp_path):
    nine_years_ago = datetime.now(UTC) - timedelta(days=9 * 365)
    init_site(tmp_path, [], days=30, now=nine_years_ago)
    init_site(tmp_path, [VEH1], days=3650)
    assert ends(tmp_path / "veh1.pem") == ends(tmp_path / "ca.pem")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda site: (site / "ca.pem").write_text("x"), r"ca\.pem: no certificate in PEM"),
        (lambda site: (site / "ca.key").unlink(), r"ca\.key is missing: certificates are made in"),
        (lambda site: (site / "ca.key").write_text("x"), r"ca\.key: no private key in PEM"),
        (lambda site: (site / "veh1.pem").write_bytes((site / "ca.pem").read_bytes()), "no role in it"),
        (
            lambda site: init_site(site, [Holder("veh1", "viewer")], days=1),
            "has the role vehicle; one name has",
        ),
        (
            lambda site: init_site(site, [], days=1, now=datetime.now(UTC) + timedelta(days=4000)),
            "the authority has expired on",
        ),
    ],
)
def test_files_that_are_none_of_an_authority_are_refused(tmp_path, damage, words):
    init_site(tmp_path, [VEH1], days=30)

    def again() -> None:
        damage(tmp_path)
        init_site(tmp_path, [], days=30)

    with pytest.raises(InputError, match=words):
        again()


def test_the_rules_for_a_router_of_the_site_let_in_certificates_alone(tmp_path):
    init_site(tmp_path, [VEH1, OPERATOR], days=30)
    control = json.loads((tmp_path / "access_control.json5").read_text())["access_control"]
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    assert [subject.get("cert_common_names") for subject in control["subjects"]] == [["operator"], ["veh1"]]
    zenoh.Config().insert_json5("access_control", json.dumps(control))


def test_the_config_that_it_prints_is_accepted(tmp_path):
    text = init_site(tmp_path, [VEH1, OPERATOR], days=30).config
    config = parse_config(yaml.safe_dump(WHOLE | yaml.safe_load(text)), "vehicle.yaml")
    security = config.sinks["publishing"].secured
    assert security.roles.operator == ("operator",)
    assert security.roles.vehicle == ("veh1",)
    assert common_name(read_certificate(tmp_path / security.tls.certificate.name)) == "veh1"
