"""Keys, tokens and attachments byte by byte as in rmw_zenoh's design document."""

import random

import pytest
import zenoh.ext as ze

from drivers.rmw_zenoh import NO_TYPE_HASH, Attachment, Node, Qos, Topic, dds_type, make_gid

SCAN_HASH = "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
SCAN = Topic("/scan", "sensor_msgs/msg/LaserScan", SCAN_HASH)
NODE = Node(0, "c0ffee", "corridor")


def test_the_attachments_of_ten_thousand_messages_are_those_that_zenoh_serialises_for_rmw():
    noise = random.Random(1)
    for sequence in range(1, 10_001):
        source_ns, gid = noise.randrange(2**63), noise.randbytes(16)
        attachment = Attachment(sequence, source_ns, gid)
        expected = ze.z_serialize((ze.Int64(sequence), ze.Int64(source_ns), gid)).to_bytes()
        assert attachment.encode() == expected
        assert Attachment.decode(expected) == attachment


@pytest.mark.parametrize("content", [b"", bytes(32), bytes(33), bytes(34)])
def test_other_bytes_are_refused(content):
    with pytest.raises(ValueError, match="expected 33 with a gid of 16"):
        Attachment.decode(content)


def test_a_gid_is_stable_in_a_run_and_differs_by_channel_and_run():
    gids = [make_gid("a", "pose"), make_gid("a", "map"), make_gid("b", "pose")]
    assert len(set(gids)) == 3
    assert {len(gid) for gid in gids} == {16}
    assert make_gid("a", "pose") == gids[0]


def test_the_key_of_a_topic():
    assert SCAN.key(0) == f"0/scan/sensor_msgs::msg::dds_::LaserScan_/{SCAN_HASH}"
    assert Topic("/veh1/front/scan", SCAN.type, NO_TYPE_HASH).key(7) == (
        "7/veh1/front/scan/sensor_msgs::msg::dds_::LaserScan_/TypeHashNotSupported"
    )


def test_the_token_of_a_node():
    assert NODE.token() == "@ros2_lv/0/c0ffee/0/0/NN/%/%/corridor"
    assert Node(3, "c0ffee", "corridor", "/site/veh1").token() == (
        "@ros2_lv/3/c0ffee/0/0/NN/%/%site%veh1/corridor"
    )


@pytest.mark.parametrize("kind", ["MP", "MS", "SS", "SC"])
def test_the_token_of_an_endpoint(kind):
    assert NODE.endpoint_token(10, kind, SCAN, Qos(depth=5)) == (
        f"@ros2_lv/0/c0ffee/0/10/{kind}/%/%/corridor/%scan/sensor_msgs::msg::dds_::LaserScan_/{SCAN_HASH}/"
        "::,5:,:,:,,"
    )


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(depth=42), "::,:,:,:,,"),
        (Qos(), "::,10:,:,:,,"),
        (Qos(depth=1, is_transient_local=True), ":1:,1:,:,:,,"),
    ],
)
def test_the_quality_of_service_is_short_where_it_is_the_default(qos, text):
    assert qos.encode() == text


def test_services_have_srv_in_their_name():
    assert dds_type("std_srvs/srv/Trigger") == "std_srvs::srv::dds_::Trigger_"
