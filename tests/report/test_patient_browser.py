from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ssmpipe.report.patient import build_patient
from ssmpipe.report.projected import build_projected
from tests.report.test_patient import HOSTILE, example
from tests.report.test_projected import part
from tests.report.test_report_browser import SETTLE, choose, picture
from tests.support.chromium import Browser, find_chromium
from tests.support.small_run import small_run

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine (apt install chromium)"),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path: Path = tmp_path_factory.mktemp("patient") / "P02_right.html"
    record = small_run().record
    record["shapes"]["P02_right"]["stages"][0]["warnings"] = [HOSTILE]
    record["name"] = HOSTILE
    path.write_text(build_patient(example(record=record)), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        browser.evaluate(SETTLE)
        yield browser


def test_it_starts_offline_without_complaint(page: Browser) -> None:
    assert page.evaluate("document.getElementById('viewer').dataset.state") == "ready"
    urls = [event["request"]["url"] for event in page.of("Network.requestWillBeSent")]
    assert [url for url in urls if not url.startswith(("file:", "data:"))] == []
    assert [e["entry"]["text"] for e in page.of("Log.entryAdded") if e["entry"]["level"] == "error"] == []
    assert page.of("Runtime.exceptionThrown") == []
    assert page.evaluate("window.attacked") is None


def test_shape_reconstruction_and_maps(page: Browser) -> None:
    def text(name: str) -> str:
        return page.evaluate(f"document.querySelector('[data-control={name}]').textContent")

    own = picture(page)
    assert text("caption").startswith("Distance from the mean")
    choose(page, "colour", "map0")
    assert picture(page) != own
    assert (text("low"), text("high")) == ("−0.5 mm", "+0.5 mm")  # the reconstruction lies 0.5 mm outside everywhere
    choose(page, "patient", "s1")
    choose(page, "other", "s0")
    choose(page, "colour", "other")
    picture(page)
    assert "Distance from P02_right" in text("caption")
    assert text("name-a") == "P02_right, reconstructed from the others"
    choose(page, "other", "")
    choose(page, "colour", "distance")
    choose(page, "patient", "s0")
    assert picture(page) == own


def test_nothing_sticks_out_on_a_telephone(page: Browser) -> None:
    page.send("Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=1, mobile=True)
    page.evaluate(SETTLE)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.send("Emulation.clearDeviceMetricsOverride")


def test_the_page_of_a_projected_fragment_shows_its_uncertainty_without_a_sign(tmp_path: Path) -> None:
    path = tmp_path / "new_07.html"
    path.write_text(build_projected(part(warnings=[(HOSTILE, HOSTILE)])), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        browser.evaluate(SETTLE)
        assert browser.evaluate("document.getElementById('viewer').dataset.state") == "ready"
        words = [
            browser.evaluate(f"document.querySelector('[data-control={k}]').textContent")
            for k in ("caption", "low", "high")
        ]
        assert words == ["Distance of the scan from its reconstruction", "0", "1 mm"]
        first = picture(browser)
        choose(browser, "colour", "distance")
        assert picture(browser) != first
        assert browser.evaluate("document.querySelector('[data-control=low]').textContent").startswith("−")
        assert browser.evaluate("window.attacked") is None
        assert browser.of("Runtime.exceptionThrown") == []
        urls = [event["request"]["url"] for event in browser.of("Network.requestWillBeSent")]
        assert [url for url in urls if not url.startswith(("file:", "data:"))] == []
