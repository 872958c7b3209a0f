#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::*;
use std::fmt::Write as _;
use std::process::Command;

/// Bytes without a pattern; the Python script below makes the same.
fn noise(width: usize, height: usize, channels: usize) -> Image8 {
    let data = (0..(width * height * channels) as u64).map(|index| {
        let mut bits = index.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits ^= bits >> 27;
        bits.to_be_bytes()[0]
    });
    Image8::new(width, height, channels, data.collect()).unwrap()
}

/// FNV-1a over the bytes.
fn hash(image: &Image8) -> u64 {
    image.data.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    })
}

/// Makes the noise, resizes each channel with Pillow, prints one hash per case.
const SCRIPT: &str = r"
import sys
import numpy as np
from PIL import Image
for line in sys.stdin:
    w, h, c, W, H = map(int, line.split())
    i = np.arange(w * h * c, dtype=np.uint64)
    z = i * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z ^= z >> np.uint64(27)
    a = (z >> np.uint64(56)).astype(np.uint8).reshape(h, w, c)
    one = lambda k: Image.fromarray(np.ascontiguousarray(a[..., k])).resize((W, H), Image.BICUBIC)
    r = np.stack([np.asarray(one(k)) for k in range(c)], -1)
    v = 0xcbf29ce484222325
    for b in r.tobytes():
        v = ((v ^ b) * 0x100000001b3) % 2**64
    print(v)
";

/// Printed by `SCRIPT` with Pillow 13.0.0.
#[test]
fn sizes_of_all_kinds_are_pillows() {
    for ([width, height, channels], [to_width, to_height], wanted) in [
        ([1, 1, 3], [256, 256], 0xb211_e2e5_3a75_2325),
        ([640, 640, 3], [256, 256], 0xfdd3_ea50_b61e_b7a5),
        ([256, 256, 3], [256, 256], 0xf6f5_a49a_83cd_386a),
        ([7, 5, 3], [256, 256], 0x90cc_187e_2f74_8ccc),
        ([513, 300, 3], [256, 256], 0x18bb_584f_6a7f_7ac8),
        ([300, 256, 1], [256, 256], 0x3c6f_940f_3729_97ff),
        ([256, 300, 1], [256, 256], 0xacad_fd8b_b4cb_8ab7),
        ([90, 41, 3], [17, 23], 0x02b6_2466_f51c_4544),
        ([2048, 1024, 3], [512, 128], 0x0cfb_1a0d_ab12_023a),
        ([3, 1000, 1], [3, 1], 0x3f3e_891a_e9c3_d3b1),
        ([50, 20, 4], [1, 1], 0x162c_d937_01f9_9756),
    ] {
        let resized = resize_bicubic(&noise(width, height, channels), to_width, to_height);
        assert_eq!((resized.width, resized.height), (to_width, to_height));
        assert_eq!(hash(&resized), wanted, "{width} x {height} to {to_width} x {to_height}");
    }
}

#[test]
fn random_sizes_are_pillows() {
    use std::io::Write as _;
    let python = std::env::var("SAT3D_TEST_PYTHON").unwrap_or_else(|_| "python3".into());
    let ready = Command::new(&python).args(["-c", "import numpy, PIL"]).output();
    if !ready.is_ok_and(|output| output.status.success()) {
        eprintln!("SKIPPED random_sizes_are_pillows: {python} with numpy and Pillow is not there");
        return;
    }
    let sizes = noise(5 * 60, 1, 1).data;
    let mut lines = String::new();
    let mut cases = Vec::new();
    for size in sizes.chunks_exact(5) {
        let [width, height, to_width, to_height] =
            [size[0], size[1], size[2], size[3]].map(|side| usize::from(side) + 1);
        // Pillow 13 does the rows first for tall images; earlier ones, and we, never do.
        let (down, across) = (height.saturating_sub(to_height), width.saturating_sub(to_width));
        if down > 0 && down > 2 * across {
            continue;
        }
        let channels = 1 + usize::from(size[4] % 4);
        writeln!(lines, "{width} {height} {channels} {to_width} {to_height}").unwrap();
        cases.push((noise(width, height, channels), to_width, to_height));
    }
    assert!(cases.len() > 30, "{} cases", cases.len());
    let mut child = Command::new(&python)
        .args(["-c", SCRIPT])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(lines.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    let hashes: Vec<u64> = String::from_utf8(output.stdout)
        .unwrap()
        .lines()
        .map(|line| line.parse().unwrap())
        .collect();
    assert_eq!(hashes.len(), cases.len());
    for ((image, width, height), wanted) in cases.iter().zip(hashes) {
        let ours = hash(&resize_bicubic(image, *width, *height));
        let (from, to) = ((image.width, image.height), (width, height));
        assert_eq!(ours, wanted, "{from:?} x {} to {to:?}", image.channels);
    }
}

#[test]
fn a_flat_image_stays_flat() {
    // Fixed-point coefficients do not add up to one exactly; their rounding must not show.
    for level in [0, 1, 127, 254, 255] {
        let image = Image8::new(37, 91, 1, vec![level; 37 * 91]).unwrap();
        for (width, height) in [(256, 256), (5, 7), (1, 1)] {
            let resized = resize_bicubic(&image, width, height);
            assert!(resized.data.iter().all(|&value| value == level), "{level}");
        }
    }
}

#[test]
fn normalisation_is_the_references() {
    let image = Image8::new(2, 1, 3, vec![0, 128, 255, 255, 0, 1]).unwrap();
    let grid = normalise(&image).unwrap();
    assert_eq!((grid.channels, grid.height, grid.width), (3, 1, 2));
    // (v / 255 - mean) / std in float32, by NumPy.
    let wanted = [0xc007_8bbd, 0x400f_ee1d, 0x3e52_1b48, 0xc002_4924, 0x4028_f5c3, 0xbfe4_bcea];
    assert_eq!(grid.data.iter().map(|value| value.to_bits()).collect::<Vec<_>>(), wanted);
}

#[test]
fn what_is_no_rgb_image_is_refused() {
    for (width, height, channels, length) in
        [(2, 2, 3, 11), (0, 4, 3, 0), (usize::MAX, 2, 3, 6), (1, 1, 0, 0)]
    {
        let error = Image8::new(width, height, channels, vec![0; length]).unwrap_err();
        assert!(matches!(error, ModelError::Shape { .. }), "{error}");
    }
    let gray = noise(4, 4, 1);
    assert!(satellite(&gray, 256).unwrap_err().to_string().contains("3 channels (RGB)"));
    assert_eq!(satellite(&noise(1, 1, 3), 256).unwrap().data.len(), 3 * 256 * 256);
}
