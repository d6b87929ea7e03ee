import ssl

from service.errors import StorageError, words_of


def test_what_the_system_says_is_reported_without_number_and_path():
    assert words_of(FileNotFoundError(2, "No such file or directory", "/maps/hall")) == (
        "No such file or directory"
    )
    assert words_of(ssl.SSLError(1, "wrong version number")) == "wrong version number"


def test_what_was_said_in_words_stays():
    assert words_of(StorageError("the disk is full")) == "the disk is full"
    assert words_of(OSError("cannot be polled")) == "cannot be polled"
