from tests.accuracy import page
from tests.papers.report import Row, Section


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
    assert "| error | 3.5 mm | 4.0 mm | ≤ 5 | yes |" in text
    assert "Scenario `cold`; now." in text


def test_a_section_that_no_scenario_writes_stays_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "PAGE", tmp_path / "performance.md")
    page.PAGE.write_text("# Page\n\n## By hand\n\nMeasured once.\n")
    page.write_page({"cold": Section("Cold", "As it is.")}, ["cold"], "now")
    page.write_page({"cold": Section("Cold", "As it is.")}, ["cold"], "now")
    text = page.PAGE.read_text()
    assert text.endswith("## By hand\n\nMeasured once.\n")
    assert text.count("## ") == 2
