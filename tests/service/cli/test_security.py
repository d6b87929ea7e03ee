import json
from pathlib import Path

import pytest

from service.errors import UsageError
from tests.service.cli.test_commands import code_of

pytest.importorskip("cryptography", reason="certificates are made with it: make venv")


def test_init_makes_the_files_of_a_site_and_says_what_goes_into_the_config(tmp_path, capsys):
    arguments = ["security", "init", str(tmp_path), "--vehicle", "veh1=10.0.0.7,site.example"]
    assert code_of([*arguments, "--operator", "anna", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["made"], told["kept"]) == (["ca", "veh1", "anna"], [])
    assert code_of(["security", "init", str(tmp_path)]) == 0
    words = capsys.readouterr().out
    assert "kept: anna, veh1\n" in words
    assert "    roles: {viewer: [], operator: [anna], vehicle: [veh1]}" in words


@pytest.mark.parametrize(
    "wrong",
    [
        ["--vehicle", "a b"],
        ["--vehicle", "../veh1"],
        ["--viewer", "ca"],
        ["--operator", "anna=300.0.0.1"],
        ["--operator", "anna", "--viewer", "anna"],
        ["--days", "0"],
        ["--days", "9" * 5000],
    ],
)
def test_wrong_names_hosts_and_days_are_wrong_usage(tmp_path, wrong):
    assert code_of(["security", "init", str(tmp_path / "site"), *wrong]) == UsageError.exit_code
    assert not (tmp_path / "site").exists()


def test_a_folder_that_cannot_be_written_is_an_error_of_storage(tmp_path: Path, capsys):
    (tmp_path / "file").touch()
    assert code_of(["security", "init", str(tmp_path / "file" / "site")]) == 74
    assert "Not a directory" in capsys.readouterr().err
