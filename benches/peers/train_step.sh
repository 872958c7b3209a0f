#!/usr/bin/env bash
# Trains the small network of the parity data for a few steps, with the reference implementation's modules in
# PyTorch and with ours: the same weights, pictures and samples. Prints the first step's terms side by side, the
# loss curves and the seconds of a step; fails where a term of the first step differs by 1e-4 or more. The
# reference is not part of this repository: give a checkout of https://github.com/qianmingduowan/Sat3DGen and a
# Python as in benches/peers/train_step.py.
#
#   REFERENCE=Sat3DGen PYTHON=python3 THREADS=2 STEPS=20 benches/peers/train_step.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${REFERENCE:=Sat3DGen}" "${PYTHON:=python3}" "${THREADS:=2}" "${STEPS:=20}" "${FOLDER:=target/peers-train}" "${PROFILE:=release}"
if [ ! -e "$REFERENCE/source/generator.py" ]; then
    echo "no $REFERENCE/source/generator.py; clone the reference implementation and say REFERENCE=its folder" >&2
    exit 2
fi
mkdir -p "$FOLDER"
cargo build --profile "$PROFILE" --locked --quiet -p sat3d-model --features train --example train_step --example made_up
built="${CARGO_TARGET_DIR:-target}/$([ "$PROFILE" = dev ] && echo debug || echo "$PROFILE")/examples"
"$built/made_up" tiny "$FOLDER/made-up"
"$PYTHON" benches/peers/train_step.py make "$FOLDER"
RAYON_NUM_THREADS=$THREADS "$built/train_step" "$FOLDER" "$STEPS" >"$FOLDER/ours.jsonl"
"$PYTHON" benches/peers/train_step.py run "$REFERENCE" "$FOLDER/made-up" "$FOLDER" "$STEPS" \
    --threads "$THREADS" >"$FOLDER/reference.jsonl"
"$PYTHON" benches/peers/train_step.py compare "$FOLDER"
