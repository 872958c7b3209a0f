#!/usr/bin/env bash
# Training the small model: sat3d beside its twin in PyTorch, one after the other on the same scenes and threads.
# Prints the seconds of a step and the losses of both every 50 steps.
#
#   PYTHON=python3 THREADS=2 STEPS=150 benches/peers/train_mini.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${PYTHON:=python3}" "${THREADS:=2}" "${STEPS:=150}" "${SCENES:=64}" "${FOLDER:=target/peers-train-mini}" "${SAT3D:=target/release/sat3d}"
mkdir -p "$FOLDER"
[ -e "$FOLDER/scenes/scenes.json" ] || "$SAT3D" simulate --random "$SCENES" --seed 5 --size 256 --out "$FOLDER/scenes"
rm -rf "$FOLDER/ours"
# A session to make the scenes, one that is timed: a log line is the mean of its steps.
"$SAT3D" train pipelines/train/mini.toml --out "$FOLDER/ours" --set "run.threads=$THREADS" --set run.log_every=50 \
    --set data.simulated.seed=5 --set "data.simulated.scenes=$SCENES" --set data.simulated.scene_side=256 \
    --set run.preview_every=0 --set "run.checkpoint_every=$STEPS" --set data.simulated.cache="$PWD/$FOLDER/cache" \
    --set run.minutes="${MINUTES:-3}" || true
cat "$FOLDER/ours/log.jsonl"
"$PYTHON" benches/peers/train_mini.py "$FOLDER/scenes" "$STEPS" --threads "$THREADS"
