"""A contact sheet of `sat3d simulate --random`: satellite images, heights above ground, panoramas.

    sat3d simulate --random 12 --seed 7 --out scenes
    python benches/studies/random_scenes_sheet.py scenes sheet.png

Needs numpy and Pillow.
"""

import json
import pathlib
import sys

import numpy
from PIL import Image

SIDE = 256
COLUMNS = 6
HIGHEST_M = 20.0
# Stops of the plasma colour map.
STOPS = numpy.array([[13, 8, 135], [126, 3, 168], [204, 71, 120], [248, 149, 64], [240, 249, 33]], float)


def plasma(values):
    at = numpy.clip(values, 0, 1) * (len(STOPS) - 1)
    low = numpy.minimum(at.astype(int), len(STOPS) - 2)
    return (STOPS[low] + (STOPS[low + 1] - STOPS[low]) * (at - low)[..., None]).astype(numpy.uint8)


def main(folder, out):
    folder = pathlib.Path(folder)
    scenes = json.loads((folder / "scenes.json").read_text())["scenes"]
    cell = (SIDE, 2 * SIDE + SIDE // 2)
    rows = -(-len(scenes) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * cell[0], rows * cell[1]))
    for number, scene in enumerate(scenes):
        x, y = number % COLUMNS * cell[0], number // COLUMNS * cell[1]
        city = folder / "vigor" / "Seattle"
        image = Image.open(city / "satellite" / scene["satellite"]).convert("RGB")
        sheet.paste(image.resize((SIDE, SIDE)), (x, y))
        truth = numpy.load(folder / "truth" / scene["satellite"].replace(".png", "_dsm.npz"))
        heights = Image.fromarray(plasma((truth["dsm"] - truth["dtm"]) / HIGHEST_M))
        sheet.paste(heights.resize((SIDE, SIDE)), (x, y + SIDE))
        if scene["panorama"]:
            name = scene["panorama"]["name"]
            view = numpy.array(Image.open(city / "panorama" / name).convert("RGB"))
            mask = Image.open(city / "pano_sky_mask" / f"{name.removesuffix('.jpg')}.png")
            # The sky is dimmed in the right half of each panorama, to show the mask.
            dim = (numpy.array(mask) > 0) & (numpy.arange(view.shape[1]) > view.shape[1] // 2)
            view[dim] //= 3
            sheet.paste(Image.fromarray(view).resize((SIDE, SIDE // 2)), (x, y + 2 * SIDE))
    sheet.save(out)


if __name__ == "__main__":
    main(*sys.argv[1:3])
