#!/usr/bin/env python3
"""Builds the DSM of each image with rasterio, by the procedure of the paper's Algorithm 1 as its
authors released it. An independent program, written to measure against and to compare with:

* `sat3d dsm-bench build --grid reference` must agree with it within 0.001 m;
* `benches/peers/run.sh` runs both on the same images and reports images per second.

The procedure, per image:

1. ground size of a pixel by the usual Web-Mercator rule, image box in degrees with 111.32 km per
   degree of latitude;
2. the box's lower left and upper right corner projected to the tile's CRS: an axis-aligned grid
   there (the true image is turned by the meridian convergence; sat3d's default grid is exact);
3. one bilinear reprojection per tile that the box touches; the one with the most valid pixels wins,
   the first of equals;
4. US survey feet to metres; more than 5 % without data: no DSM;
5. `<stem>_dsm.npz`, compressed, key `dsm`.

    reference_dsm.py LIDAR_FOLDER IMAGE_LIST OUT_FOLDER [--jobs N]
"""

import argparse
import json
import math
import multiprocessing
import re
import sys
import time
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.transform import from_bounds
from rasterio.warp import Resampling, reproject

EQUATOR_M_PER_PIXEL = 156543.03  # at zoom 0, 256 pixels around
KM_PER_DEGREE = 111.32
US_SURVEY_FOOT_M = 0.304800609601219


def image_box(name, size, zoom):
    """West, south, east, north of an image in degrees, by the reference's approximation."""
    lat, lon = (float(part) for part in Path(name).stem.split("_")[-2:])
    cosine = math.cos(math.radians(lat))
    side_km = size * EQUATOR_M_PER_PIXEL * cosine / 2**zoom / 1000.0
    half_lon = side_km / (KM_PER_DEGREE * cosine) / 2.0
    half_lat = side_km / KM_PER_DEGREE / 2.0
    return lon - half_lon, lat - half_lat, lon + half_lon, lat + half_lat


class Tiles:
    """Paths, coordinate systems and boxes (in degrees) of all tiles of a folder."""

    def __init__(self, folder):
        self.tiles = []
        self.projections = {}
        natural = lambda p: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", p.name)]
        for path in sorted(Path(folder).glob("*.tif"), key=natural):
            with rasterio.open(path) as tile:
                to_degrees = Transformer.from_crs(tile.crs, 4326, always_xy=True)
                west, south = to_degrees.transform(tile.bounds.left, tile.bounds.bottom)
                east, north = to_degrees.transform(tile.bounds.right, tile.bounds.top)
                self.tiles.append((path, tile.crs, (west, south, east, north)))

    def touching(self, box):
        west, south, east, north = box
        return [
            (path, crs)
            for path, crs, (w, s, e, n) in self.tiles
            if not (east < w or west > e or north < s or south > n)
        ]

    def projection(self, crs):
        key = crs.to_wkt()
        if key not in self.projections:
            self.projections[key] = Transformer.from_crs(4326, crs, always_xy=True)
        return self.projections[key]


def build(name, tiles, args):
    """Builds one image; `done`, `no tile`, `no data` or `too empty`."""
    box = image_box(name, args.size, args.zoom)
    candidates = tiles.touching(box)
    if not candidates:
        return "no tile"
    crs = candidates[0][1]
    project = tiles.projection(crs).transform
    grid = from_bounds(*project(*box[:2]), *project(*box[2:]), args.size, args.size)
    best, most = None, 0
    for path, _ in candidates:
        heights = np.full((args.size, args.size), np.nan, np.float32)
        with rasterio.open(path) as tile:
            reproject(
                rasterio.band(tile, 1),
                heights,
                dst_transform=grid,
                dst_crs=crs,
                dst_nodata=np.nan,
                resampling=Resampling.bilinear,
            )
        valid = np.count_nonzero(~np.isnan(heights))
        if valid > most:
            best, most = heights, valid
    if best is None:
        return "no data"
    if 100.0 * (1.0 - most / best.size) > args.max_nan:
        return "too empty"
    dsm = best * np.float32(args.metres_per_unit)
    np.savez_compressed(args.out / f"{Path(name).stem}_dsm.npz", dsm=dsm)
    return "done"


def start(args):
    """Prepares a worker process: every one has its own index, as every run of the script has."""
    global STATE
    STATE = (Tiles(args.lidar), args)


def work(name):
    return build(name, *STATE)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lidar", type=Path, help="folder of GeoTIFF tiles")
    parser.add_argument("images", type=Path, help="text file with image names, one a line")
    parser.add_argument("out", type=Path, help="folder for the .npz files")
    parser.add_argument("--size", type=int, default=640)
    parser.add_argument("--zoom", type=int, default=20)
    parser.add_argument("--max-nan", type=float, default=5.0, help="per cent")
    parser.add_argument("--metres-per-unit", type=float, default=US_SURVEY_FOOT_M)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    args = parser.parse_args()
    names = [line.strip() for line in args.images.read_text().splitlines() if line.strip()]
    args.out.mkdir(parents=True, exist_ok=True)

    began = time.perf_counter()
    if args.jobs == 1:
        start(args)
        results = [work(name) for name in names]
    else:
        with multiprocessing.Pool(args.jobs, start, (args,)) as pool:
            results = pool.map(work, names, chunksize=max(1, len(names) // (8 * args.jobs)))
    seconds = time.perf_counter() - began
    counts = {kind: results.count(kind) for kind in sorted(set(results))}
    json.dump({"images": len(names), "seconds": seconds, "results": counts}, sys.stdout)
    print()


if __name__ == "__main__":
    main()
