import json

import pytest

from service.errors import InputError, UsageError
from service.web.tokens import Tokens
from tests.service.cli.test_commands import code_of


def test_init_makes_the_files_of_a_site_and_says_what_goes_into_the_config(tmp_path, capsys):
    arguments = ["security", "init", str(tmp_path), "--vehicle", "veh1=10.0.0.7,site.example"]
    assert code_of([*arguments, "--operator", "anna", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["made"], result["kept"]) == (["ca", "veh1", "anna"], [])
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


def test_tokens_of_the_page_are_added_listed_and_revoked(tmp_path, capsys):
    place = ["--token-file", str(tmp_path / "web.token"), "--json"]

    def result(*arguments: str) -> dict[str, object]:
        assert code_of(["security", "token", *arguments, *place]) == 0
        return json.loads(capsys.readouterr().out)

    token = result("add", "anna", "--days", "30")["token"]
    result("add", "hall", "--role", "viewer")
    grant = Tokens("own", tmp_path / "web.tokens.json").grant_of(token)
    assert (grant.name, grant.role) == ("anna", "operator")
    anna, hall = result("list")["tokens"]
    assert anna == {"name": "anna", "role": "operator", "holds": True, "days_left": 30.0}
    assert hall["days_left"] is None
    result("revoke", "anna")
    assert [one["name"] for one in result("list")["tokens"]] == ["hall"]
    assert code_of(["security", "token", "revoke", "anna", *place]) == InputError.exit_code


def test_a_token_that_is_made_again_keeps_its_role(tmp_path, capsys):
    """A viewer whose token is lost must not become an operator."""
    place = ["--token-file", str(tmp_path / "web.token"), "--json"]
    roles = []
    for role in (["--role", "viewer"], [], ["--role", "operator"], []):
        assert code_of(["security", "token", "add", "anna", *role, *place]) == 0
        roles.append(json.loads(capsys.readouterr().out)["role"])
    assert roles == ["viewer", "viewer", "operator", "operator"]
