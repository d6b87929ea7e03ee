from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.encoding import OK, WARNING
from service.offline.security.authority import Holder, init_site
from service.publishing.certificate import Validity
from service.publishing.config import PublishingConfig
from service.publishing.security import TlsConfig
from service.sinks.zenoh_sink import ZenohSink
from tests.service.publishing.conftest import tls
from tests.service.sinks.contexts import sink_context

DAY_S = 86_400.0


@pytest.mark.parametrize(
    ("off_days", "words"),
    [(0, ""), (29, ""), (31, "renew it by corridor security init"), (-20_000, "is the clock right?")],
)
def test_a_certificate_has_a_fault_where_it_is_not_valid_by_the_clock(site: Path, off_days: int, words: str):
    config = TlsConfig.model_validate(tls(site, "veh1"))
    now_s = datetime.now(UTC).timestamp() + off_days * DAY_S
    fault = Validity(config, lambda: now_s).fault()
    assert words in fault
    assert bool(fault) == bool(words)


def test_one_that_openssl_refuses_and_none_have_no_fault_here(site: Path):
    other = TlsConfig.model_validate({**tls(site, "veh1"), "ca": str(site / "other" / "ca.pem")})
    assert Validity(other).fault() == Validity(None).fault() == ""


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
        assert (row.values.get("reason_id") == "certificate_not_valid") == (days == 30)
    assert "no client connects by tls/" in caplog.text
