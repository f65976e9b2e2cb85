"""Where matplotlib keeps its cache; in processes of their own, since it is chosen once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there matplotlib always finds a place")
NAME = f"ssmpipe-matplotlib-{os.getuid() if hasattr(os, 'getuid') else 0}"
SAY = "import os, ssmpipe.report, matplotlib; print(os.environ.get('MPLCONFIGDIR', 'none')); print(matplotlib.get_cachedir())"


def places(tmp: Path, home: Path | str, **more: str) -> list[str]:
    """Return MPLCONFIGDIR and the cache folder of a fresh process; it must not complain."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("XDG_") and k != "MPLCONFIGDIR"}
    env = {**kept, "HOME": str(home), "TMPDIR": str(tmp), **more}
    done = subprocess.run([sys.executable, "-c", SAY], env=env, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def test_without_a_home_there_is_one_private_folder(tmp_path: Path) -> None:
    first, second = (places(tmp_path, os.devnull) for _ in range(2))
    assert first == second == [str(tmp_path / NAME)] * 2
    assert (tmp_path / NAME).stat().st_mode & 0o777 == 0o700
    only_cache = places(tmp_path, tmp_path, XDG_CACHE_HOME=os.devnull)
    assert only_cache == first


def test_a_home_that_can_be_written_is_left_to_matplotlib(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    variable, cache = places(tmp_path, home)
    assert variable == "none"
    assert Path(cache).is_relative_to(home)
    assert not (tmp_path / NAME).exists()


def test_what_the_user_has_set_is_kept(tmp_path: Path) -> None:
    own = tmp_path / "own"
    assert places(tmp_path, os.devnull, MPLCONFIGDIR=str(own)) == [str(own)] * 2


@pytest.mark.parametrize("trap", ["open", "link"])
def test_a_folder_that_others_could_have_prepared_is_not_used(trap: str, tmp_path: Path) -> None:
    if trap == "open":
        (tmp_path / NAME).mkdir(mode=0o777)
        (tmp_path / NAME).chmod(0o777)
    else:
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        (tmp_path / NAME).symlink_to(tmp_path / "elsewhere")
    used = Path(places(tmp_path, os.devnull)[0])
    assert used.parent == tmp_path
    assert used.name != NAME
    assert not used.exists(), "it goes with the process"
