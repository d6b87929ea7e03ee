import os
import stat

import pytest

from service.errors import StorageError
from service.web.access import host_fault, is_token, own_names, token_from_file

NAMES = own_names(("vehicle.local",))


def test_a_token_is_made_once_and_only_its_owner_reads_it(tmp_path):
    path = tmp_path / "new" / "web.token"
    token = token_from_file(path)
    assert len(token) >= 22
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert token_from_file(path) == token
    assert token_from_file(tmp_path / "other.token") != token
    assert is_token(token, token)
    assert not any(is_token(other, token) for other in ("", f"{token}x", "\u00e4bc"))


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        ("secret\n", 0o640, "chmod 600"),
        ("secret\n", 0o604, "chmod 600"),
        ("\n", 0o600, "empty"),
        ("\u00e9", 0o600, "cannot be read"),
    ],
)
def test_a_file_that_others_read_or_that_holds_nothing_is_refused(tmp_path, content, mode, words):
    path = tmp_path / "web.token"
    path.write_text(content, encoding="utf-8")
    path.chmod(mode)
    with pytest.raises(StorageError, match=words):
        token_from_file(path)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "web.token", 0o600)
    with pytest.raises(StorageError, match="a pipe; expected a regular file"):
        token_from_file(tmp_path / "web.token")


@pytest.mark.parametrize(
    ("host", "is_ours"),
    [
        *((host, True) for host in ("127.0.0.1:8080", "[::1]:8080", "localhost:9", "vehicle.local:8080")),
        *((host, False) for host in ("127.0.0.1.evil.example:80", "", "a]b", "vehicle.local.evil:80")),
    ],
)
def test_only_addresses_and_own_names_may_be_opened(host, is_ours):
    fault = host_fault(host, NAMES)
    assert fault == "" if is_ours else "web.hosts" in fault
