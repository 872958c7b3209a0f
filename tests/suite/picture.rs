//! Pictures as Pillow and GDAL read them, and files that are none.
//!
//! Set `SAT3D_TEST_PYTHON` to an interpreter with numpy, Pillow, OpenCV and rasterio; without one the
//! comparisons say that they were skipped.

#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::common;

use common::{python, run_python, skipped};
use proptest::prelude::*;
use sat3d::model::Image8;
use sat3d::model::preprocess::resize_bicubic;
use sat3d::picture::{
    Access, BicubicRows, Picture, PictureError, PictureOptions, ResampledPicture, Window, open,
    open_with,
};
use sat3d::tile::spool::Spool;
use std::ops::ControlFlow;
use std::path::Path;

/// Rows and windows of a picture are the same as the whole, in any order.
fn check_parts(picture: &mut Picture, whole: &[u8]) {
    let [width, height] = picture.size();
    let line = width as usize * 3;
    let mut row = 0;
    for count in [1, 3, 16, 70, 1, 1000].into_iter().cycle() {
        let end = (row + count).min(height);
        let mut out = vec![0; (end - row) as usize * line];
        picture.read_rows(row..end, &mut out).unwrap();
        assert_eq!(out, whole[row as usize * line..end as usize * line], "{picture:?} {row}");
        row = end;
        if row == height {
            break;
        }
    }
    let half = Window { x: width / 3, y: height / 2, width: width.div_ceil(2), height: height / 2 };
    let top = Window { x: 0, y: 0, width: 1, height: 1 };
    let corner = Window { x: width - 1, y: height - 1, width: 1, height: 1 };
    for window in [half, top, corner, half] {
        let mut out = vec![0; (window.width * window.height * 3) as usize];
        picture.read_window(window, &mut out).unwrap();
        for (y, row) in out.chunks_exact(window.width as usize * 3).enumerate() {
            let start = (window.y as usize + y) * line + window.x as usize * 3;
            assert_eq!(row, &whole[start..start + row.len()], "{picture:?} {window:?}");
        }
    }
}

/// The mask is the same by rows and windows, in any order, and leaves the colours alone.
fn check_mask(name: &str, picture: &mut Picture, rgb: &[u8], mask: &[u8]) {
    let [width, height] = picture.size();
    let holes = mask.iter().filter(|value| **value == 0).count();
    assert!(holes == 0 || picture.has_mask(), "{name}");
    let half = Window { x: width / 3, y: height / 2, width: width.div_ceil(2), height: height / 2 };
    let whole = Window { x: 0, y: 0, width, height };
    let row = Window { x: 0, y: height - 1, width, height: 1 };
    for window in [whole, half, row, half] {
        let pixels = (window.width * window.height) as usize;
        // What neither is nor is left as it was.
        let (mut colours, mut valid) = (vec![7; pixels * 3], vec![7; pixels]);
        picture.read_window_masked(window, &mut colours, &mut valid).unwrap();
        for y in 0..window.height as usize {
            let columns = window.width as usize;
            let start = (window.y as usize + y) * width as usize + window.x as usize;
            let (found, expected) = (&valid[y * columns..][..columns], &mask[start..][..columns]);
            if found != expected {
                let differ = found.iter().zip(expected).filter(|(a, b)| a != b).count();
                panic!("{name}: {differ} of {columns} differ in row {y} of {window:?}");
            }
            assert!(colours[y * columns * 3..][..columns * 3] == rgb[start * 3..][..columns * 3]);
        }
    }
    let error = picture.read_rows_masked(0..1, &mut vec![0; width as usize * 3], &mut []);
    assert!(matches!(error, Err(PictureError::Window { .. })), "{name}");
}

#[test]
fn pictures_are_what_pillow_and_gdal_read() {
    let test = "pictures_are_what_pillow_and_gdal_read";
    let Some(python) = python(test, "numpy, PIL, cv2, rasterio") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = include_str!("picture_support/pictures.py");
    let listing = run_python(python, script, &[folder.path()]);
    let (mut counts, mut masked) = ([0; 3], 0);
    for line in listing.lines() {
        let [name, width, height] = line.split(' ').collect::<Vec<_>>()[..] else {
            panic!("{line}")
        };
        if name.starts_with("gdal") && cfg!(not(feature = "gdal")) {
            let error = open(&folder.path().join(name)).unwrap_err().to_string();
            assert!(error.contains("GDAL"), "{error}");
            continue;
        }
        let mut picture = open(&folder.path().join(name)).unwrap_or_else(|e| panic!("{e}"));
        let size = [width, height].map(|side| side.parse::<u32>().unwrap());
        assert_eq!(picture.size(), size, "{name}");
        let expected = std::fs::read(folder.path().join(format!("{name}.rgb"))).unwrap();
        let found = picture.read().unwrap_or_else(|e| panic!("{e}")).data;
        if found != expected {
            let apart = |(a, b): (&u8, &u8)| a.abs_diff(*b);
            let worst = found.iter().zip(&expected).map(apart).max();
            let many = found.iter().zip(&expected).filter(|(a, b)| a != b).count();
            panic!("{name}: {many} of {} bytes differ, by up to {worst:?}", found.len());
        }
        check_parts(&mut picture, &expected);
        let mask = std::fs::read(folder.path().join(format!("{name}.mask"))).unwrap();
        check_mask(name, &mut picture, &expected, &mask);
        masked += usize::from(mask.contains(&0));
        let kind = match name.rsplit('.').next() {
            Some("png") => 0,
            Some("jpg") => 1,
            _ => 2,
        };
        counts[kind] += 1;
        let whole = name.contains("interlaced")
            || ["s0p", "s1p", "s2p", "greyp", "restartp"].iter().any(|p| name.starts_with(p));
        let access = match (kind, whole) {
            (2, _) => Access::Windows,
            (_, true) => Access::Whole,
            _ => Access::Rows,
        };
        assert_eq!(picture.access(), access, "{name}");
        let warned = picture.warnings().iter().any(|w| w.contains("which bands are red"));
        assert_eq!(warned, name == "unnamed.tif", "{name}: {:?}", picture.warnings());
    }
    assert!(counts[0] >= 100 && counts[1] >= 100 && counts[2] >= 80, "{counts:?}");
    assert!(masked >= 60, "{masked} pictures with pixels without data");
}

#[test]
fn real_images_are_what_pillow_reads() {
    let test = "real_images_are_what_pillow_reads";
    let data = std::env::var_os("SAT3D_TEST_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        std::path::PathBuf::from,
    );
    let images = data.join("images");
    if !images.is_dir() {
        skipped(test, &format!("no test data at {} (set SAT3D_TEST_DATA)", data.display()));
        return;
    }
    let Some(python) = python(test, "PIL, numpy") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = "
import sys, numpy as np
from pathlib import Path
from PIL import Image
for path in sorted(Path(sys.argv[1]).iterdir()):
    if path.suffix in ['.png', '.jpg']:
        rgb = np.asarray(Image.open(path).convert('RGB'))
        (Path(sys.argv[2]) / (path.name + '.rgb')).write_bytes(rgb.tobytes())
        print(path.name)
";
    let listing = run_python(python, script, &[&images, folder.path()]);
    assert!(listing.lines().count() >= 8, "{listing}");
    for name in listing.lines() {
        let mut picture = open(&images.join(name)).unwrap();
        let expected = std::fs::read(folder.path().join(format!("{name}.rgb"))).unwrap();
        assert!(picture.read().unwrap().data == expected, "{name}");
        assert_eq!(picture.place().is_some(), name.starts_with("satellite_"), "{name}");
    }
}

pub(crate) fn noise(width: usize, height: usize, channels: usize, seed: u32) -> Image8 {
    let mut state = seed | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 11) as u8
    };
    let data = (0..width * height * channels).map(|_| next()).collect();
    Image8::new(width, height, channels, data).unwrap()
}

proptest! {
    #[test]
    fn resizing_in_a_stream_is_resizing_the_whole(
        source in (1_usize..70, 1_usize..70), target in (1_usize..70, 1_usize..70),
        channels in 1_usize..5, band in 1_usize..20, taken in 1_usize..9, seed in any::<u32>(),
        keep in (any::<bool>(), any::<bool>()),
    ) {
        let width = if keep.0 { source.0 } else { target.0 };
        let height = if keep.1 { source.1 } else { target.1 };
        let image = noise(source.0, source.1, channels, seed);
        let expected = resize_bicubic(&image, width, height);
        let mut rows =
            BicubicRows::new([source.0, source.1], [width, height], channels);
        let mut found = Vec::new();
        let mut out = vec![0; taken * width * channels];
        for part in image.data.chunks(band * source.0 * channels) {
            rows.give(part);
            loop {
                let wanted = rows.wanted(1);
                let made = rows.take(&mut out);
                prop_assert_eq!(made > 0, wanted == 0 && found.len() < expected.data.len());
                if made == 0 {
                    break;
                }
                found.extend_from_slice(&out[..made * width * channels]);
            }
        }
        prop_assert_eq!(found, expected.data);
    }
}

pub(crate) fn write_png(path: &Path, image: &Image8) {
    let file = std::fs::File::create(path).unwrap();
    let mut encoder = png::Encoder::new(file, image.width as u32, image.height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&image.data).unwrap();
}

#[test]
fn a_picture_is_resized_while_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let image = noise(301, 257, 3, 7);
    write_png(&path, &image);
    for size in [[120, 103], [301, 257], [640, 500], [301, 1]] {
        let mut stream = ResampledPicture::new(open(&path).unwrap(), size);
        let mut found = Vec::new();
        let mut out = vec![0; 13 * size[0] as usize * 3];
        loop {
            match stream.next_rows(&mut out).unwrap() {
                0 => break,
                count => found.extend_from_slice(&out[..count * size[0] as usize * 3]),
            }
        }
        let expected = resize_bicubic(&image, size[0] as usize, size[1] as usize);
        assert!(found == expected.data, "{size:?}");
        assert_eq!(stream.rows_left(), 0);
    }
}

#[test]
fn a_mask_is_resized_with_its_picture() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let rgba = noise(301, 257, 4, 5);
    // Alpha is 0 in one pixel of 300 or so; of the others, one holds a trace of it.
    let mut data = rgba.data.clone();
    for (i, pixel) in data.chunks_exact_mut(4).enumerate() {
        pixel[3] = if i % 307 == 5 { 0 } else { pixel[3].max(1) };
    }
    let file = std::fs::File::create(&path).unwrap();
    let mut encoder = png::Encoder::new(file, 301, 257);
    encoder.set_color(png::ColorType::Rgba);
    encoder.write_header().unwrap().write_image_data(&data).unwrap();
    let plain: Vec<u8> = data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    let image = Image8::new(301, 257, 3, plain).unwrap();
    // The colours with all pixels without data made black, and made white.
    let painted = |colour: u8| {
        let mut image = image.clone();
        for (pixel, from) in image.data.chunks_exact_mut(3).zip(data.chunks_exact(4)) {
            if from[3] == 0 {
                pixel.fill(colour);
            }
        }
        image
    };
    for [width, height] in [[120, 103], [301, 257], [640, 500], [301, 90]] {
        let mut stream = ResampledPicture::new(open(&path).unwrap(), [width as u32, height as u32]);
        assert!(stream.picture().has_mask());
        let (mut found, mut mask) = (Vec::new(), Vec::new());
        let (mut out, mut valid) = (vec![0; 13 * width * 3], vec![0; 11 * width]);
        loop {
            match stream.next_rows_masked(&mut out, &mut valid).unwrap() {
                0 => break,
                count => {
                    assert!(count <= 11);
                    found.extend_from_slice(&out[..count * width * 3]);
                    mask.extend_from_slice(&valid[..count * width]);
                }
            }
        }
        assert!(found == resize_bicubic(&image, width, height).data, "{width} x {height}");
        assert_eq!(mask.len(), width * height);
        let (black, white) = (
            resize_bicubic(&painted(0), width, height),
            resize_bicubic(&painted(255), width, height),
        );
        let mut counts = [0; 2];
        for (i, valid) in mask.iter().enumerate() {
            assert!(matches!(valid, 0 | 255));
            counts[usize::from(*valid == 255)] += 1;
            let same = black.data[i * 3..][..3] == white.data[i * 3..][..3];
            assert!(*valid == 0 || same, "{width} x {height}: pixel {i} hangs on one without data");
        }
        assert!(counts[0] > 0 && counts[1] > 0, "{counts:?}");
    }
}

/// What `sat3d tile` says of pictures that it cannot use, and that it leaves nothing behind.
#[test]
fn bad_pictures_give_no_spool() {
    let test = "bad_pictures_give_no_spool";
    let Some(python) = python(test, "rasterio, numpy, PIL") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = "
import sys, numpy as np, rasterio
from PIL import Image
folder = sys.argv[1]
pixels = np.random.default_rng(3).integers(0, 255, (900, 300, 3), dtype=np.uint8)
Image.fromarray(pixels).save(f'{folder}/a.png')
Image.fromarray(pixels).save(f'{folder}/a.jpg')
def write(name, bands, **options):
    with rasterio.open(f'{folder}/{name}.tif', 'w', driver='GTiff', count=len(bands), dtype=str(bands.dtype),
                       height=bands.shape[1], width=bands.shape[2], photometric='RGB', **options) as out:
        out.write(bands)
write('a', np.moveaxis(pixels, -1, 0), compress='deflate', blockysize=16)
write('deep', np.ones((3, 20, 30), np.uint16))
Image.fromarray(pixels[:1]).save(f'{folder}/line.png')
";
    run_python(python, script, &[folder.path()]);
    let to = folder.path().join("a.spool");
    let spool = |path: &Path| {
        let picture = open(path).map_err(|error| error.to_string())?;
        let [width, height] = picture.size();
        let picture = ResampledPicture::new(picture, [width.div_ceil(2), height.div_ceil(2)]);
        Spool::create(picture, &to, "print", |_| ControlFlow::Continue(()))
            .map_err(|error| error.to_string())
    };
    for name in ["a.png", "a.jpg", "a.tif"] {
        let path = folder.path().join(name);
        let sound = spool(&path).unwrap();
        assert_eq!(sound.size(), [150, 450]);
        std::fs::remove_file(&to).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let error = spool(&path).unwrap_err();
        // GDAL's files have their directory in front: it is the pixels that lack.
        assert!(error.contains(name) && error.contains(" of 900"), "{error}");
        let row: u32 =
            error.split("row ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
        assert!((300..600).contains(&row), "{error}");
        let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
        assert_eq!(left.len(), 5, "{left:?}");
    }
    let error = spool(&folder.path().join("deep.tif")).unwrap_err();
    assert!(error.contains("gdal_translate -ot Byte -scale"), "{error}");
    let line = spool(&folder.path().join("line.png")).unwrap();
    assert_eq!(line.size(), [150, 1]);
    let (image, valid) = line.window(-53, -127, 256).unwrap();
    assert_eq!((image.data.len(), valid.len()), (256 * 256 * 3, 256 * 256));
    assert!(image.data.chunks_exact(256 * 3).all(|row| *row == image.data[..256 * 3]));
}

fn unreadable(path: &Path) -> String {
    let error = match open(path) {
        Err(error) => error.to_string(),
        Ok(mut picture) => match picture.read() {
            Err(error) => error.to_string(),
            Ok(_) => panic!("{} should not be read", path.display()),
        },
    };
    let name = path.file_name().unwrap().to_string_lossy();
    assert!(error.contains(&*name), "the message names no file: {error}");
    error
}

#[test]
fn what_is_no_picture_is_refused_by_name_and_value() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    assert!(unreadable(&file("empty.png", b"")).contains("0 bytes"));
    let text = unreadable(&file("text.png", b"hello, world"));
    assert!(text.contains("neither PNG nor JPEG nor TIFF: it starts with 68 65 6c 6c"), "{text}");
    assert!(unreadable(folder.path()).contains("folder"));
    assert!(matches!(open(&folder.path().join("none.png")), Err(PictureError::Io { .. })));

    let sound = folder.path().join("sound.png");
    write_png(&sound, &noise(64, 64, 3, 1));
    let bytes = std::fs::read(&sound).unwrap();
    for cut in [9, 20, 40, 60, 3000, bytes.len() - 300] {
        let error = unreadable(&file("cut.png", &bytes[..cut]));
        assert!(error.contains("ends early") || error.contains("row"), "{cut}: {error}");
    }
    let mut damaged = bytes.clone();
    damaged[4000] ^= 0x55;
    let error = unreadable(&file("damaged.png", &damaged));
    assert!(error.contains("row") && error.contains("of 64"), "{error}");

    // A size that no memory holds, with its check sum right.
    let mut header = bytes[..33].to_vec();
    header[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    let sum = crc32fast::hash(&header[12..29]);
    header[29..33].copy_from_slice(&sum.to_be_bytes());
    let error = unreadable(&file("absurd.png", &[&header, &bytes[33..]].concat()));
    assert!(error.contains("2147483647") || error.contains("size"), "{error}");

    let mut picture = open(&sound).unwrap();
    let mut out = vec![0; 64 * 3];
    let error = picture.read_rows(64..65, &mut out).unwrap_err().to_string();
    assert!(error.contains("64 x 1 pixels from (0, 64)") && error.contains("64 x 64"), "{error}");
    let error = picture.read_rows(0..2, &mut out).unwrap_err().to_string();
    assert!(error.contains("takes 384 bytes, not 192"), "{error}");
    let small = PictureOptions { memory_limit: 12_287 };
    let error = open_with(&sound, &small).unwrap().read().unwrap_err().to_string();
    assert!(error.contains("12288 bytes") && error.contains("12287"), "{error}");
}

#[test]
fn damaged_jpegs_give_errors_and_never_panic() {
    let test = "damaged_jpegs_give_errors_and_never_panic";
    let Some(python) = python(test, "PIL, numpy") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = "
import sys, numpy as np
from PIL import Image
data = np.random.default_rng(1).integers(0, 256, (61, 83, 3), dtype=np.uint8)
for name, options in dict(b={}, p=dict(progressive=True), r=dict(restart_marker_blocks=3)).items():
    Image.fromarray(data).save(f'{sys.argv[1]}/{name}.jpg', **options)
Image.fromarray(data).convert('CMYK').save(f'{sys.argv[1]}/cmyk.jpg')
";
    run_python(python, script, &[folder.path()]);
    assert!(unreadable(&folder.path().join("cmyk.jpg")).contains("4 colour components"));
    let mut state = 1_u32;
    let mut random = |limit: usize| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as usize % limit
    };
    for name in ["b", "p", "r"] {
        let bytes = std::fs::read(folder.path().join(format!("{name}.jpg"))).unwrap();
        assert!(open(&folder.path().join(format!("{name}.jpg"))).unwrap().read().is_ok());
        let path = folder.path().join("broken.jpg");
        for cut in (3..bytes.len() - 40).step_by(bytes.len() / 60) {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let error = unreadable(&path);
            assert!(error.contains("truncated") || error.contains("early"), "{cut}: {error}");
        }
        for _ in 0..400 {
            let mut broken = bytes.clone();
            for _ in 0..=random(3) {
                let at = 2 + random(broken.len() - 2);
                broken[at] = random(256) as u8;
            }
            std::fs::write(&path, &broken).unwrap();
            // Some damage cannot be seen; what matters is that there is an answer.
            let limit = PictureOptions { memory_limit: 64 << 20 };
            if let Ok(mut picture) = open_with(&path, &limit) {
                let _ = picture.read();
            }
        }
    }
}

#[test]
fn rasters_that_hold_no_colours_say_what_to_do() {
    let test = "rasters_that_hold_no_colours_say_what_to_do";
    let Some(python) = python(test, "rasterio, numpy") else { return };
    let folder = tempfile::tempdir().unwrap();
    let script = "
import sys, numpy as np, rasterio
def write(name, bands, **options):
    with rasterio.open(f'{sys.argv[1]}/{name}.tif', 'w', driver='GTiff', count=len(bands), dtype=str(bands.dtype),
                       height=bands.shape[1], width=bands.shape[2], **options) as out:
        out.write(bands)
write('reflectance', np.ones((3, 20, 30), np.uint16), compress='deflate')
write('height', np.ones((1, 20, 30), np.float32))
write('bits', np.ones((1, 20, 30), np.uint8), nbits=4)
write('cut', np.random.default_rng(1).integers(0, 255, (3, 200, 300), dtype=np.uint8), compress='deflate')
write('strip', np.ones((3, 3000, 300), np.uint8), compress='deflate', blockysize=3000)
";
    run_python(python, script, &[folder.path()]);
    let at = |name: &str| folder.path().join(format!("{name}.tif"));
    let error = unreadable(&at("reflectance"));
    assert!(
        error.contains("UInt16") && error.contains("gdal_translate -ot Byte -scale"),
        "{error}"
    );
    assert!(unreadable(&at("height")).contains("Float32"));
    assert!(unreadable(&at("bits")).contains("4 bits"));
    let bytes = std::fs::read(at("cut")).unwrap();
    std::fs::write(at("cut"), &bytes[..bytes.len() / 2]).unwrap();
    let picture = open(&at("cut"));
    if let Ok(picture) = &picture {
        assert!(picture.warnings().iter().any(|w| w.contains("truncated")), "{picture:?}");
    }
    unreadable(&at("cut"));
    let small = PictureOptions { memory_limit: 1 << 20 };
    let error = open_with(&at("strip"), &small).unwrap_err().to_string();
    assert!(error.contains("300 x 3000") && error.contains("1048576"), "{error}");
}
