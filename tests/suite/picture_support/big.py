"""Writes big.png, big.jpg, big_progressive.jpg and big.tif, 20,000 x 4,000 pixels, into FOLDER: big.py FOLDER [ROWS]."""

import sys
from pathlib import Path

import numpy as np
import rasterio
from PIL import Image

folder = Path(sys.argv[1])
width, height = 20_000, int(sys.argv[2]) if len(sys.argv) > 2 else 4000
y, x = np.mgrid[0:height, 0:width].astype(np.float32)
shade = (128 + 60 * np.sin(x / 37) * np.cos(y / 23)).astype(np.uint8)
rgb = np.stack([shade, shade // 2 + 60, 255 - shade], -1)
rgb += np.random.default_rng(0).integers(0, 8, (height, width, 1), dtype=np.uint8)
picture = Image.fromarray(rgb)
picture.save(folder / "big.png", compress_level=1)
picture.save(folder / "big.jpg", quality=90)
picture.save(folder / "big_progressive.jpg", quality=90, progressive=True)
with rasterio.open(
    folder / "big.tif", "w", driver="GTiff", count=3, width=width, height=height, dtype="uint8", tiled=True,
    blockxsize=256, blockysize=256, compress="deflate", photometric="RGB",
) as out:
    out.write(np.moveaxis(rgb, -1, 0))
