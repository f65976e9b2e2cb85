from __future__ import annotations

import base64
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmpipe.report.build import build_report
from ssmpipe.report.payload import cohort_columns, groups_of
from ssmpipe.report.sections.modes import nice_ceiling
from ssmpipe.report.solid import vertex_normals
from tests.support.chromium import Browser, find_chromium
from tests.support.small_run import planar_run, small_run

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


def test_two_shapes_beside_and_on_top_of_each_other(page: Browser) -> None:
    page.evaluate("document.querySelector('[data-control=reset]').click()")
    alone = picture(page)
    choose(page, "other", "3")
    beside = picture(page)
    assert beside != alone
    assert page.evaluate("document.querySelector('[data-control=name-b]').textContent") == "P04"
    assert page.evaluate("document.querySelector('[data-control=name-b]').hidden") is False
    unlike = (  # share of pixels of the two halves that differ visibly
        "(() => { const c = document.querySelector('#viewer canvas'), w = Math.floor(c.width / 2), h = c.height;"
        " const x = document.createElement('canvas'); x.width = 2 * w; x.height = h; const g = x.getContext('2d');"
        " g.drawImage(c, 0, 0); const [a, b] = [0, w].map((left) => g.getImageData(left, 0, w, h).data); let n = 0;"
        " for (let i = 0; i < a.length; i += 4) n += [0, 1, 2].some((k) => Math.abs(a[i + k] - b[i + k]) > 40);"
        " return n / (w * h); })()"
    )
    choose(page, "patient", "3")  # the same shape on both sides, one camera: the same picture but for the rims
    picture(page)
    assert page.evaluate(unlike) < 0.01
    page.evaluate("document.querySelectorAll('[data-look]')[2].click()")
    turned = picture(page)
    assert page.evaluate(unlike) < 0.01
    choose(page, "patient", "1")
    assert picture(page) != turned
    assert page.evaluate(unlike) > 0.02
    choose(page, "layout", "over")
    assert picture(page) not in (alone, beside)
    assert page.evaluate("document.querySelector('[data-control=name-b]').hidden") is True
    choose(page, "other", "")
    choose(page, "patient", "")


def test_difference_of_two_patients_has_its_legend_in_mm(page: Browser) -> None:
    run = small_run(ids=(HOSTILE, "P02", "P03", "P04"))
    choose(page, "patient", "1")
    choose(page, "other", "2")
    choose(page, "colour", "other")
    picture(page)
    mean = run.model.mean
    rebuilt = [
        mean + np.einsum("k,kpd->pd", s * np.sqrt(run.model.variances), run.model.modes) for s in run.model.scores
    ]
    along = ((rebuilt[1] - rebuilt[2]) * vertex_normals(mean, run.model.faces)).sum(axis=1)
    limit = nice_ceiling(float(np.sort(np.abs(along))[int(0.99 * (len(along) - 1))]))
    assert page.evaluate("document.querySelector('[data-control=high]').textContent") == f"+{limit:g} mm"
    assert "Distance from P03" in page.evaluate("document.querySelector('[data-control=caption]').textContent")
    choose(page, "patient", "2")  # no difference from itself: no colours, no legend
    assert page.evaluate("document.querySelector('[data-control=legend]').hidden") is True
    choose(page, "colour", "distance")
    choose(page, "other", "")
    choose(page, "patient", "")


def test_groups_and_landmarks(page: Browser) -> None:
    page.evaluate("document.querySelector('[data-control=reset]').click()")
    mean = picture(page)
    choose(page, "patient", "1")
    choose(page, "colour", "bone")
    plain = picture(page)
    choose(page, "colour", "group")
    assert picture(page) != plain
    choose(page, "patient", "g0")
    run = small_run(ids=(HOSTILE, "P02", "P03", "P04"))
    group = groups_of(cohort_columns(run.model.ids, run.record["shapes"]))[0]
    score = float(np.mean([run.model.scores[i, 0] for i in group.members]))
    assert output(page, 0) == f"{score:+.1f} σ".replace("-", "−")
    page.evaluate("document.querySelector('[data-control=reset]').click()")
    choose(page, "colour", "distance")
    assert picture(page) == mean
    tick = (
        "(() => { const e = document.querySelector('[data-control=landmarks]'); e.checked = !e.checked;"
        " e.dispatchEvent(new Event('change')); })()"
    )
    page.evaluate(tick)
    assert picture(page) != mean
    assert page.evaluate("document.querySelector('[data-control=landmark-key]').hidden") is False
    page.evaluate(tick)
    assert picture(page) == mean


def test_the_picture_can_be_saved(page: Browser) -> None:
    page.evaluate(
        "window.saved = null; HTMLAnchorElement.prototype.click = function () { window.saved = [this.download, this.href.slice(0, 22)]; };"
        " document.querySelector('[data-control=picture]').click(); delete HTMLAnchorElement.prototype.click"
    )
    assert page.evaluate("window.saved") == ["shape.png", "data:image/png;base64,"]


def test_everything_can_be_reached_and_has_a_name(page: Browser) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('button, select, input, canvas, a, summary')].filter((e) => !(e.textContent.trim()"
        " || e.getAttribute('aria-label') || e.labels?.length)).map((e) => e.outerHTML)"
    )
    assert nameless == []
    unreachable = page.evaluate(
        "[...document.querySelectorAll('button, select, input, canvas, summary')].filter((e) => e.tabIndex < 0).map((e) => e.outerHTML)"
    )
    assert unreachable == []
    assert page.evaluate("[...document.querySelectorAll('th')].filter((e) => !e.hasAttribute('scope')).length") == 0
    levels = page.evaluate("[...document.querySelectorAll('h1, h2, h3, h4')].map((e) => Number(e.tagName[1]))")
    assert levels[0] == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))


def test_print_shows_the_pictures_and_hides_the_controls(page: Browser) -> None:
    page.send("Emulation.setEmulatedMedia", media="print")
    hidden = page.evaluate("getComputedStyle(document.getElementById('viewer')).display")
    shown = page.evaluate("getComputedStyle(document.querySelector('.print')).display")
    made = page.send("Page.printToPDF", printBackground=True)["data"]
    page.send("Emulation.setEmulatedMedia", media="")
    assert (hidden, shown) == ("none", "block")
    assert base64.b64decode(made)[:5] == b"%PDF-"


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


def test_an_outline_has_distances_without_a_sign(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text(build_report(**planar_run("curve-closed").arguments()), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        browser.evaluate(SETTLE)
        assert browser.evaluate("document.getElementById('viewer').dataset.state") == "ready"
        mean = picture(browser)
        row = (  # how many pixels of the middle row are not background: the outline crosses it twice
            "(() => { const c = document.querySelector('#viewer canvas'), x = document.createElement('canvas');"
            " x.width = c.width; x.height = c.height; const g = x.getContext('2d'); g.drawImage(c, 0, 0);"
            " const d = g.getImageData(0, Math.floor(c.height / 2), c.width, 1).data; let n = 0;"
            " for (let i = 0; i < d.length; i += 4) n += Math.abs(d[i] - d[0]) > 60; return n / (devicePixelRatio || 1); })()"
        )
        assert 5 <= browser.evaluate(row) <= 12  # two lines of three to four pixels
        slide(browser, 0, 2)
        assert picture(browser) != mean
        assert browser.evaluate("document.querySelector('[data-control=low]').textContent") == "0"
        # mode 1 moves every point by (1, 1) / 30 per unit, and its standard deviation is the root of 2
        limit = nice_ceiling(2 * 2**0.5 * 2**0.5 / 30)
        assert browser.evaluate("document.querySelector('[data-control=high]').textContent") == f"+{limit:g} mm"
        assert browser.of("Runtime.exceptionThrown") == []
