#!/usr/bin/env python3
"""Makes lidar tiles large enough to measure speed on, and a list of images over them.

Six tiles in the form of Washington's King County West 2021 delivery: EPSG:2927, 1.5 US survey ft
pixels, heights in US survey feet, float32, deflate in 256 x 256 blocks, nodata -9999, a little
overlap. Terrain, roofs, trees and 2 cm of noise give heights that compress about as real ones do.
The same seed gives the same tiles.

    make_lidar.py OUT_FOLDER [--pixels 8192] [--images 400]
"""

import argparse
import math
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin
from rasterio.windows import Window

CENTRE = (47.6097, -122.3331)
PIXEL_FT = 1.5
M_PER_FT = 1200 / 3937
BAND_ROWS = 512


def surface(east_m, north_m, seed):
    """Heights in metres at the given local coordinates (one axis each), as a grid."""
    x, y = np.meshgrid(east_m, north_m)
    height = 40 + 12 * np.sin(x / 310) * np.cos(y / 270) + 3 * np.sin(x / 47 + y / 61)
    # A roof on every lot of 24 x 32 m, with a random height and ridge; every fifth lot has trees.
    column, row = np.floor(x / 24).astype(np.int64), np.floor(y / 32).astype(np.int64)
    lot = (column * 73856093) ^ (row * 19349663) ^ seed
    chance = ((lot * 2654435761) % 4294967296) / 4294967296
    u, v = x / 24 - column, y / 32 - row
    house = (np.abs(u - 0.5) < 0.3) & (np.abs(v - 0.5) < 0.35) & (chance < 0.75)
    roof = 4 + 22 * chance**3 + 3 * (1 - np.abs(u - 0.5) / 0.3)
    height += np.where(house, roof, 0)
    bumps = 6 * np.abs(np.sin(x * 1.1 + chance * 9) * np.sin(y * 0.9))
    height += np.where(~house & (chance > 0.8), bumps, 0)
    return height


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--pixels", type=int, default=8192, help="side of a tile")
    parser.add_argument("--images", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    to_tile = Transformer.from_crs(4326, 2927, always_xy=True)
    centre_x, centre_y = to_tile.transform(CENTRE[1], CENTRE[0])
    step = args.pixels - 64
    left = centre_x - 1.5 * step * PIXEL_FT
    top = centre_y + step * PIXEL_FT
    for index, number in enumerate((87, 88, 89, 90, 111, 112)):
        column, row = index % 3, index // 3
        x0 = left + column * step * PIXEL_FT
        y0 = top - row * step * PIXEL_FT
        random = np.random.default_rng([args.seed, number])
        profile = dict(
            driver="GTiff", width=args.pixels, height=args.pixels, count=1, dtype="float32",
            crs="EPSG:2927", transform=from_origin(x0, y0, PIXEL_FT, PIXEL_FT), nodata=-9999,
            tiled=True, blockxsize=256, blockysize=256, compress="deflate", predictor=3,
        )
        path = args.out / f"king_county_west_2021_dsm_{number}.tif"
        with rasterio.open(path, "w", **profile) as tile:
            east = (x0 - centre_x + (np.arange(args.pixels) + 0.5) * PIXEL_FT) * M_PER_FT
            for first in range(0, args.pixels, BAND_ROWS):
                rows = np.arange(first, min(first + BAND_ROWS, args.pixels))
                north = (y0 - centre_y - (rows + 0.5) * PIXEL_FT) * M_PER_FT
                metres = surface(east, north, args.seed) + random.normal(0, 0.02, (len(rows), args.pixels))
                window = Window(0, first, args.pixels, len(rows))
                tile.write((metres / M_PER_FT).astype(np.float32), 1, window=window)
        print(path)

    # VIGOR's density: centres 362.5 pixels of zoom 20 apart, in a block around the centre.
    side = math.ceil(math.sqrt(args.images))
    world = 256 * 2**20
    sine = math.sin(math.radians(CENTRE[0]))
    px = (CENTRE[1] + 180) / 360 * world
    py = (0.5 - math.log((1 + sine) / (1 - sine)) / (4 * math.pi)) * world
    names = []
    for k in range(args.images):
        i, j = k % side - side / 2, k // side - side / 2
        lon = (px + 362.5 * i) / world * 360 - 180
        lat = math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * (py + 362.5 * j) / world))))
        names.append(f"satellite_{lat:.10f}_{lon:.10f}.png")
    (args.out / "images.txt").write_text("\n".join(names) + "\n")


if __name__ == "__main__":
    main()
