"""Pictures of every kind beside the RGB that Pillow, GDAL or arithmetic say they hold.

pictures.py FOLDER writes NAME, NAME.rgb (rows from the top, three bytes a pixel) and NAME.mask (a byte a pixel: 255,
or 0 for no data) for each, and prints one line for each: NAME, columns, rows.
"""

import shutil
import struct
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import rasterio
from PIL import Image
from rasterio.enums import ColorInterp
from rasterio.shutil import copy
from rasterio.transform import from_origin

warnings.filterwarnings("ignore")
folder = Path(sys.argv[1])
random = np.random.default_rng(4)


def scene(height, width, bands=3):
    """Smooth shades, edges and noise: what upsampling and rounding are seen in."""
    y, x = np.mgrid[0:height, 0:width]
    shades = [128 + 100 * np.sin(x / (5 + band)) * np.cos(y / (7 - band)) for band in range(bands)]
    picture = np.stack(shades, -1) + random.normal(0, 12, (height, width, bands))
    picture[height // 3 : height // 2, width // 4 : width // 2] = [250, 20, 60, 128][:bands]
    return picture.clip(0, 255).astype(np.uint8)


def put(name, rgb, valid=None):
    rgb = np.ascontiguousarray(rgb, np.uint8)
    (folder / f"{name}.rgb").write_bytes(rgb.tobytes())
    if valid is None:
        with rasterio.open(folder / name) as source:
            valid = source.dataset_mask() != 0
    assert valid.shape == rgb.shape[:2], name
    (folder / f"{name}.mask").write_bytes(np.where(valid, 255, 0).astype(np.uint8).tobytes())
    print(name, rgb.shape[1], rgb.shape[0])


def as_pillow(name):
    with Image.open(folder / name) as picture:
        put(name, np.asarray(picture.convert("RGB")), np.asarray(picture.convert("RGBA"))[..., 3] != 0)


def png(name, samples, colour, bits, interlaced=False, palette=None, transparent=None):
    """PNG by hand, because Pillow writes neither interlaced nor 16-bit colour pictures."""
    height, width = samples.shape[:2]
    samples = samples.reshape(height, width, -1)

    def rows(part):
        out = b""
        for row in part:
            values = row.ravel()
            if bits == 16:
                data = values.astype(">u2").tobytes()
            elif bits == 8:
                data = values.astype("u1").tobytes()
            else:
                text = "".join(f"{v:0{bits}b}" for v in values)
                text += "0" * (-len(text) % 8)
                data = int(text, 2).to_bytes(len(text) // 8, "big")
            out += b"\0" + data
        return out

    passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    if interlaced:
        parts = [samples[y::dy, x::dx] for x, y, dx, dy in passes]
        raw = b"".join(rows(part) for part in parts if part.size)
    else:
        raw = rows(samples)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    body = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, int(interlaced)))
    if palette is not None:
        body += chunk(b"PLTE", palette.astype("u1").tobytes())
    if transparent is not None:
        body += chunk(b"tRNS", transparent)
    body += chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    (folder / name).write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def pngs():
    for height, width in [(37, 53), (1, 1), (3, 2)]:
        picture = scene(height, width, 4)
        palette = random.integers(0, 256, (256, 3))
        for interlaced in [False, True]:
            tail = f"{width}x{height}{'_interlaced' if interlaced else ''}.png"
            for bits in [1, 2, 4, 8]:
                shades = picture[..., 0] >> (8 - bits)
                png(f"grey{bits}_{tail}", shades, 0, bits, interlaced)
                png(f"palette{bits}_{tail}", shades, 3, bits, interlaced, palette[: 2**bits])
                names = [f"grey{bits}_{tail}", f"palette{bits}_{tail}"]
                if bits == 8:
                    png(f"palette_alpha_{tail}", shades, 3, 8, interlaced, palette, bytes(range(0, 250, 5)))
                    png(f"rgb_{tail}", picture[..., :3], 2, 8, interlaced)
                    png(f"rgb_key_{tail}", picture[..., :3], 2, 8, interlaced, transparent=b"\0\xfa\0\x14\0\x3c")
                    png(f"grey_key_{tail}", shades, 0, 8, interlaced, transparent=b"\0\xfa")
                    png(f"grey_alpha_{tail}", picture[..., [0, 3]], 4, 8, interlaced)
                    png(f"rgba_{tail}", picture, 6, 8, interlaced)
                    kinds = ["palette_alpha", "rgb", "rgb_key", "grey_key", "grey_alpha", "rgba"]
                    names += [f"{kind}_{tail}" for kind in kinds]
                for name in names:
                    as_pillow(name)
            # Pillow cuts 16 bits off at 255 or takes the upper byte; this is what is meant.
            deep = random.integers(0, 65536, (height, width, 4))
            deep[..., 3] *= random.integers(0, 2, (height, width))
            deep[0, 0, 3] = 1
            eight = np.floor(deep / 257 + 0.5)
            for kind, colour, bands, rgb in [
                ("grey16", 0, [0], [0, 0, 0]),
                ("grey_alpha16", 4, [0, 3], [0, 0, 0]),
                ("rgb16", 2, [0, 1, 2], [0, 1, 2]),
                ("rgba16", 6, [0, 1, 2, 3], [0, 1, 2]),
            ]:
                png(f"{kind}_{tail}", deep[..., bands], colour, 16, interlaced)
                # A trace of 1 / 65535 is data; Pillow takes alpha's upper byte.
                put(f"{kind}_{tail}", eight[..., rgb], deep[..., bands[-1]] != 0 if 3 in bands else eight[..., 0] >= 0)


def holes(height, width):
    """Alpha of 0 in a block and here and there, 1, 254 and 255."""
    alpha = random.choice(np.array([0, 1, 254, 255], np.uint8), (height, width), p=[0.1, 0.2, 0.3, 0.4])
    alpha[: height // 3, width // 2 :] = 0
    return alpha


def masked_pngs():
    height, width = 61, 47
    picture = np.dstack([scene(height, width), holes(height, width)])
    palette = random.integers(0, 256, (256, 3))
    for interlaced in [False, True]:
        tail = "interlaced.png" if interlaced else "rows.png"
        png(f"masked_rgba_{tail}", picture, 6, 8, interlaced)
        png(f"masked_grey_{tail}", picture[..., [0, 3]], 4, 8, interlaced)
        png(f"masked_palette_{tail}", picture[..., 0], 3, 8, interlaced, palette, bytes([0, 255, 1, 0, 9] * 40))
        png(f"masked_palette2_{tail}", picture[..., 0] >> 6, 3, 2, interlaced, palette[:4], b"\xff\0")
        png(f"masked_key_{tail}", picture[..., 0] >> 4, 0, 4, interlaced, transparent=b"\0\x09")
        for kind in ["rgba", "grey", "palette", "palette2"]:
            as_pillow(f"masked_{kind}_{tail}")
        # Pillow compares the shade of 4 bits with the pixels of 8.
        shades = picture[..., 0] >> 4
        put(f"masked_key_{tail}", np.stack([shades * 17] * 3, -1), shades != 9)


def jpegs():
    for height, width in [(97, 131), (1, 1), (2, 3), (16, 16), (17, 33), (8, 5), (33, 1), (5, 64)]:
        picture = scene(height, width)
        for subsampling in [0, 1, 2]:
            for progressive in [False, True]:
                name = f"s{subsampling}{'p' if progressive else 'b'}_{width}x{height}.jpg"
                Image.fromarray(picture).save(
                    folder / name, quality=[95, 75, 30][subsampling], subsampling=subsampling, progressive=progressive
                )
                as_pillow(name)
        Image.fromarray(picture[..., 0]).save(folder / f"grey_{width}x{height}.jpg", quality=80)
        Image.fromarray(picture[..., 0]).save(folder / f"greyp_{width}x{height}.jpg", progressive=True)
        Image.fromarray(picture).save(folder / f"rgb_{width}x{height}.jpg", keep_rgb=True, subsampling=0)
        Image.fromarray(picture).save(folder / f"restart_{width}x{height}.jpg", restart_marker_blocks=2)
        Image.fromarray(picture).save(
            folder / f"restartp_{width}x{height}.jpg", restart_marker_rows=1, progressive=True, optimize=True
        )
        for kind in ["grey", "greyp", "rgb", "restart", "restartp"]:
            as_pillow(f"{kind}_{width}x{height}.jpg")
        for kind, factor in [("440", 0x121111), ("411", 0x411111)]:
            name = f"{kind}_{width}x{height}.jpg"
            cv2.imwrite(str(folder / name), picture, [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor])
            as_pillow(name)


def tiff(name, bands, **options):
    """Bands first; `colours` and `palette` are set where they are given."""
    colours, palette = options.pop("colours", None), options.pop("palette", None)
    count, height, width = bands.shape
    profile = dict(
        driver="GTiff", count=count, height=height, width=width, dtype=str(bands.dtype), crs="EPSG:32610",
        transform=from_origin(550_000, 5_270_000, 0.25, 0.25), **options,
    )
    with rasterio.open(folder / name, "w", **profile) as out:
        if colours:
            out.colorinterp = colours
        if palette:
            out.write_colormap(1, palette)
        out.write(bands)


def masked_tiffs():
    picture = scene(211, 307, 4)
    alpha = holes(211, 307)
    # Black without data, black with: in one band of four, and in all but the last.
    picture[alpha == 0] = 0
    picture[3:9, 3:9, :3] = 0
    picture[3:9, 3:9, 3] = 77
    picture[20:29, 3:9, 1:3] = 0
    rgb, bands = picture[..., :3], np.moveaxis(picture, -1, 0)
    rgba = np.concatenate([bands[:3], alpha[None]])
    infrared = np.concatenate([bands, alpha[None]])
    red_green_blue = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    for layout, options in {
        "strips": {},
        "tiles": dict(tiled=True, blockxsize=64, blockysize=32, compress="deflate"),
        "planar": dict(interleave="band", compress="lzw"),
        "planar_tiles": dict(interleave="band", tiled=True, blockxsize=64, blockysize=32),
        "big_endian": dict(ENDIANNESS="BIG", compress="packbits", blockysize=7),
    }.items():
        tiff(f"masked_rgba_{layout}.tif", rgba, photometric="RGB", alpha="YES", **options)
        put(f"masked_rgba_{layout}.tif", rgb)
        tiff(f"masked_associated_{layout}.tif", rgba, photometric="RGB", alpha="PREMULTIPLIED", **options)
        put(f"masked_associated_{layout}.tif", rgb)
        tiff(f"masked_grey_alpha_{layout}.tif", rgba[[0, 3]], alpha="YES", **options)
        put(f"masked_grey_alpha_{layout}.tif", rgb[..., [0, 0, 0]])
        tiff(f"masked_nodata_{layout}.tif", rgba[:3], photometric="RGB", nodata=0, **options)
        put(f"masked_nodata_{layout}.tif", rgb)
        tiff(f"masked_grey_{layout}.tif", rgba[:1], nodata=0, **options)
        put(f"masked_grey_{layout}.tif", rgb[..., [0, 0, 0]])
        # All four bands count; `dataset_mask` takes the fourth of four for alpha.
        tiff(f"masked_infrared_{layout}.tif", bands, photometric="RGB", nodata=0, alpha="NO", **options)
        with rasterio.open(folder / f"masked_infrared_{layout}.tif") as source:
            put(f"masked_infrared_{layout}.tif", rgb, source.read_masks().any(0))
        # rasterio looks for alpha in pictures of two and four bands only, or takes one of both; this is our rule.
        five = dict(colours=[*red_green_blue, ColorInterp.undefined, ColorInterp.alpha], photometric="RGB")
        tiff(f"masked_five_{layout}.tif", infrared, **five, **options)
        put(f"masked_five_{layout}.tif", rgb, alpha != 0)
        tiff(f"masked_both_{layout}.tif", rgba, photometric="RGB", alpha="YES", nodata=20, **options)
        with rasterio.open(folder / f"masked_both_{layout}.tif") as source:
            valid = source.read_masks([1, 2, 3]).any(0) & (source.read(4) != 0)
        put(f"masked_both_{layout}.tif", rgb, valid)
        for kind, more in {"inside": dict(GDAL_TIFF_INTERNAL_MASK=True), "beside": dict(GDAL_TIFF_INTERNAL_MASK=False)}.items():
            # A side file is GDAL's matter.
            name = f"{'gdal_' if kind == 'beside' else ''}masked_{kind}_{layout}.tif"
            with rasterio.Env(**more):
                tiff(name, rgba[:3], photometric="RGB", **options)
                with rasterio.open(folder / name, "r+") as out:
                    out.write_mask(alpha != 0)
            put(name, rgb)
    index = bands[0]
    colours = {i: (i, 255 - i, i // 2, 255) for i in range(256)}
    tiff("masked_palette.tif", bands[:1], palette=colours, nodata=0)
    put("masked_palette.tif", np.stack([index, 255 - index, index // 2], -1))
    tiff("masked_sparse.tif", np.full_like(rgba[:3], 9), photometric="RGB", tiled=True, nodata=9, SPARSE_OK="TRUE")
    put("masked_sparse.tif", np.full_like(rgb, 9))
    tiff("masked_sparse_alpha.tif", np.zeros_like(rgba), photometric="RGB", alpha="YES", tiled=True, SPARSE_OK="TRUE")
    put("masked_sparse_alpha.tif", np.zeros_like(rgb))
    tiff("masked_impossible.tif", rgba[:3], photometric="RGB", nodata=0)
    # A value that no byte has, by the tag itself.
    data = (folder / "masked_impossible.tif").read_bytes()
    tag = data.find(struct.pack("<HHI", 42113, 2, 2))
    assert tag > 0
    (folder / "masked_impossible.tif").write_bytes(data[: tag + 8] + b"-\0\0\0" + data[tag + 12 :])
    put("masked_impossible.tif", rgb, alpha >= 0)
    values = dict(photometric="RGB", nodata=None)
    tiff("masked_values.tif", rgba[:3], **values)
    with rasterio.open(folder / "masked_values.tif", "r+") as out:
        out.update_tags(NODATA_VALUES="250 20 60")
    put("masked_values.tif", rgb)
    for name in ["rgba_tiles", "nodata_strips", "infrared_strips", "inside_tiles", "grey_alpha_strips", "both_strips", "five_tiles"]:
        copy(folder / f"masked_{name}.tif", folder / f"gdal_masked_{name}.vrt", driver="VRT")
        own = [(folder / f"masked_{name}.tif{kind}").read_bytes() for kind in [".rgb", ".mask"]]
        put(
            f"gdal_masked_{name}.vrt",
            np.frombuffer(own[0], np.uint8).reshape(211, 307, 3),
            np.frombuffer(own[1], np.uint8).reshape(211, 307) != 0,
        )
    copy(folder / "masked_rgba_tiles.tif", folder / "masked_cog.tif", driver="COG", compress="deflate", blocksize=128)
    put("masked_cog.tif", rgb)
    copy(folder / "masked_inside_tiles.tif", folder / "masked_cog_mask.tif", driver="COG", compress="lzw", blocksize=128)
    put("masked_cog_mask.tif", rgb)


def tiffs():
    picture = scene(211, 307, 4)
    bands = np.moveaxis(picture, -1, 0)
    rgb = picture[..., :3]
    for layout, options in {
        "strips": {},
        "tiles": dict(tiled=True, blockxsize=64, blockysize=32),
        "planar": dict(interleave="band"),
        "planar_tiles": dict(interleave="band", tiled=True, blockxsize=64, blockysize=32),
        "big": dict(BIGTIFF="YES", blockysize=200),
        "big_endian": dict(ENDIANNESS="BIG"),
    }.items():
        for compress, more in {
            "none": {}, "deflate": dict(predictor=2), "lzw": {}, "packbits": {}, "zstd": dict(predictor=2),
        }.items():
            name = f"{layout}_{compress}.tif"
            tiff(name, bands[:3], photometric="RGB", compress=compress, **more, **options)
            put(name, rgb)
    for compress in ["lerc", "lzma", "webp"]:
        more = dict(WEBP_LOSSLESS="YES", tiled=True) if compress == "webp" else {}
        try:
            tiff(f"gdal_{compress}.tif", bands[:3], photometric="RGB", compress=compress, **more)
        except rasterio.errors.RasterioError:
            continue
        put(f"gdal_{compress}.tif", rgb)
    tiff("rgba.tif", bands, photometric="RGB", alpha="YES", compress="deflate")
    put("rgba.tif", rgb)
    tiff("unnamed.tif", bands[:3], photometric="MINISBLACK")
    put("unnamed.tif", rgb)
    swapped = [ColorInterp.blue, ColorInterp.green, ColorInterp.red]
    tiff("swapped.tif", bands[:3], photometric="MINISBLACK", colours=swapped)
    put("swapped.tif", rgb[..., ::-1])
    tiff("grey.tif", bands[:1])
    put("grey.tif", rgb[..., [0, 0, 0]])
    tiff("grey_alpha.tif", bands[[0, 3]], alpha="YES")
    put("grey_alpha.tif", rgb[..., [0, 0, 0]])
    tiff("white_is_zero.tif", bands[:1], photometric="MINISWHITE")
    as_pillow("white_is_zero.tif")
    colours = random.integers(0, 256, (256, 3))
    tiff("palette.tif", bands[:1], palette={i: tuple(int(v) for v in c) for i, c in enumerate(colours)})
    put("palette.tif", colours[bands[0]])
    # A palette that came after the pixels, and one in a side file.
    tiff("palette_late.tif", bands[:1])
    with rasterio.open(folder / "palette_late.tif", "r+") as out:
        out.write_colormap(1, {i: tuple(int(v) for v in c) for i, c in enumerate(colours)})
    put("palette_late.tif", colours[bands[0]])
    tiff("gdal_side_palette.tif", bands[:1])
    entries = "".join(f'<Entry c1="{r}" c2="{g}" c3="{b}" c4="255"/>' for r, g, b in colours)
    (folder / "gdal_side_palette.tif.aux.xml").write_text(
        f'<PAMDataset><PAMRasterBand band="1"><ColorInterp>Palette</ColorInterp><ColorTable>{entries}</ColorTable>'
        "</PAMRasterBand></PAMDataset>"
    )
    with rasterio.open(folder / "gdal_side_palette.tif") as source:
        table = source.colormap(1)
    put("gdal_side_palette.tif", np.array([table[i][:3] for i in range(256)])[bands[0]])
    tiff("sparse.tif", np.zeros_like(bands[:3]), photometric="RGB", tiled=True, SPARSE_OK="TRUE")
    put("sparse.tif", np.zeros_like(rgb))
    tiff("nodata.tif", bands[:3], photometric="RGB", nodata=0)
    put("nodata.tif", rgb)
    for kind, more in {"ycbcr": dict(photometric="YCBCR"), "rgb": dict(photometric="RGB")}.items():
        name = f"gdal_jpeg_{kind}.tif"
        tiff(name, bands[:3], compress="jpeg", tiled=True, blockxsize=64, blockysize=64, **more)
        # JPEG libraries differ in how they enlarge colours: read it with the library that sat3d links.
        raw = folder / "jpeg.raw"
        options = ["-q", "-of", "ENVI", "-co", "INTERLEAVE=BIP"]
        if shutil.which("gdal_translate"):
            subprocess.run(["gdal_translate", *options, folder / name, raw], check=True)
            put(name, np.fromfile(raw, np.uint8).reshape(211, 307, 3))
    copy(folder / "tiles_deflate.tif", folder / "cog.tif", driver="COG", compress="deflate", blocksize=128)
    put("cog.tif", rgb)
    copy(folder / "tiles_deflate.tif", folder / "gdal.vrt", driver="VRT")
    put("gdal.vrt", rgb)
    Image.fromarray(rgb).save(folder / "gdal.webp", lossless=True)
    put("gdal.webp", rgb)
    Image.fromarray(rgb).save(folder / "pillow.tif", compression="tiff_lzw")
    put("pillow.tif", rgb)


pngs()
masked_pngs()
jpegs()
tiffs()
masked_tiffs()
