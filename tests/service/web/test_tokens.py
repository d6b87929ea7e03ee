import stat

import pytest

from service.errors import InputError, StorageError
from service.web import tokens
from service.web.tokens import FREE_ATTEMPTS, LONGEST_WAIT_S, Attempts, Tokens, add_grant, read_grants
from tests.set_clock import SetClock


def test_a_token_has_name_role_and_end_and_is_kept_as_a_digest(tmp_path):
    path, clock = tmp_path / "state" / "web.tokens.json", SetClock(1000.0)
    known = Tokens("own", path, clock)
    assert known.grant_of("own").role == "operator"
    assert known.grant_of("anna") is None
    token = add_grant(path, "anna", "viewer", 2000.0)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert token not in path.read_text()
    grant = known.grant_of(token)
    assert (grant.name, grant.role) == ("anna", "viewer")
    assert known.still_holds(grant)
    clock.now_s = 2000.0
    assert known.grant_of(token) is None
    assert not known.still_holds(grant)
    assert known.still_holds(known.grant_of("own"))


@pytest.mark.parametrize(
    ("text", "mode", "words"),
    [
        ("[]", 0o644, r"others may read the further tokens \(mode 0644\); chmod 600"),
        ("{", 0o600, "no tokens of corridor: .*; remove the file"),
        ('[{"name": "a", "role": "root", "sha256": "0"}]', 0o600, "no tokens of corridor"),
    ],
)
def test_a_file_that_is_damaged_or_open_to_others_gives_no_right(tmp_path, caplog, text, mode, words):
    path = tmp_path / "web.tokens.json"
    token = add_grant(path, "anna", "operator", None)
    known = Tokens("own", path)
    grant = known.grant_of(token)
    path.write_text(text)
    path.chmod(mode)
    assert not known.still_holds(grant)
    assert known.grant_of("own") is not None
    with pytest.raises((InputError, StorageError), match=words):
        read_grants(path)
    assert known.fault
    assert len(caplog.records) == 1
    path.unlink()
    assert known.grant_of(token) is None
    assert known.fault == ""


def test_wrong_tokens_of_an_address_are_answered_later_and_later_and_seldom_logged(caplog):
    clock = SetClock()
    attempts = Attempts(clock)
    waits_s = [attempts.wrong("10.0.0.9") for _ in range(100)]
    assert waits_s[:FREE_ATTEMPTS] == [0.0] * FREE_ATTEMPTS
    assert waits_s[FREE_ATTEMPTS : FREE_ATTEMPTS + 3] == [1.0, 2.0, 3.0]
    assert waits_s[-1] == LONGEST_WAIT_S
    assert attempts.wrong("10.0.0.8") == 0.0
    assert [record.args[:2] for record in caplog.records][:7] == [
        ("10.0.0.9", count) for count in (1, 2, 4, 8, 16, 32, 64)
    ]
    clock.now_s += tokens.WINDOW_S + 1.0
    assert attempts.wrong("10.0.0.9") == 0.0
