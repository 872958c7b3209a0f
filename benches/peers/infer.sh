#!/usr/bin/env bash
# Runs the stages of the reference implementation (PyTorch) and ours on the same checkpoint and image, taking
# turns, and prints the medians side by side. The reference is not part of this repository: give a
# checkout of https://github.com/qianmingduowan/Sat3DGen and a Python with torch, transformers 4.57,
# diffusers, einops, easydict, scipy, pillow, tqdm. Without CHECKPOINT the weights are made up by rule.
#
#   REFERENCE=Sat3DGen PYTHON=python3 THREADS=2 ROUNDS=3 benches/peers/infer.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${REFERENCE:=Sat3DGen}" "${PYTHON:=python3}" "${THREADS:=2}" "${ROUNDS:=3}" "${FOLDER:=target/peers-infer}"
: "${IMAGE:=crates/sat3d-model/fixtures/inputs/satellite_47.6_-122.33.png}"
if [ ! -e "$REFERENCE/source/generator.py" ]; then
    echo "no $REFERENCE/source/generator.py; clone the reference implementation and say REFERENCE=its folder" >&2
    exit 2
fi
mkdir -p "$FOLDER"
cargo build --release --locked --quiet -p sat3d-model --example peer --example made_up
if [ -z "${CHECKPOINT:-}" ]; then
    CHECKPOINT="$FOLDER/made-up"
    [ -e "$CHECKPOINT/config.json" ] || target/release/examples/made_up full "$CHECKPOINT"
fi
export RAYON_NUM_THREADS=$THREADS
for ((turn = 1; turn <= 2; turn++)); do
    target/release/examples/peer "$CHECKPOINT" "$IMAGE" "$ROUNDS" >"$FOLDER/ours.$turn.jsonl"
    "$PYTHON" benches/peers/infer_reference.py "$REFERENCE" "$CHECKPOINT" "$IMAGE" \
        --threads "$THREADS" --rounds "$ROUNDS" >"$FOLDER/reference.$turn.jsonl"
done
"$PYTHON" - "$FOLDER" <<'PYTHON'
import json, statistics, sys

def read(name):
    stages = {}
    for turn in (1, 2):
        for line in open(f"{sys.argv[1]}/{name}.{turn}.jsonl"):
            row = json.loads(line)
            stages.setdefault(row["stage"], []).extend(row.get("all", [row.get("gib")]))
    return {stage: statistics.median(values) for stage, values in stages.items()}

ours, reference = read("ours"), read("reference")
for view in ("panorama", "perspective"):
    rays, sharp = f"{view}, rays only", f"{view}, super-resolution only"
    ours[view] = ours[rays] + ours[sharp]
    reference[rays] = reference[view] - reference[sharp]
print(f"{'stage':36} {'reference s':>12} {'sat3d s':>10} {'ratio':>8}")
views = [f"{view}{part}" for view in ("panorama", "perspective") for part in ("", ", rays only", ", super-resolution only")]
for stage in ("encoder", "decoder", "sky", "dsm", *views, "grid 320"):
    print(f"{stage:36} {reference[stage]:12.3f} {ours[stage]:10.3f} {reference[stage] / ours[stage]:8.1f}")
print(f"  folding {ours['fold']:.3f} s; most memory: reference {reference['peak memory']:.2f} GiB, sat3d {ours['peak memory']:.2f} GiB")
PYTHON
