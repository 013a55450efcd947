"""The page of a run, opened in a browser."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from selenium.webdriver import Chrome
from selenium.webdriver.common.by import By

from hmt_service.errors import NotFound
from hmt_service.io.saved_run import SavedHypothesis, read_run
from hmt_service.viz.report import probability_text, verdict, write_report
from tests.browser import browser
from tests.mapped import saved_run_in

PHONE, DESKTOP = (390, 844), (1280, 900)
FIGURES = 8


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = saved_run_in(tmp_path_factory.mktemp("report") / "flat")
    path = folder / "report.html"
    write_report(read_run(folder), path)
    return path


def text_of(chrome: Chrome, selector: str) -> str:
    return str(chrome.find_element(By.CSS_SELECTOR, selector).text)


def summary_of(page: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads(page.with_name("summary.json").read_text())
    return summary


@pytest.mark.parametrize("size", [PHONE, DESKTOP])
def test_page_fits_every_screen_and_shows_all_figures_and_numbers(
    page: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    summary = summary_of(page)
    with browser(tmp_path / "profile", width=size[0], height=size[1]) as chrome:
        chrome.get(page.as_uri())
        wide = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
        assert chrome.execute_script("return window.innerWidth") == size[0]
        assert chrome.execute_script(wide) == 0
        images = chrome.find_elements(By.TAG_NAME, "img")
        assert len(images) == FIGURES
        for image in images:
            assert int(image.get_property("naturalWidth")) > 0  # type: ignore[arg-type]
            assert 200 < image.size["width"] <= size[0]
            assert image.get_attribute("alt")
        shown = {each: text_of(chrome, f"#{each}") for each in ("scans", "keyframes", "areas")}
        assert shown == {each: f"{summary[each]:,}" for each in shown}
        assert text_of(chrome, "#probability") == "0.8000"
        rows = chrome.find_elements(By.CSS_SELECTOR, "#topologies tr")[1:]
        for row, known in zip(rows, summary["posterior"], strict=True):
            cells = row.text.split()
            assert cells[0] == str(known["hypothesis"])
            assert float(cells[1]) == pytest.approx(known["probability"], abs=1e-4)
        assert "1.50 5.000 75 %" in text_of(chrome, "#times")
        warning = chrome.find_element(By.CSS_SELECTOR, ".warning")
        assert summary["warnings"][0] in warning.text
        assert warning.location["y"] < chrome.find_element(By.ID, "probability").location["y"]
        assert [entry for entry in chrome.get_log("browser") if entry["level"] == "SEVERE"] == []  # type: ignore[no-untyped-call]


def test_page_needs_nothing_but_itself(page: Path) -> None:
    text = page.read_text()
    sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert len(sources) == FIGURES
    assert all(source.startswith("data:image/svg+xml;base64,") for source in sources)
    assert "<script" not in text
    assert "url(" not in text


def test_the_same_run_gives_the_same_page(page: Path, tmp_path: Path) -> None:
    write_report(read_run(page.parent), tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == page.read_bytes()


def test_decisions_are_told_with_their_numbers(page: Path) -> None:
    text = page.read_text()
    decided = text[text.index('id="decisions"') :]
    assert "branched" in decided
    assert re.search(r"log_factor -?\d", decided)
    assert "area_entered</td>" not in decided


def test_what_is_not_certain_does_not_look_so() -> None:
    assert probability_text(1.0) == "1.0000"
    assert probability_text(0.9999999) == "1 - 1e-07"
    assert probability_text(0.25) == "0.2500"
    assert probability_text(3e-7) == "3e-07"
    assert probability_text(0.0) == "0.0000"


def test_verdict_counts_the_rivals() -> None:
    best, *others = (
        SavedHypothesis(hypothesis=i, probability=0.5, areas=3, loop_closures=1) for i in range(3)
    )
    assert "One topology is left" in verdict((best,))
    assert "1 other topology cannot" in verdict((best, others[0]))
    assert "2 other topologies cannot" in verdict((best, *others))


def test_missing_folder_of_the_page_is_not_found(page: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="absent"):
        write_report(read_run(page.parent), tmp_path / "absent" / "report.html")
