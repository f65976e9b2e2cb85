from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ssmpipe.report.build import build_report
from tests.support.chromium import Browser, find_chromium
from tests.support.small_run import small_run

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine (apt install chromium)"),
]
HOSTILE = "</script><script>window.attacked = 1</script>"
SETTLE = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
HASH = "document.querySelector('#viewer canvas').toDataURL()"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path: Path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(build_report(**small_run(ids=(HOSTILE, "P02", "P03", "P04")).arguments()), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        browser.evaluate(SETTLE)
        yield browser


def picture(page: Browser) -> str:
    page.evaluate(SETTLE)
    return page.evaluate(HASH)


def choose(page: Browser, control: str, value: str) -> None:
    page.evaluate(
        f"(() => {{ const e = document.querySelector('[data-control={control}]'); e.value = '{value}';"
        " e.dispatchEvent(new Event('change')); })()"
    )


def slide(page: Browser, mode: int, sigma: float) -> None:
    page.evaluate(
        f"(() => {{ const e = document.getElementById('mode-{mode}'); e.value = '{sigma}'; e.dispatchEvent(new Event('input')); }})()"
    )


def output(page: Browser, mode: int) -> str:
    return page.evaluate(f"document.querySelector('output[for=mode-{mode}]').textContent")


def test_it_starts_offline_without_complaint(page: Browser) -> None:
    assert page.evaluate("document.getElementById('viewer').dataset.state") == "ready"
    urls = [event["request"]["url"] for event in page.of("Network.requestWillBeSent")]
    assert [url for url in urls if not url.startswith(("file:", "data:"))] == []
    assert sum(url.startswith("file:") for url in urls) == 1
    complaints = [e["entry"]["text"] for e in page.of("Log.entryAdded") if e["entry"]["level"] == "error"]
    assert complaints == []
    assert page.of("Runtime.exceptionThrown") == []


def test_a_hostile_id_stays_text(page: Browser) -> None:
    assert page.evaluate("window.attacked") is None
    assert HOSTILE in page.evaluate("document.getElementById('patient').textContent")


def test_a_script_from_elsewhere_is_refused(page: Browser) -> None:
    page.evaluate(
        "(() => { const s = document.createElement('script'); s.textContent = 'window.injected = 1'; document.body.append(s); })()"
    )
    assert page.evaluate("window.injected") is None


def test_sliders_patients_and_patterns_change_the_picture(page: Browser) -> None:
    page.evaluate("document.querySelector('[data-control=reset]').click()")
    mean = picture(page)
    slide(page, 0, 3)
    moved = picture(page)
    assert moved != mean
    assert output(page, 0) == "+3.0 σ"
    assert page.evaluate("document.querySelector('[data-control=high]').textContent").endswith(" mm")
    choose(page, "pattern", "checker")
    checkered = picture(page)
    assert checkered != moved
    choose(page, "pattern", "none")
    choose(page, "colour", "bone")
    assert picture(page) != moved
    choose(page, "colour", "distance")
    choose(page, "patient", "1")
    score = small_run(ids=(HOSTILE, "P02", "P03", "P04")).model.scores[1, 0]
    assert output(page, 0) == f"{score:+.1f} σ".replace("-", "−")
    page.evaluate("document.querySelector('[data-control=reset]').click()")
    assert picture(page) == mean


def test_a_mode_plays_and_stops(page: Browser) -> None:
    page.evaluate("document.querySelector('[data-walk=\"0\"]').click()")
    page.evaluate("new Promise((done) => setTimeout(done, 400))")
    assert output(page, 0) != "0.0 σ"
    assert page.evaluate("document.querySelector('[data-walk=\"0\"]').getAttribute('aria-pressed')") == "true"
    page.evaluate("document.querySelector('[data-walk=\"0\"]').click()")
    page.evaluate(SETTLE)
    before = output(page, 0)
    page.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert output(page, 0) == before


def test_arrow_keys_turn_the_picture(page: Browser) -> None:
    page.evaluate("document.querySelector('[data-control=reset]').click()")
    before = picture(page)
    page.evaluate(
        "document.querySelector('#viewer canvas').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))"
    )
    assert picture(page) != before


def test_nothing_sticks_out_on_a_telephone(page: Browser) -> None:
    page.send("Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=1, mobile=True)
    page.evaluate(SETTLE)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.send("Emulation.clearDeviceMetricsOverride")
