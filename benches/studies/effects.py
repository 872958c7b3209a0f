#!/usr/bin/env python3
"""What each effect of three simulated scenes costs and changes; prints Markdown, writes pictures.

    python benches/studies/effects.py --sat3d target/release/sat3d --pictures docs/pictures

For each scene of `pipelines/scenes/`, with the image in its middle alone: the plan's own choice, each effect switched
the other way (left out where the plan has it, forced where it has not), everything forced, and everything left out.
Times are medians of the processor time of whole runs of `sat3d simulate` on one thread with an image of 320 pixels, all
variants in turn, so that a busy machine touches all alike; a difference within twice the sum of its two median deviations is
given as 0. Changes are taken from the results: all lidar tiles, and an image of 640 pixels. Needs NumPy and Pillow.
"""
import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

SCENES = ["flat_noon", "hilly_waterfront", "towers_off_nadir"]
# Steps of the plan that are no effects: nobody can switch them.
FIXED = {"projection", "units", "camera", "palette", "picture"}
SIDE = 200


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sat3d", type=Path, default=Path("target/release/sat3d"))
    parser.add_argument("--scenes", type=Path, default=Path("pipelines/scenes"))
    parser.add_argument("--pictures", type=Path, help="folder for one PNG per scene")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in SCENES:
            study(args, name, Path(folder) / name)


def study(args, name, folder):
    folder.mkdir()
    text = (args.scenes / f"{name}.toml").read_text()
    scene, small = one_image(text, 640, folder / "scene.toml"), one_image(text, 320, folder / "small.toml")
    plan = steps(args.sat3d, scene, [])
    effects = [step for step in plan if step not in FIXED]
    on = {effect for effect in effects if plan[effect]["on"]}
    variants = {"plan": []}
    for effect in effects:
        variants[effect] = ["--without" if effect in on else "--force", effect]
    variants["all"] = [word for effect in effects for word in ("--force", effect)]
    variants["none"] = [word for effect in effects for word in ("--without", effect)]
    times = {variant: [] for variant in variants}
    for _ in range(args.rounds):
        for variant, options in variants.items():
            times[variant].append(simulate(args.sat3d, small, folder / "timed", options))
    seconds = {variant: statistics.median(values) for variant, values in times.items()}
    noise = {v: statistics.median(abs(t - seconds[v]) for t in times[v]) for v in variants}

    def difference(a, b):
        seen = abs(seconds[a] - seconds[b]) > 2 * (noise[a] + noise[b])
        return f"{seconds[a] - seconds[b]:.2f}" if seen else "0"

    results = {}
    for variant, options in variants.items():
        simulate(args.sat3d, scene, folder / variant, options)
        results[variant] = result(folder / variant)

    print(f"\n### `{name}.toml`\n")
    print("| effect | called for | cause | bound of leaving it out, m | costs, s | heights change by, m | pixels that change |")
    print("|---|---|---|---|---|---|---|")
    for effect in effects:
        step = plan[effect]
        left_out = steps(args.sat3d, scene, ["--without", effect])[effect]["bound"]
        bound = max(left_out["horizontal_m"], left_out["vertical_m"])
        cost = difference("plan", effect) if effect in on else difference(effect, "plan")
        print(
            f"| `{effect}` | {'yes' if effect in on else 'no'} | {step['cause']} | {number(bound)} "
            f"| {cost} "
            f"| {change(results['plan'], results[effect])} |"
        )
    heights, pixels = change(results["all"], results["plan"]).split(" | ")
    print(
        f"\nThe plan's choice takes {seconds['plan']:.2f} s, everything forced {seconds['all']:.2f} s, nothing "
        f"{seconds['none']:.2f} s. Against everything forced the plan's heights differ by {heights} m, and {pixels} of the pixels."
    )
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
        shades = [shade(args.sat3d, folder / variant) for variant in ("plan", "none")]
        images = [results[variant][0] for variant in ("plan", "none")]
        sheet(images, shades, args.pictures / f"effects_{name}.png")


def one_image(text, pixels, path):
    """The scene with one satellite image, that in its middle: no second one fits beside it."""
    if "[images]" not in text:
        text += "\n[images]\n"
    path.write_text(text.replace("[images]\n", f"[images]\nsize_pixels = {pixels}\nspacing_pixels = 4000.0\n"))
    return path


def steps(sat3d, scene, options):
    command = [sat3d, "-q", "simulate", scene, "--explain", "--json", *options]
    plan = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return {step["id"]: step for step in plan["steps"]}


def simulate(sat3d, scene, out, options):
    """Runs a variant; seconds of processor time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sat3d, "-q", "simulate", scene, "--out", out, *options]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "RAYON_NUM_THREADS": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def result(out):
    """The image as levels, and all cells of the lidar in metres."""
    image = next((out / "vigor/Seattle/satellite").glob("*.png"))
    tiles = [np.asarray(Image.open(tile)).ravel() for tile in sorted((out / "lidar").glob("*.tif"))]
    feet = np.concatenate(tiles).astype(float)
    return np.asarray(Image.open(image).convert("RGB")), np.where(feet < -9000, np.nan, feet * 1200 / 3937)


def shade(sat3d, out):
    """The program's picture of the DSM that it builds of the lidar."""
    command = [sat3d, "-q", "dsm-bench", "build", "--lidar", out / "lidar", "--vigor", out / "vigor/Seattle"]
    command += ["--out", out / "dsm", "--coverage", "mosaic", "--max-nan", "100", "--preview"]
    subprocess.run(command, check=True, capture_output=True)
    return Image.open(next((out / "dsm").glob("*_dsm.png"))).convert("RGB")


def change(a, b):
    """Largest difference of heights that both have, cells that one lacks, and pixels whose colour differs."""
    both = ~np.isnan(a[1]) & ~np.isnan(b[1])
    heights = number(float(np.abs(a[1] - b[1])[both].max()))
    lost = np.count_nonzero(np.isnan(a[1]) != np.isnan(b[1])) / a[1].size
    if lost:
        heights += f", {share(lost)} have none"
    pixels = np.any(a[0] != b[0], axis=2)
    return f"{heights} | {share(np.count_nonzero(pixels) / pixels.size)}"


def share(value):
    return "0" if value == 0 else f"{100 * value:.2g} %"


def number(value):
    if value == 0:
        return "0"
    return f"{value:.2f}" if value >= 0.1 else re.sub(r"e-0?", "e-", f"{value:.1e}")


def sheet(images, shades, path):
    """Image and DSM, above as the plan has them, below without any effect."""
    whole = Image.new("RGB", (2 * SIDE + 4, 2 * SIDE + 4), "white")
    for row, (image, shaded) in enumerate(zip(images, shades)):
        for column, picture in enumerate([Image.fromarray(image), shaded]):
            place = (column * (SIDE + 4), row * (SIDE + 4))
            whole.paste(picture.resize((SIDE, SIDE), Image.Resampling.BOX), place)
    whole.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
