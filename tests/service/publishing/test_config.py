import pytest
from pydantic import ValidationError

from service.publishing.config import PublishingConfig


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
    config = PublishingConfig(listen=[endpoint], connect=[endpoint], security="none")
    assert config.listen == (endpoint,)


@pytest.mark.parametrize(
    "endpoint",
    [
        "7447",
        "127.0.0.1:7447",
        "tcp/1.2.3.4",
        "tcp/1.2.3.4:65536",
        "quic/h:1",
        "tcp/:1",
        "tcp/1.2.3.400:7447",
        "tcp/[:::]:7447",
    ],
)
def test_others_are_refused_with_an_example(endpoint):
    with pytest.raises(ValidationError, match=r"write an endpoint as .tcp/127\.0\.0\.1:7447"):
        PublishingConfig(listen=[endpoint])


@pytest.mark.parametrize("text", ["1veh", "a//b", "a-b", "a__b", "ä", "a b", "~/a", "{node}"])
def test_what_is_no_namespace_of_ros_2_is_refused_with_an_example(text):
    with pytest.raises(ValidationError, match='as in "site/veh1"'):
        PublishingConfig(ros2={"namespace": text})


@pytest.mark.parametrize("settings", [{"domain": -1}, {"domain": 233}, {"distro": "foxy"}, {"router": "any"}])
def test_other_settings_of_ros2_are_refused(settings):
    with pytest.raises(ValidationError):
        PublishingConfig(ros2=settings)


def test_another_router_must_be_named():
    ros2 = {"enabled": True, "router": "connect"}
    with pytest.raises(ValidationError, match="connect names no router; write connect"):
        PublishingConfig(ros2=ros2)
    assert PublishingConfig(ros2=ros2, connect=["tcp/127.0.0.1:7447"], listen=["tcp/127.0.0.1:7448"])
