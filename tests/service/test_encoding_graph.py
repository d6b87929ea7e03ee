import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from service.encoding import MARKERS, decode_graph, encode_graph
from service.outputs import GraphPicture

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
    for ours, theirs in ((read.paths, PICTURE.paths), (read.borders, PICTURE.borders)):
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
