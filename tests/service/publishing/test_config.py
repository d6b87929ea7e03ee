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


def test_ros2_is_off_and_its_names_begin_at_the_root():
    ros2 = PublishingConfig().ros2
    assert (ros2.enabled, ros2.domain, ros2.distro, ros2.namespace, ros2.router) == (
        False,
        0,
        "jazzy",
        "",
        "own",
    )


@pytest.mark.parametrize(
    ("text", "name"), [("", ""), ("/", ""), ("veh1", "/veh1"), ("/site/veh1/", "/site/veh1")]
)
def test_a_namespace_has_a_leading_slash_however_it_is_written(text, name):
    assert PublishingConfig(ros2={"namespace": text}).ros2.namespace == name


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
