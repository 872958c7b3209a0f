#!/usr/bin/env bash
# Runs sat3d and the rasterio script on the same images, alternating, and reports images per second.
# Checks first that with --grid reference both compute the same heights.
#
#   PYTHON=python3 IMAGES=400 ROUNDS=3 PIXELS=8192 FOLDER=target/peers benches/peers/run.sh
set -euo pipefail
cd "$(dirname "$0")/../.."
here=benches/peers
: "${PYTHON:=python3}" "${IMAGES:=400}" "${ROUNDS:=3}" "${PIXELS:=8192}" "${FOLDER:=target/peers}"

if ! "$PYTHON" -c 'import rasterio, pyproj, numpy' 2>/dev/null; then
    echo "the peer needs Python with rasterio and pyproj: scripts/setup.sh --peers, or PYTHON=..." >&2
    exit 2
fi
cargo build --release --locked --quiet
sat3d=target/release/sat3d

lidar="$FOLDER/lidar-$PIXELS-$IMAGES"
if [ ! -e "$lidar/images.txt" ]; then
    echo "making six tiles of $PIXELS x $PIXELS pixels in $lidar"
    "$PYTHON" "$here/make_lidar.py" "$lidar" --pixels "$PIXELS" --images "$IMAGES" >/dev/null
fi
names="$lidar/images.txt"
# Both read from the page cache.
cat "$lidar"/*.tif >/dev/null

seconds_of() { # command...: seconds of wall time
    local began
    began=$(date +%s%N)
    "$@" >"$FOLDER/last.log" 2>&1 || { cat "$FOLDER/last.log" >&2; exit 1; }
    awk -v ns=$(($(date +%s%N) - began)) 'BEGIN { printf "%.3f", ns / 1e9 }'
}
rate() { awk -v n="$IMAGES" -v s="$1" 'BEGIN { printf "%.1f", n / s }'; }
ours() { # extra arguments...
    rm -rf "$FOLDER/ours"
    seconds_of "$sat3d" dsm-bench build --lidar "$lidar" --images "$names" --out "$FOLDER/ours" --quiet "$@"
}
# The script's own clock, which leaves out Python's start and imports.
theirs() { # processes
    rm -rf "$FOLDER/theirs"
    "$PYTHON" "$here/reference_dsm.py" "$lidar" "$names" "$FOLDER/theirs" --jobs "$1" |
        sed -n 's/.*"seconds": \([0-9.]*\).*/\1/p'
}

cores=$(nproc)
echo "$IMAGES images, six tiles of $PIXELS x $PIXELS pixels, $cores cores"
printf '%-8s %18s %18s %18s\n' round "sat3d" "rasterio" "rasterio, $cores processes"
all=()
for ((round = 1; round <= ROUNDS; round++)); do
    a=$(ours) b=$(theirs 1) c=$(theirs "$cores")
    all+=("$a $b $c")
    printf '%-8s %10s images/s %9s images/s %9s images/s\n' "$round" "$(rate "$a")" "$(rate "$b")" "$(rate "$c")"
done
printf '%s\n' "${all[@]}" | awk -v n="$IMAGES" '
    { for (i = 1; i <= 3; i++) v[i, NR] = $i }
    function median(i,   j, k, t) {
        for (j = 2; j <= NR; j++) for (k = j; k > 1 && v[i, k] < v[i, k-1]; k--) { t = v[i, k]; v[i, k] = v[i, k-1]; v[i, k-1] = t }
        return NR % 2 ? v[i, (NR + 1) / 2] : (v[i, NR / 2] + v[i, NR / 2 + 1]) / 2
    }
    END { a = median(1); b = median(2); c = median(3)
          printf "median   %10.1f images/s %9.1f images/s %9.1f images/s\n", n / a, n / b, n / c
          printf "sat3d is %.1f times the script, %.1f times the script in as many processes as cores\n", b / a, c / a }'

ours --grid reference >/dev/null
echo "with --grid reference, against the script's heights:"
"$PYTHON" "$here/compare.py" "$FOLDER/ours" "$FOLDER/theirs"
