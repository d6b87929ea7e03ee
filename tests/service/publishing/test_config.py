import pytest
from pydantic import ValidationError

from service.publishing.config import PublishingConfig


def test_the_defaults_stay_on_this_machine():
    config = PublishingConfig()
    assert config.listen == ("tcp/127.0.0.1:7447",)
    assert config.connect == ()
    assert not config.shared_memory


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/[::]:7447",
        "tcp/0.0.0.0:0",
        "udp/10.0.0.7:7447",
        "ws/site.example.org:80",
        "unixsock-stream//run/z.sock",
    ],
)
def test_endpoints_that_zenoh_takes_are_taken(endpoint):
    assert PublishingConfig(listen=[endpoint], connect=[endpoint]).listen == (endpoint,)


@pytest.mark.parametrize(
    "endpoint",
    [
        "7447",
        "127.0.0.1:7447",
        "tcp/1.2.3.4",
        "tcp/1.2.3.4:65536",
        "tls/h:1",
        "tcp/:1",
        "tcp/1.2.3.400:7447",
        "tcp/[:::]:7447",
    ],
)
def test_others_are_refused_with_an_example(endpoint):
    with pytest.raises(ValidationError, match=r"write an endpoint as .tcp/127\.0\.0\.1:7447"):
        PublishingConfig(listen=[endpoint])
