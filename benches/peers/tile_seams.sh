#!/usr/bin/env bash
# Runs `sat3d tile` over one picture for every stride and blend and prints a Markdown table: windows, seconds, seams. All runs
# of a round follow one another before the next round begins; times are medians. Jumps are the run's own
# measure (src/tile/seams.rs): mean differences of height between neighbouring pixels across borders of windows and
# elsewhere, and the ratio of the two.
#
#   CHECKPOINT=weights IMAGE=city.png benches/peers/tile_seams.sh
#
# Without CHECKPOINT the small network of the tests is made, with weights by rule; ROUNDS=1 suits the full one.
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${FOLDER:=target/peers-tile-seams}" "${ROUNDS:=3}" "${STRIDES:=256 128 64 32}" "${BLENDS:=mean hann gaussian}"
: "${SAT3D:=target/release/sat3d}" "${OPTIONS:=--gsd 0.28 --window-gsd 0.28}" "${PYTHON:=python3}"
: "${IMAGE:=crates/sat3d-model/fixtures/inputs/satellite_47.6_-122.33.png}"
mkdir -p "$FOLDER"
if [ "$SAT3D" = target/release/sat3d ]; then
    cargo build --release --locked --quiet
fi
if [ -z "${CHECKPOINT:-}" ]; then
    CHECKPOINT="$FOLDER/made-up-tiny"
    [ -e "$CHECKPOINT/config.json" ] ||
        cargo run --release --locked --quiet -p sat3d-model --example made_up -- tiny "$CHECKPOINT"
fi
: >"$FOLDER/runs.jsonl"
for ((round = 1; round <= ROUNDS; round++)); do
    for stride in $STRIDES; do
        for blend in $BLENDS; do
            rm -rf "$FOLDER/out"
            # OPTIONS are words on purpose.
            # shellcheck disable=SC2086
            "$SAT3D" tile "$IMAGE" --out "$FOLDER/out" --weights "$CHECKPOINT" --stride "$stride" --blend "$blend" \
                --dsm dsm.tif $OPTIONS --quiet --json >"$FOLDER/summary.json"
            "$PYTHON" -c 'import json, sys
print(json.dumps({"stride": int(sys.argv[1]), "blend": sys.argv[2], "summary": json.load(open(sys.argv[3]))}))' \
                "$stride" "$blend" "$FOLDER/summary.json" >>"$FOLDER/runs.jsonl"
        done
    done
done
rm -rf "$FOLDER/out"
"$PYTHON" - "$FOLDER/runs.jsonl" <<'PYTHON'
import json, statistics, sys

runs = {}
for line in open(sys.argv[1]):
    run = json.loads(line)
    runs.setdefault((run["stride"], run["blend"]), []).append(run)
print("| stride | blend | windows | seconds | jump across borders, m | elsewhere, m | ratio |")
print("|---:|---|---:|---:|---:|---:|---:|")
for (stride, blend), rounds in runs.items():
    summary = rounds[0]["summary"]
    # The same picture gives the same seams in every round.
    assert all(run["summary"]["seams"] == summary["seams"] for run in rounds), (stride, blend)
    time = statistics.median(run["summary"]["seconds"] for run in rounds)
    seams = summary["seams"]
    jumps = (seams["across_border"]["mean_m"], seams["inside"]["mean_m"], seams["ratio"])
    jumps = " | ".join("" if value is None else f"{value:.3f}" for value in jumps)
    print(f"| {stride} | {blend} | {summary['windows']} | {time:.1f} | {jumps} |")
PYTHON
