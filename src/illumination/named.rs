//! Skies that come with the program.

use super::panorama::{HEIGHT, WIDTH};
use crate::model::illumination::sky_histogram;

/// The sky that is taken where none is named.
pub const DEFAULT: &str = "clear";

/// Names of the bundled skies.
///
/// * `clear`: a blue sky, paler towards the horizon, with the sun in it (`fixtures/illumination/`);
/// * `overcast`: the CIE standard overcast sky, grey, three times as bright above as at the horizon;
/// * `white`: every pixel of the sky at its brightest, as in an overexposed panorama.
pub const NAMES: [&str; 3] = ["clear", "overcast", "white"];

/// Sky pixels of the panorama called `clear`, per channel and bin.
const CLEAR: &str = include_str!("../../fixtures/illumination/clear.csv");

/// Linear brightness of the overcast sky above; 1 is white.
const OVERCAST_ZENITH: f64 = 0.8;

pub(super) fn histogram(name: &str) -> Option<Vec<f32>> {
    match name {
        "clear" => Some(CLEAR.lines().flat_map(shares).collect()),
        "overcast" => hemisphere(overcast),
        "white" => hemisphere(|_| [255; 3]),
        _ => None,
    }
}

/// Counts of a line as shares of their sum: the arithmetic of
/// [`sky_histogram`].
fn shares(line: &str) -> Vec<f32> {
    let counts: Vec<u32> = line.split(',').filter_map(|count| count.parse().ok()).collect();
    let total = counts.iter().sum::<u32>().max(1);
    counts.iter().map(|count| (f64::from(*count) / f64::from(total)) as f32).collect()
}

/// Of a sky whose colour depends on the elevation alone (radians), down to a level horizon.
fn hemisphere(colour: impl Fn(f64) -> [u8; 3]) -> Option<Vec<f32>> {
    let mut image = Vec::with_capacity(3 * WIDTH * HEIGHT);
    for row in 0..HEIGHT {
        let down = (row as f64 + 0.5) / HEIGHT as f64;
        let pixel = colour((0.5 - down) * std::f64::consts::PI);
        image.extend(pixel.repeat(WIDTH));
    }
    let mask = [vec![255; WIDTH * HEIGHT / 2], vec![0; WIDTH * HEIGHT / 2]].concat();
    sky_histogram(&image, &mask).ok()
}

/// CIE standard overcast sky (Moon and Spencer 1942): brightness (1 + 2 sin(elevation)) / 3 of the
/// zenith's, in sRGB.
fn overcast(elevation: f64) -> [u8; 3] {
    let linear = OVERCAST_ZENITH * (1.0 + 2.0 * libm::sin(elevation)) / 3.0;
    let encoded = 1.055 * libm::pow(linear.max(0.0), 1.0 / 2.4) - 0.055;
    [(encoded * 255.0 + 0.5) as u8; 3]
}
