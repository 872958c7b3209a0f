#!/usr/bin/env bash
# Runs the slicing of the reference implementation (PyTorch) and `sat3d tile` over the same pictures with the same checkpoint,
# taking turns, each with the settings of the reference (stride 64, 32 pixels trimmed, isovalue 4.5, its own lattice), both
# writing the density volume and the mesh. Prints seconds, seconds per window and per square kilometre, the most memory, and how
# far the volumes are apart. The reference is not part of this repository: see tile_reference.py for what it
# needs. Without CHECKPOINT the weights are made up by rule; NETWORK=tiny makes those of the small network.
#
#   REFERENCE=Sat3DGen PYTHON=python3 THREADS=2 benches/peers/tile.sh
#
# SIZES are model pixels, columns x rows. The reference cuts a picture to a square of at most 1000 in its middle, so that only squares are
# the same work; others are run by sat3d alone. With the full network a window takes tens of seconds: the
# default is 14 windows of the reference and 19 of ours.
set -euo pipefail
cd "$(dirname "$0")/../.."
: "${REFERENCE:=Sat3DGen}" "${PYTHON:=python3}" "${THREADS:=2}" "${FOLDER:=target/peers-tile}" "${NETWORK:=full}"
: "${SIZES:=256x256 320x320 384x384 512x256}" "${STRIDE:=64}" "${SAT3D:=target/release/sat3d}"
: "${IMAGE:=crates/sat3d-model/fixtures/inputs/satellite_47.6_-122.33.png}"
if [ ! -e "$REFERENCE/inference/big_image_slice_inference.py" ]; then
    echo "no $REFERENCE/inference/big_image_slice_inference.py; clone the reference implementation and say REFERENCE=its folder" >&2
    exit 2
fi
mkdir -p "$FOLDER"
if [ "$SAT3D" = target/release/sat3d ]; then
    cargo build --release --locked --quiet
fi
if [ -z "${CHECKPOINT:-}" ]; then
    CHECKPOINT="$FOLDER/made-up-$NETWORK"
    [ -e "$CHECKPOINT/config.json" ] ||
        cargo run --release --locked --quiet -p sat3d-model --example made_up -- "$NETWORK" "$CHECKPOINT"
fi
export RAYON_NUM_THREADS=$THREADS
: >"$FOLDER/rows.txt"
for size in $SIZES; do
    picture="$FOLDER/$size.png"
    "$PYTHON" - "$IMAGE" "$size" "$picture" <<'PYTHON'
import sys
from PIL import Image

width, height = map(int, sys.argv[2].split("x"))
picture = Image.open(sys.argv[1]).convert("RGB")
if picture.width < width or picture.height < height:
    sys.exit(f"{sys.argv[1]}: {picture.size} pixels, fewer than {sys.argv[2]}")
picture.crop((0, 0, width, height)).save(sys.argv[3])
PYTHON
    if [ "${size%x*}" = "${size#*x}" ]; then
        rm -rf "$FOLDER/reference-$size"
        mkdir "$FOLDER/reference-$size"
        /usr/bin/time -v -o "$FOLDER/time.txt" "$PYTHON" benches/peers/tile_reference.py "$REFERENCE" "$CHECKPOINT" "$picture" \
            "$FOLDER/reference-$size" --stride "$STRIDE" --threads "$THREADS" >"$FOLDER/reference-$size.json"
        echo "reference $size $(awk '/Elapsed/ {print $NF} /Maximum resident/ {print $NF}' "$FOLDER/time.txt" | xargs)" >>"$FOLDER/rows.txt"
    fi
    rm -rf "$FOLDER/sat3d-$size"
    /usr/bin/time -v -o "$FOLDER/time.txt" "$SAT3D" tile "$picture" --out "$FOLDER/sat3d-$size" --weights "$CHECKPOINT" \
        --stride "$STRIDE" --trim 32 --lattice reference --isovalue 4.5 --gsd 0.28 --window-gsd 0.28 \
        --mesh city.ply --density volume.zarr --mesh-color none --threads "$THREADS" --quiet --json \
        >"$FOLDER/sat3d-$size.json"
    echo "sat3d $size $(awk '/Elapsed/ {print $NF} /Maximum resident/ {print $NF}' "$FOLDER/time.txt" | xargs)" >>"$FOLDER/rows.txt"
done
"$PYTHON" - "$FOLDER" "$STRIDE" <<'PYTHON'
import json, math, sys

folder, stride = sys.argv[1], int(sys.argv[2])
WINDOW, PIXEL_M = 256, 0.28


def seconds(text):
    return sum(60**place * float(part) for place, part in enumerate(reversed(text.split(":"))))


def count(pixels):
    return math.ceil((pixels - WINDOW) / stride) + 1


rows = []
for line in open(f"{folder}/rows.txt"):
    program, size, elapsed, kib = line.split()
    width, height = map(int, size.split("x"))
    windows, area = count(width) * count(height), width * height * PIXEL_M**2 / 1e6
    rows.append((program, size, windows, area, seconds(elapsed), int(kib) / 1024**2))
print("| program | model pixels | windows | km2 | seconds | s per window | s per km2 | GiB |")
print("|---|---|---:|---:|---:|---:|---:|---:|")
for program, size, windows, area, time, gib in rows:
    print(f"| {program} | {size} | {windows} | {area:.4f} | {time:.1f} | {time / windows:.2f} | {time / area:.0f} | {gib:.2f} |")
print()
for program in ("reference", "sat3d"):
    points = [(row[2], row[4]) for row in rows if row[0] == program]
    if len({windows for windows, _ in points}) < 2:
        continue
    # A line through all runs: what the start costs, and what a window more costs.
    middle = [sum(values) / len(points) for values in zip(*points)]
    slope = sum((n - middle[0]) * (t - middle[1]) for n, t in points) / sum((n - middle[0]) ** 2 for n, _ in points)
    start = middle[1] - slope * middle[0]
    worst = max(abs(t - start - slope * n) / t for n, t in points)
    each = 1e6 / (stride * PIXEL_M) ** 2
    print(f"{program}: {start:.1f} s to start and {slope:.2f} s for each window (off by {worst:.0%} at most); "
          f"inside a large picture {each:.0f} windows per km2: {slope * each / 3600:.1f} hours per km2")
for program, size, *_ in rows:
    if program == "sat3d":
        ours = json.load(open(f"{folder}/sat3d-{size}.json"))
        print(f"sat3d {size}: {ours['window_seconds']:.1f} s in {ours['windows']} windows")
        continue
    theirs = json.load(open(f"{folder}/reference-{size}.json"))
    print(f"reference {size}: {theirs['seconds_in_windows']:.1f} s in windows, {theirs['seconds_in_network']:.1f} s of them in the network")
    try:
        import numpy, zarr
    except ImportError:
        print(f"  {size}: volumes not compared, for want of zarr-python")
        continue
    a = numpy.load(f"{folder}/reference-{size}/density_volume.npz")["density"]
    b = numpy.asarray(zarr.open_group(f"{folder}/sat3d-{size}/volume.zarr", mode="r")["density"]).transpose(1, 0, 2)
    if a.shape != b.shape:
        print(f"  {size}: volumes differ in shape: {a.shape} and {b.shape}")
        continue
    difference = numpy.abs(a - b)
    print(f"  {size}: densities up to {a.max():.2f}; apart by {difference.max():.1e} at most, {difference.mean():.1e} on average")
PYTHON
