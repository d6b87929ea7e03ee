import json
import pickle

from service.outputs import NO_REASON, Reason

REASON = Reason("off_map", "12% of 180 returns lie on the map")


def test_a_reason_keeps_its_id_from_one_process_to_another():
    copied = pickle.loads(pickle.dumps(REASON))
    assert (copied, copied.id, type(copied)) == (REASON, "off_map", Reason)


def test_a_reason_is_its_words_wherever_text_is_expected():
    assert f"front: {REASON}" == "front: 12% of 180 returns lie on the map"
    assert json.dumps({"reason": REASON}) == '{"reason": "12% of 180 returns lie on the map"}'
    assert not NO_REASON
