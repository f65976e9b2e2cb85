"""Time and memory of every hostile and every odd but valid file of the tests: ``python -m benchmarks.hostile [--all]``.

Each file is read in a forked child that may take 30 s and 200 MB beyond what an idle reader holds. Prints the slowest and
the largest (``--all``: every file), then the totals; exits with 1 when a file killed its child, hung, or ended in anything
but a mesh (table, picture, ...) or a refusal.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="print every file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tests.support.hostile", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    rows.sort(key=lambda row: -row["seconds"])
    largest = sorted(rows, key=lambda row: -row["mb"])[:5]
    print(f"{'CPU s':>7} {'MB':>6}  file: verdict")
    for row in rows if options.all else rows[:10] + [row for row in largest if row not in rows[:10]]:
        print(f"{row['seconds']:7.3f} {row['mb']:6.1f}  {row['name']}: {row['verdict'][:80]}")
    n_loaded = sum(row["verdict"] == "loaded" for row in rows)
    n_refused = sum(row["verdict"].startswith("refused: ") for row in rows)
    slow = [row for row in rows if row["seconds"] > 1]
    print(
        f"\n{len(rows)} files: {n_loaded} loaded, {n_refused} refused, {len(rows) - n_loaded - n_refused} neither; "
        f"{len(slow)} took more than 1 s; median {rows[len(rows) // 2]['seconds'] * 1000:.0f} ms, "
        f"largest {largest[0]['mb']:.0f} MB"
    )
    return int(n_loaded + n_refused < len(rows))


if __name__ == "__main__":
    sys.exit(main())
