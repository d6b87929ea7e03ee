from service.web.mailbox import MAX_NOTES, Mailbox


def test_of_a_picture_only_the_newest_waits():
    mailbox = Mailbox()
    for payload in ("a", "b", "c"):
        mailbox.put("pose", payload)
    mailbox.put("scan/front", "d")
    assert mailbox.filled.is_set()
    assert mailbox.take() == ["c", "d"]
    assert mailbox.dropped == 2
    assert not mailbox.filled.is_set()
    assert mailbox.take() == []


def test_each_note_waits_and_the_oldest_goes_first():
    mailbox = Mailbox()
    for number in range(MAX_NOTES + 2):
        mailbox.note(str(number))
    assert mailbox.take() == [str(number) for number in range(2, MAX_NOTES + 2)]
    assert mailbox.dropped == 2


def test_notes_go_before_pictures():
    mailbox = Mailbox()
    mailbox.put("pose", "picture")
    mailbox.note("hello")
    assert mailbox.take() == ["hello", "picture"]


def test_no_answer_is_left_out_however_much_happens():
    mailbox = Mailbox()
    mailbox.answer("hello")
    for number in range(2 * MAX_NOTES):
        mailbox.note(str(number))
    mailbox.answer("done")
    assert mailbox.take()[:3] == ["hello", "done", str(MAX_NOTES)]
    assert mailbox.take() == []
