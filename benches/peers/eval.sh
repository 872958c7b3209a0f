#!/usr/bin/env bash
# Scores the same pairs with the reference implementation's script and with sat3d, alternating, and
# reports pairs per second. The script is not part of this repository: give a checkout of
# https://github.com/qianmingduowan/Sat3DGen (DSM_processing/calculate_DSM_metric2.py; its Python
# needs numpy, scipy, scikit-image, opencv and matplotlib).
#
#   REFERENCE=Sat3DGen PYTHON=python3 PAIRS=40 ROUNDS=3 FOLDER=target/peers-eval benches/peers/eval.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${REFERENCE:=Sat3DGen}" "${PYTHON:=python3}" "${PAIRS:=40}" "${MANY:=2000}" "${ROUNDS:=3}" "${FOLDER:=target/peers-eval}"
script="$REFERENCE/DSM_processing/calculate_DSM_metric2.py"
if [ ! -e "$script" ]; then
    echo "no $script; clone the reference implementation and say REFERENCE=its folder" >&2
    exit 2
fi
if ! "$PYTHON" -c 'import numpy, scipy, skimage, cv2, matplotlib' 2>/dev/null; then
    echo "the reference needs Python with numpy, scipy, scikit-image, opencv-python-headless, matplotlib (PYTHON=...)" >&2
    exit 2
fi
cargo build --release --locked --quiet
sat3d=target/release/sat3d

# The fixtures' pairs again and again under new names (links, so that they take no room).
make_pairs() { # folder, count
    mkdir -p "$1/pred" "$1/gt"
    "$PYTHON" - "$1" "$2" <<'PYTHON'
import glob, os, shutil, sys
folder, count = sys.argv[1], int(sys.argv[2])
stems = sorted(os.path.basename(p)[:-4] for p in glob.glob("fixtures/eval/pred/*.npz"))
for k in range(count):
    stem = stems[k % len(stems)]
    name = f"satellite_47.{6000 + k // 100:04d}_-122.{3000 + 3 * (k % 100):04d}"
    for source, target in ((f"pred/{stem}.npz", f"pred/{name}.npz"), (f"gt/{stem}_dsm.npz", f"gt/{name}_dsm.npz")):
        target = os.path.join(folder, target)
        if not os.path.exists(target):
            try:
                os.link(os.path.join("fixtures/eval", source), target)
            except OSError:
                shutil.copy(os.path.join("fixtures/eval", source), target)
PYTHON
}
few="$FOLDER/$PAIRS" many="$FOLDER/$MANY"
make_pairs "$few" "$PAIRS"
make_pairs "$many" "$MANY"

seconds_of() { # command...
    local began
    began=$(date +%s%N)
    "$@" >"$FOLDER/last.log" 2>&1 || { cat "$FOLDER/last.log" >&2; exit 1; }
    awk -v ns=$(($(date +%s%N) - began)) 'BEGIN { printf "%.3f", ns / 1e9 }'
}
# The script's start and imports are no work on pairs: what they take is measured and left out.
theirs() {
    rm -rf "$FOLDER/out" "$FOLDER/cache"
    MPLBACKEND=Agg seconds_of "$PYTHON" "$script" --pred_path "$few/pred" --gt_dsm_path "$few/gt" \
        --output_dir "$FOLDER/out" --spatial_align_cache_dir "$FOLDER/cache"
}
start() {
    seconds_of "$PYTHON" -c 'import numpy, scipy.ndimage, skimage.registration, skimage.transform, cv2, matplotlib.pyplot'
}
ours() { # folder, arguments...
    local folder=$1
    shift
    seconds_of "$sat3d" eval --pred "$folder/pred" --gt "$folder/gt" -q "$@"
}

echo "the paper's protocol on $PAIRS pairs (reference) and $MANY pairs (sat3d), $(nproc) cores"
printf '%-6s %22s %22s %22s %10s\n' round "reference, pairs/s" "sat3d, pairs/s" "sat3d --report" ratio
for ((round = 1; round <= ROUNDS; round++)); do
    a=$(theirs) b=$(start) c=$(ours "$many") d=$(ours "$many" --report "$FOLDER/report.html")
    awk -v r="$round" -v n="$PAIRS" -v m="$MANY" -v a="$a" -v b="$b" -v c="$c" -v d="$d" 'BEGIN {
        printf "%-6s %22.2f %22.1f %22.1f %10.1f\n", r, n / (a - b), m / c, m / d, (m / c) / (n / (a - b)) }'
done
