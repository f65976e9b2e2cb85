#!/usr/bin/env bash
# Single stages over a folder of scans, then the group stages on the folder of splines.
#     examples/single_stages.sh SCANS_DIR COHORT_CSV OUT_DIR        (the table has the columns id and side first)
set -euo pipefail
scans=$1
cohort=$2
out=$3
mkdir -p "$out/splines"

reference=""
for scan in "$scans"/*.ply; do
    id=$(basename "$scan" .ply)
    side=$(awk -F, -v id="$id" '$1 == id { print $2 }' "$cohort")
    work=$out/$id
    mkdir -p "$work"
    ssmpipe repair "$scan" "$work/1.ply"
    ssmpipe orient "$work/1.ply" "$work/2.ply" --side "$side"
    ssmpipe trim "$work/2.ply" "$work/3.ply"
    ssmpipe smooth "$work/3.ply" "$work/4.ply"
    ssmpipe decimate "$work/4.ply" "$work/5.ply"
    reference=${reference:-$work/5.ply}
    ssmpipe align "$work/5.ply" "$work/6.ply" --reference "$reference"
    ssmpipe parameterize "$work/6.ply" "$work/7.ply"
    ssmpipe sample "$work/7.ply" "$work/8.npz"
    ssmpipe fit "$work/8.npz" "$out/splines/$id.npz"
done

ssmpipe optimize "$out/splines" "$out/result"
ssmpipe model "$out/result" "$out/model"
