from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.encoding import OK, WARNING
from service.errors import StorageError
from service.offline.security.authority import Holder, init_site
from service.publishing.certificate import Validity, validity_of
from service.publishing.config import PublishingConfig
from service.publishing.security import SecurityConfig
from service.publishing.session import open_session
from service.publishing.uplink import open_client
from service.sinks.zenoh_sink import ZenohSink
from tests.service.publishing.conftest import tls
from tests.service.sinks.contexts import sink_context

DAY_S = 86_400.0


@pytest.mark.parametrize(
    ("off_days", "words"),
    [(0, ""), (29, ""), (31, "renew it, as by corridor security init"), (-20_000, "is the clock right?")],
)
def test_a_certificate_has_a_fault_where_it_is_not_valid_by_the_clock(site: Path, off_days: int, words: str):
    now_s = datetime.now(UTC).timestamp() + off_days * DAY_S
    fault = Validity(site / "veh1.pem", site / "veh1.key", lambda: now_s).fault()
    assert words in fault
    assert bool(fault) == bool(words)


def test_one_that_openssl_refuses_and_none_have_no_fault_here(site: Path):
    assert Validity(site / "veh1.pem", site / "ca.key").fault() == Validity(None, None).fault() == ""


def test_one_of_another_authority_has_a_fault_for_no_client_accepts_it(site: Path, tmp_path: Path):
    init_site(tmp_path, [Holder("veh1", "vehicle", ("localhost",))], 30)
    files = tls(site, "veh1")
    assert validity_of(SecurityConfig.model_validate({"tls": files})).fault() == ""
    other = SecurityConfig.model_validate({"tls": {**files, "ca": str(tmp_path / "ca.pem")}})
    words = f"{files['certificate']} is not signed by {tmp_path / 'ca.pem'}: no other machine accepts it"
    assert validity_of(other).fault().startswith(words)


def test_a_key_of_another_certificate_is_named(site: Path):
    files = {**tls(site, "veh1"), "key": str(site / "veh2.key")}
    config = PublishingConfig.model_validate({"listen": ("tls/127.0.0.1:0",), "security": {"tls": files}})
    with pytest.raises(StorageError, match=r"veh2\.key is not the key of .*veh1\.pem; bring both"):
        open_session(config)


def test_one_that_was_renewed_on_the_disk_after_the_start_needs_a_restart_alone(tmp_path: Path):
    vehicle = [Holder("veh1", "vehicle", ("localhost",))]
    init_site(tmp_path, vehicle, 30, now=datetime.now(UTC) - timedelta(days=40))
    validity = Validity(tmp_path / "veh1.pem", tmp_path / "veh1.key")
    assert "renew it" in validity.fault()
    init_site(tmp_path, vehicle, 30)
    assert "the file has been renewed since, restart to use it" in validity.fault()


def test_a_client_whose_own_certificate_has_expired_says_so(tmp_path: Path):
    init_site(tmp_path, [Holder("anna", "operator", ())], 30, now=datetime.now(UTC) - timedelta(days=40))
    security = {"tls": tls(tmp_path, "anna")}
    config = PublishingConfig.model_validate({"connect": ("tls/127.0.0.1:1",), "security": security})
    with pytest.raises(StorageError, match=r"no router at .*anna\.pem is valid from .* no other machine"):
        open_client(config)


def test_health_has_a_warning_where_clients_refuse_the_certificate(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """Nothing else says it: Zenoh listens, and each client ends with a time-out."""
    long_ago = datetime.now(UTC) - timedelta(days=40)
    for days in (30, 90):
        folder = tmp_path / str(days)
        init_site(folder, [Holder("veh1", "vehicle", ("localhost",))], days, now=long_ago)
        config = PublishingConfig.model_validate(
            {"listen": ("tls/127.0.0.1:0",), "security": {"tls": tls(folder, "veh1")}}
        )
        sink = ZenohSink(config, sink_context())
        row = sink.health()
        sink.close()
        assert row.level == (WARNING if days == 30 else OK)
        ends = (long_ago + timedelta(days=days)).strftime("%Y-%m-%d %H:%M:%S")
        assert row.values["certificate_until"] == ends  # for the doctor, who sees the file
        assert (row.values.get("reason_id") == "certificate_not_valid") == (days == 30)
    assert "no other machine accepts it" in caplog.text
