import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from service.encoding import MARKERS, decode_graph, encode_graph
from service.errors import InputError
from service.outputs import NO_GRAPH, GraphPicture

JAZZY = get_typestore(Stores.ROS2_JAZZY)
RANDOM = np.random.default_rng(3)


def points(*shape: int) -> np.ndarray:
    return RANDOM.normal(size=(*shape, 2)).astype(np.float32)


EVIDENCE = {"accepted": [{"stamps_ns": ["1", "2"], "off_mm": 3.5}], "refused": [{"why": "by hand \u2013"}]}
PICTURE = GraphPicture(
    1_700_000_000_000_000_007, [points(5), points(2)], points(3, 2), points(1, 2), [points(4)], EVIDENCE
)


def test_what_is_decoded_is_what_was_encoded() -> None:
    message = encode_graph(PICTURE, 9)
    assert (message.channel, message.type, message.log_ns) == ("graph", MARKERS, 9)
    read = decode_graph(message.payload)
    assert read.stamp_ns == message.stamp_ns == PICTURE.stamp_ns
    for ours, theirs in ((read.ways, PICTURE.ways), (read.borders, PICTURE.borders)):
        assert [line.tolist() for line in ours] == [line.tolist() for line in theirs]
    assert read.accepted.tolist() == PICTURE.accepted.tolist()
    assert read.refused.tolist() == PICTURE.refused.tolist()
    assert read.evidence == EVIDENCE


@pytest.mark.parametrize("text", ["", "no JSON", "3", "[3]", "[" * 100_000])
def test_lines_of_others_have_no_evidence(text: str) -> None:
    array = JAZZY.deserialize_cdr(encode_graph(PICTURE, 9).payload, MARKERS)
    for marker in array.markers:
        marker.text = text
    read = decode_graph(bytes(JAZZY.serialize_cdr(array, MARKERS)))
    assert read.evidence == {"accepted": [], "refused": []}
    assert len(read.accepted) == 3


def test_others_read_lines_in_the_map_frame_that_replace_those_before() -> None:
    array = JAZZY.deserialize_cdr(encode_graph(PICTURE, 9).payload, MARKERS)
    first, *lines = array.markers
    assert first.action == first.DELETEALL
    facts = [(m.ns, m.id, m.type, len(m.points)) for m in lines]
    assert facts == [
        ("key_frames", 0, 4, 5),
        ("key_frames", 1, 4, 2),
        ("sub_maps", 0, 4, 5),  # closed
        ("loops", 0, 5, 6),
        ("refused_loops", 0, 5, 2),
    ]
    assert {m.header.frame_id for m in array.markers} == {"map"}
    assert all(m.color.a > 0.0 and m.scale.x > 0.0 and m.pose.orientation.w == 1.0 for m in lines)


def test_an_empty_graph_takes_away_what_was_drawn() -> None:
    message = encode_graph(NO_GRAPH, 9)
    assert message.stamp_ns == 9
    assert len(JAZZY.deserialize_cdr(message.payload, MARKERS).markers) == 1
    read = decode_graph(message.payload)
    assert (len(read.ways), len(read.accepted), len(read.refused)) == (0, 0, 0)


def test_other_bytes_are_refused() -> None:
    with pytest.raises(InputError, match="MarkerArray"):
        decode_graph(b"\x00\x01\x00\x00\x09\x00\x00\x00")
