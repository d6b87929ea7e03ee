import ssl

import pytest

from service.cli.arguments import new_parser
from service.config import parse_config
from service.errors import ConfigError, InputError, StorageError, words_of
from service.publishing.commands import CommandDispatcher


def test_what_the_system_says_is_reported_without_number_and_path():
    assert words_of(FileNotFoundError(2, "No such file or directory", "/maps/hall")) == (
        "No such file or directory"
    )
    assert words_of(ssl.SSLError(1, "wrong version number")) == "wrong version number"


def test_what_was_reported_as_text_stays():
    assert words_of(StorageError("the disk is full")) == "the disk is full"
    assert words_of(OSError("cannot be polled")) == "cannot be polled"


def test_what_is_refused_is_not_repeated_without_end(capsys: pytest.CaptureFixture[str]):
    endless = "x" * 5000
    with pytest.raises(ConfigError) as refused:
        parse_config(f"vehicle: veh1\nsensors: {{front: {{type: {endless}}}}}", "veh1.yaml")
    with pytest.raises(SystemExit):
        new_parser().parse_args(["replay", "a.mcap", "--profile", endless])
    answer = CommandDispatcher({}).answer(endless, b"")
    for words in (str(refused.value), *refused.value.faults, capsys.readouterr().err, answer.body.decode()):
        assert len(words) < 1000
    assert "x..." in str(refused.value)
    assert str(InputError(f"{endless} is no recording")) == f"{'x' * 80}... is no recording"
