import pytest

from tests.accuracy import page
from tests.papers.report import Row, Section, below_title


def test_running_one_scenario_replaces_its_section_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "PAGE", tmp_path / "performance.md")
    old = Section("Cold", "As it was.", [Row("", "error", [7.0], "mm", at_most=5.0, digits=1)])
    page.write_page({"cold": old, "warm": Section("Warm", "Stays.")}, ["warm", "cold"], "then")
    new = Section("Cold", "As it is.", [Row("", "error", [3.0, 4.0], "mm", at_most=5.0, digits=1)])
    page.write_page({"cold": new}, ["warm", "cold"], "now")
    text = page.PAGE.read_text()
    assert text.index("## Warm") < text.index("## Cold")
    assert "Stays." in text
    assert "As it was." not in text
    assert "\n| figure | median | worst | bound | met |\n|---|---|---|---|---|\n" in text
    assert "\n| error | 3.5 mm | 4.0 mm | ≤ 5 mm | yes |\n" in text
    assert "Scenario `cold`; now." in text


def test_a_section_that_no_scenario_writes_stays_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "PAGE", tmp_path / "performance.md")
    page.PAGE.write_text("# Page\n\n## By hand\n\nMeasured once.\n")
    page.write_page({"cold": Section("Cold", "As it is.")}, ["cold"], "now")
    page.write_page({"cold": Section("Cold", "As it is.")}, ["cold"], "now")
    text = page.PAGE.read_text()
    assert text.endswith("## By hand\n\nMeasured once.\n")
    assert text.count("## ") == 2


def test_where_rows_name_their_case_the_column_has_a_heading():
    rows = [
        Row("office", "error", [1.0], "mm"),
        Row("", "loops", [3.0], "loops", at_least=2.0, by_worst=True),
    ]
    table = below_title(Section("Two", "", rows))[2:5]
    assert table == [
        "| case | figure | median | worst | bound | met |",
        "|---|---|---|---|---|---|",
        "| office | error | 1.000 mm | 1.000 mm |  |  |",
    ]
    assert below_title(Section("Two", "", rows))[5].endswith("| ≥ 2 loops every seed | yes |")


def test_a_figure_without_its_unit_is_refused():
    with pytest.raises(ValueError, match="NEES: a figure without its unit"):
        Row("", "NEES", [1.0], "")
