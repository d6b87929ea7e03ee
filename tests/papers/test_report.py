import pytest

from tests.papers.__main__ import main
from tests.papers.report import Row, Section, below_title, seeds_text, write_page

MISSED = Row("A1", "error", [7.0], "mm", at_most=5.0, cause="the wall is glass")


def test_a_missed_bound_says_why_and_one_that_is_met_does_not():
    lines = below_title(Section("Cold", "", [MISSED, Row("A1", "error", [4.0], "mm", 5.0, cause="none")]))
    assert lines[4].endswith("| **no**: the wall is glass |")
    assert lines[5].endswith("| yes |")


def test_a_section_says_what_it_ran_on_and_the_others_stay(tmp_path):
    page = tmp_path / "new" / "paper.md"
    both = {
        "b": (Section("Second", "Old."), seeds_text([3])),
        "a": (Section("First", "Stays."), seeds_text([11, 12])),
    }
    write_page(page, "# Paper\n", both, ["a", "b"])
    write_page(page, "# Paper\n", {"b": (Section("Second", "New."), "recordings")}, ["a", "b"])
    assert page.read_text() == (
        "# Paper\n\n## First\n\nScenario `a`; seeds 11 to 12.\n\nStays.\n"
        "\n## Second\n\nScenario `b`; recordings.\n\nNew.\n"
    )


@pytest.mark.parametrize(
    ("arguments", "reported_so"),
    [
        (["--seeds", "0"], "--seeds 0 --first-seed 11: there must be one seed at least"),
        (["--only", "imle", "--scenario", "lobby"], "--scenario lobby: known here are room,"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is(arguments, reported_so, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["python -m tests.papers", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert reported_so in capsys.readouterr().err
