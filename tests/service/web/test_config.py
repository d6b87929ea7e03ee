import pytest
from pydantic import ValidationError

from service.web.config import WebConfig, split_listen


@pytest.mark.parametrize(
    ("listen", "expected"),
    [
        ("127.0.0.1:8080", ("127.0.0.1", 8080)),
        ("[::1]:0", ("::1", 0)),
        ("vehicle.local:65535", ("vehicle.local", 65535)),
    ],
)
def test_an_address_to_listen_at_is_host_and_port(listen, expected):
    assert split_listen(listen) == expected
    assert WebConfig(listen=listen).listen == listen


NO_ADDRESSES = ["8080", "127.0.0.1:65536", "::1:8080", "http://a:80", ":80", "300.0.0.1:8080", "[:::]:8080"]


@pytest.mark.parametrize("listen", NO_ADDRESSES)
def test_anything_else_is_refused_with_an_example(listen):
    with pytest.raises(ValidationError, match=r"127\.0\.0\.1:8080"):
        WebConfig(listen=listen)


@pytest.mark.parametrize("name", ["http://vehicle", "vehicle:8080", "Vehicle", "", "a b", "-a", "a." * 200])
def test_a_host_name_has_neither_scheme_nor_port(name):
    with pytest.raises(ValidationError, match=r"vehicle\.local"):
        WebConfig(hosts=(name,))
    assert WebConfig(hosts=("vehicle.local",)).hosts == ("vehicle.local",)


def test_certificate_and_key_go_together(tmp_path):
    with pytest.raises(ValidationError, match="go together"):
        WebConfig(tls_certificate=tmp_path / "a.pem")
    both = WebConfig(tls_certificate=tmp_path / "a.pem", tls_key=tmp_path / "b.pem")
    assert both.tls_key == tmp_path / "b.pem"
