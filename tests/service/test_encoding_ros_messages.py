"""The messages written down here against those that rosbags brings."""

import pytest
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from service.encoding import ros_messages

JAZZY = get_typestore(Stores.ROS2_JAZZY)
OURS = Typestore(ros_messages)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", list(ros_messages.FIELDDEFS))
def test_each_message_is_that_of_jazzy(name: str):
    assert ros_messages.FIELDDEFS[name] == JAZZY.fielddefs[name]
    assert OURS.hash_rihs01(name) == JAZZY.hash_rihs01(name)
    assert OURS.generate_msgdef(name, ros_version=2) == JAZZY.generate_msgdef(name, ros_version=2)
    ours, theirs = OURS.types[name], JAZZY.types[name]
    assert list(ours.__dataclass_fields__) == list(theirs.__dataclass_fields__)
    assert {key: value for key, value in vars(ours).items() if key.isupper()} == {
        key: value for key, value in vars(theirs).items() if key.isupper()
    }
