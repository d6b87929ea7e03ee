from service.web.send_queue import MAX_NOTES, SendQueue


def test_of_a_picture_only_the_newest_waits():
    send_queue = SendQueue()
    for payload in ("a", "b", "c"):
        send_queue.put("pose", payload)
    send_queue.put("scan/front", "d")
    assert send_queue.filled.is_set()
    assert send_queue.take() == ["c", "d"]
    assert send_queue.dropped == 2
    assert not send_queue.filled.is_set()
    assert send_queue.take() == []


def test_no_answer_is_left_out_however_much_happens():
    send_queue = SendQueue()
    send_queue.answer("hello")
    for number in range(2 * MAX_NOTES):
        send_queue.note(str(number))
    send_queue.answer("done")
    assert send_queue.take()[:3] == ["hello", "done", str(MAX_NOTES)]
    assert send_queue.take() == []
