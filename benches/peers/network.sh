#!/usr/bin/env bash
# The network and the DSM from it, in every precision, beside the reference implementation (PyTorch) in its own, on the
# same checkpoint and image, taking turns; prints medians. What is needed is said in benches/peers/infer.sh.
#
#   REFERENCE=Sat3DGen PYTHON=python3 THREADS=2 ROUNDS=3 benches/peers/network.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${REFERENCE:=Sat3DGen}" "${PYTHON:=python3}" "${THREADS:=2}" "${ROUNDS:=3}" "${FOLDER:=target/peers-network}"
: "${IMAGE:=crates/sat3d-model/fixtures/inputs/satellite_47.6_-122.33.png}"
if [ ! -e "$REFERENCE/source/generator.py" ]; then
    echo "no $REFERENCE/source/generator.py; clone the reference implementation and say REFERENCE=its folder" >&2
    exit 2
fi
mkdir -p "$FOLDER"
cargo build --release --locked --quiet -p sat3d-model --features onednn --example peer --example made_up
if [ -z "${CHECKPOINT:-}" ]; then
    CHECKPOINT="$FOLDER/made-up"
    [ -e "$CHECKPOINT/config.json" ] || target/release/examples/made_up full "$CHECKPOINT"
fi
export RAYON_NUM_THREADS=$THREADS OMP_NUM_THREADS=$THREADS
# As the program sets it for itself: OpenMP's threads would spin where rayon's want to work.
export OMP_WAIT_POLICY=passive
ours=("burn fp32" "onednn fp32" "onednn fp32-winograd" "onednn bf16")
reference=(fp32 fp32-last bf16 bf16-last)
for turn in 1 2; do
    for index in 0 1 2 3; do
        # shellcheck disable=SC2086  # two words
        target/release/examples/peer "$CHECKPOINT" "$IMAGE" "$ROUNDS" ${ours[$index]} network \
            >"$FOLDER/sat3d, ${ours[$index]}.$turn.jsonl"
        "$PYTHON" benches/peers/infer_reference.py "$REFERENCE" "$CHECKPOINT" "$IMAGE" --threads "$THREADS" \
            --rounds "$ROUNDS" --precision "${reference[$index]}" --dsm-only \
            >"$FOLDER/PyTorch, ${reference[$index]}.$turn.jsonl"
    done
done
"$PYTHON" - "$FOLDER" "${ours[@]/#/sat3d, }" "${reference[@]/#/PyTorch, }" <<'PYTHON'
import json, statistics, sys

folder, *names = sys.argv[1:]
print(f"{'':34} {'encoder':>9} {'decoder':>9} {'sum':>9} {'DSM':>9} {'image to DSM':>13} {'first':>8} {'GiB':>6}")
for name in names:
    stages, first = {}, 0.0
    for turn in (1, 2):
        for line in open(f"{folder}/{name}.{turn}.jsonl"):
            if not line.startswith("{"):
                continue
            row = json.loads(line)
            # The first round reads and packs weights.
            stages.setdefault(row["stage"], []).extend(row.get("all", [row.get("gib")])[row["stage"] != "peak memory":])
            if turn == 2 and row["stage"] in ("encoder", "decoder", "fold", "dsm"):
                first += row["all"][0]
    median = {stage: statistics.median(values) for stage, values in stages.items()}
    network = median["encoder"] + median["decoder"]
    surface = median["dsm"] + median.get("fold", 0.0)
    print(f"{name:34} {median['encoder']:9.3f} {median['decoder']:9.3f} {network:9.3f} {surface:9.3f}"
          f" {network + surface:13.3f} {first:8.2f} {median['peak memory']:6.2f}")
PYTHON
