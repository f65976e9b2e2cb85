from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.statistics.pointwise import outward_normals, signed_distances
from ssmpipe.report.sections.modes import nice_ceiling
from tests.support.chromium import Browser, find_chromium
from tests.support.groups_run import grouped_points, write_groups

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine (apt install chromium)"),
]
SETTLE = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


def test_the_page_works_offline_and_shows_the_means(tmp_path: Path) -> None:
    run = write_groups(tmp_path / "run", grouped_points(), {"group": ["a"] * 8 + ["b"] * 8})
    done = CliRunner().invoke(main, ["compare", str(run), "-o", str(tmp_path / "out"), "--permutations", "99"])
    assert done.exit_code == 0, done.output
    a, b = (grouped_points()[half].mean(axis=0) for half in (slice(0, 8), slice(8, 16)))
    apart = np.sort(np.abs(signed_distances(b, a, outward_normals(a, grid_faces(12, 9, periodic_u=True)))))
    expected = nice_ceiling(float(apart[int(0.99 * (len(apart) - 1))]))
    with Browser() as page:
        page.open(tmp_path / "out/compare.html")
        page.evaluate(SETTLE)
        assert page.evaluate("document.getElementById('viewer').dataset.state") == "ready"
        urls = [event["request"]["url"] for event in page.of("Network.requestWillBeSent")]
        assert [url for url in urls if not url.startswith(("file:", "data:"))] == []
        assert page.of("Runtime.exceptionThrown") == []
        assert [e["entry"]["text"] for e in page.of("Log.entryAdded") if e["entry"]["level"] == "error"] == []
        assert page.evaluate("document.querySelector('[data-control=legend]').hidden") is True
        page.evaluate(
            "(() => { const e = document.querySelector('[data-control=patient]'); e.value = '0';"
            " e.dispatchEvent(new Event('change')); })()"
        )
        page.evaluate(SETTLE)
        assert page.evaluate("document.querySelector('[data-control=high]').textContent") == f"+{expected:g} mm"
        assert page.evaluate("document.querySelector('[data-control=legend]').hidden") is False
        page.evaluate(
            "(() => { const e = document.querySelector('input[data-mode]'); e.value = '3';"
            " e.dispatchEvent(new Event('input')); })()"
        )
        assert page.evaluate("document.querySelector('output').textContent") == "+3.0 σ"
