"""Coverage-guided fuzzing of every reader: ``python -m benchmarks.fuzz [--seconds 60] [--reader mesh]`` (needs atheris).

Starts from the small files of the tests. Anything but a result or an error for the user ends the process of that reader
with a traceback, and its input is kept in the folder given by ``--keep``. Prints the number of runs per reader; exits with 1
when a reader failed.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

READERS = ("mesh", "landmarks", "outline", "image", "spline", "cohort", "config")


def fuzz_one(reader: str, seconds: int, keep: Path) -> bool:
    """Fuzz one reader in a process of its own; return whether nothing was found."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "benchmarks.fuzz", "--worker", reader, folder, str(seconds), str(keep)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    runs = re.findall(r"Done (\d+) runs in (\d+) second|stat::number_of_executed_units: (\d+)", done.stderr)
    memory = re.findall(r"stat::peak_rss_mb:\s+(\d+)", done.stderr)
    count = max((int(n) for row in runs for n in (row[0], row[2]) if n), default=0)
    print(
        f"{reader:10s} {count:8d} runs, peak {memory[-1] if memory else '?'} MB, exit code {done.returncode}",
        flush=True,
    )
    if done.returncode:
        print(done.stderr[-3000:])
    return done.returncode == 0


def worker(reader: str, folder: Path, seconds: int, keep: Path) -> None:
    import atheris

    with atheris.instrument_imports(include=["ssmpipe"]):
        from tests.support.hostile import _readers, cases

        read = _readers()[reader]
    from ssmpipe.core.errors import SsmpipeError

    corpus = folder / "corpus"
    corpus.mkdir()
    suffixes = sorted({suffix(case.file) for case in cases() if case.reader == reader})
    n = 0
    for case in cases():
        if case.reader == reader and not re.search("MB|million", case.name):
            data = case.data()
            if len(data) <= 4096:
                (corpus / str(n)).write_bytes(bytes([suffixes.index(suffix(case.file))]) + data)
                n += 1

    def one(data: bytes) -> None:
        if not data:
            return
        path = folder / f"a{suffixes[data[0] % len(suffixes)]}"
        path.write_bytes(data[1:])
        try:
            read(path)
        except SsmpipeError as error:
            str(error).encode("utf-8")

    limits = [
        "-rss_limit_mb=1024",
        "-timeout=30",
        f"-max_total_time={seconds}",
        "-max_len=8192",
        "-print_final_stats=1",
    ]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={keep}/{reader}-", str(corpus)], one)
    atheris.Fuzz()


def suffix(name: str) -> str:
    return ".mrk.json" if name.endswith(".mrk.json") else Path(name).suffix.lower()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=60, help="time for each reader [s]")
    parser.add_argument("--reader", choices=READERS, action="append", help="only this one [repeatable]")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"), help="folder for inputs that failed")
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        reader, folder, seconds, keep = options.worker
        worker(reader, Path(folder), int(seconds), Path(keep))
        return 0
    options.keep.mkdir(parents=True, exist_ok=True)
    return int(not min([fuzz_one(reader, options.seconds, options.keep) for reader in options.reader or READERS]))


if __name__ == "__main__":
    sys.exit(main())
