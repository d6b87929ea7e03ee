import json
import math
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from service.cli import main
from service.errors import InputError
from service.offline.replay.replay import ReplayOptions, replay, replay_all, write_replay
from service.offline.report import REPORT_FILE, write_report
from tests.service.offline.recorded_drives import RecordDrive, recorder_in

NASTY = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


class Page(HTMLParser):
    """What of a page counts here: its elements, their attributes, and the text that people read."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._words: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] != "style":
            self._words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self._words).split())

    def count(self, name: str, kind: str) -> int:
        """Elements of a name that have a class."""
        return sum(tag == name and kind in (of.get("class") or "").split() for tag, of in self.tags)


def page_of(folder: Path) -> Page:
    write_report(folder, folder / REPORT_FILE)
    return Page((folder / REPORT_FILE).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of 40 scans, six of them without a return."""
    folder = tmp_path_factory.mktemp("result")
    write_replay(replay([recorder_in(folder)(covered=range(20, 26))], ReplayOptions()), folder / "out")
    return folder / "out"


@pytest.fixture
def result(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "out"))


def change_summary(result: Path, **values: object) -> None:
    path = result / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_a_page_shows_map_path_states_sensors_warnings_and_settings(result: Path):
    page = page_of(result)
    (image,) = [of for name, of in page.tags if name == "image"]
    assert image["href"].startswith("data:image/png;base64,iVBORw0KGgo")
    assert page.count("polyline", "path") > 0
    assert page.count("polyline", "halo") > 0
    assert page.count("rect", "ok") >= 2  # before and after the scans without returns
    assert page.count("rect", "frames") == 2
    for words in (
        "v_20231114T221320Z_0001.mcap",
        "14 November 2023, 22:13:20 UTC",
        "few_returns",
        "0 of 271 beams returned",
        "base odom 40 50 0",  # frames, rate and gaps
        "front scan 40 50 0",
        "profile corridor",
        "matcher",
        "2 warnings",
    ):
        assert words in page.text


def test_nothing_of_a_page_is_fetched_or_run(result: Path):
    page = page_of(result)
    assert not {"script", "link", "iframe"} & {name for name, _ in page.tags}
    for _, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes)
        assert not any(
            (attributes.get(name) or "").startswith(("http:", "https:", "//")) for name in ("href", "src")
        )
    html = (result / REPORT_FILE).read_text(encoding="utf-8")
    assert "@import" not in html
    assert "url(" not in html
    (policy,) = [of for _, of in page.tags if of.get("http-equiv") == "Content-Security-Policy"]
    assert (policy["content"] or "").startswith("default-src 'none'")


def test_texts_of_a_recording_are_texts(result: Path):
    summary = json.loads((result / "summary.json").read_text())
    change_summary(
        result,
        profile=NASTY,
        recording=[f"{NASTY}\udce4"],  # in Latin-1
        warnings=[NASTY],
        sensors={f"{NASTY}/scan": summary["sensors"]["front/scan"]},
        mapping={NASTY: NASTY},
        state_reasons={NASTY: [{"id": NASTY, "reason": NASTY, "scans": 1, "first_s": 0.0}]},
    )
    states = (result / "states.csv").read_text()
    (result / "states.csv").write_text(states.replace("few_returns", "<b>few"))
    page = page_of(result)
    assert not {"script", "img"} & {name for name, _ in page.tags}
    assert page.text.count(NASTY) >= 5
    assert "<b>few" in page.text
    assert "\\udce4" in page.text


def test_a_result_without_its_states_is_bad_input(result: Path):
    (result / "states.csv").unlink()
    with pytest.raises(InputError, match=r"states\.csv: cannot be read"):
        write_report(result, result / REPORT_FILE)


def test_a_result_without_a_graph_says_why_it_shows_no_loops(result: Path):
    shutil.rmtree(result / "map")
    page = page_of(result)
    assert "No graph is stored: the profile has none" in page.text
    assert page.count("image", "cells") == 1  # that of map.yaml


@pytest.mark.parametrize(("summary", "fault"), [("[]", "expected a JSON object"), ("{", "summary.json")])
def test_a_damaged_summary_is_bad_input(result: Path, summary: str, fault: str):
    (result / "summary.json").write_text(summary)
    with pytest.raises(InputError, match=fault):
        write_report(result, result / REPORT_FILE)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"scans": "many"}, "summary.json: scans: Input should be a valid integer"),
        ({"sensors": {"front/scan": {"rate_hz": 1}}}, r"summary.json: sensors.front/scan.frames: Field"),
        ({"sensors": {"front/scan": {"rate_hz": math.nan}}}, "summary.json: sensors.front/scan"),
    ],
)
def test_a_summary_of_other_facts_is_bad_input(result: Path, values: dict[str, object], fault: str):
    change_summary(result, **values)
    with pytest.raises(InputError, match=fault):
        write_report(result, result / REPORT_FILE)


def test_a_folder_of_no_replay_is_bad_input(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    file = tmp_path / "trajectory.tum"
    file.write_text("")
    for result in (tmp_path, file):
        assert main(["report", str(result)]) == 65
        assert "is not the folder of a replay; corridor replay" in capfd.readouterr().err


def test_the_same_result_gives_the_same_bytes_also_at_the_end_of_a_replay(
    record_drive: RecordDrive, tmp_path: Path
):
    (summary,) = replay_all(
        [[record_drive()]], ReplayOptions(), [tmp_path / "out"], lambda *_: None, extras=["report"]
    )
    assert isinstance(summary, dict)
    written = (tmp_path / "out" / REPORT_FILE).read_bytes()
    write_report(tmp_path / "out", tmp_path / "out" / REPORT_FILE)
    assert (tmp_path / "out" / REPORT_FILE).read_bytes() == written
