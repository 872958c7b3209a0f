//! Blending at a city's corners and over many windows, and columns from haze to solid (`docs/numerics-field.md`).

use super::city::{Along, City, Levels};
use super::column::ColumnIntegral;
use super::layout::{AxisWindow, AxisWindows, Blend, WINDOW, WindowOptions};
use super::sums::{Columns, Sums};
use crate::footprint::Footprint;
use std::f64::consts::PI;

const BLENDS: [Blend; 3] = [Blend::Mean, Blend::Hann, Blend::Gaussian];

fn windows(length: u32, stride: u32, trim: u32, blend: Blend) -> AxisWindows {
    AxisWindows::new(length, &WindowOptions { stride, trim, blend }).expect("a layout")
}

/// What the windows give one pixel.
fn weights_at(windows: &AxisWindows, pixel: u32) -> Vec<f32> {
    let all = windows.all().iter().filter(|window| window.pixels.contains(&pixel));
    all.map(|window: &AxisWindow| window.weights[(pixel - window.pixels.start) as usize]).collect()
}

#[test]
fn a_corner_has_the_whole_weight_of_the_one_window_that_sees_it() {
    // A Hann window from the textbook is nought at its ends, and so are all four corners of the city and its rim.
    let textbook = |index: u32| libm::sin(PI * f64::from(index) / f64::from(WINDOW - 1)).powi(2);
    let (sum, weight) = (textbook(0) * textbook(0) * 7.0, textbook(0) * textbook(0));
    assert!((sum / weight).is_nan() && textbook(WINDOW - 1) < 1e-30);
    // Ours at the same pixel, before and after it is divided by the sum.
    for blend in BLENDS {
        for (length, stride, trim) in [(256, 128, 0), (257, 128, 0), (700, 128, 0), (700, 64, 32)] {
            let axis = windows(length, stride, trim, blend);
            for corner in [0, length - 1] {
                let own = weights_at(&axis, corner);
                assert_eq!(own, [1.0], "{blend:?} {length} {stride} {trim}: pixel {corner}");
            }
        }
    }
}

#[test]
fn two_windows_a_pixel_apart_share_each_pixel_to_the_last_digit() {
    // At the rim one of two weights is 3.8e-5 of its window's greatest and the other 3.4e-4.
    for blend in BLENDS {
        let axis = windows(257, 128, 0, blend);
        for pixel in 1..256_u32 {
            let at = |start: u32| {
                let at = f64::from(pixel - start) + 0.5;
                match blend {
                    Blend::Mean => 1.0,
                    Blend::Hann => libm::sin(PI * at / 256.0).powi(2),
                    Blend::Gaussian => libm::exp(-0.5 * ((at - 128.0) / 32.0).powi(2)),
                }
            };
            let (first, second) = (at(0), at(1));
            let own = weights_at(&axis, pixel);
            for (own, want) in own.iter().zip([first, second].map(|w| w / (first + second))) {
                assert!((f64::from(*own) / want - 1.0).abs() < 1e-7, "{blend:?} {pixel}: {own}");
            }
        }
    }
}

/// One column with a density at two levels.
struct One([f32; 2], f32);

impl Columns for One {
    fn column(&self, _: u32, _: u32) -> (&[f32], f32) {
        (&self.0, self.1)
    }
}

#[test]
fn sums_of_many_windows_stay_within_their_bound() {
    // A haze of 1e-30 below a wall of 1e30: neither takes digits of the other.
    let densities = [1.3e-30_f32, 5.3e30];
    for (stride, blend) in
        [(128, Blend::Mean), (100, Blend::Hann), (32, Blend::Gaussian), (16, Blend::Hann)]
    {
        let axis = windows(1000, stride, 0, blend);
        let own = weights_at(&axis, 500);
        let mut sums = Sums::in_memory(1, 1, 2);
        let mut exact = 0.0;
        for along in &own {
            for across in &own {
                let weight = along * across;
                exact += f64::from(weight);
                sums.add(0..1, 0..1, &One(densities, weight)).expect("adds");
            }
        }
        let (mut line, mut weights) = (Vec::new(), Vec::new());
        sums.take(0, &mut line, &mut weights).expect("takes");
        let count = (own.len() * own.len()) as f64;
        // Of the weights: two roundings a window and axis. Of the sum: half a unit in the last place of 1 an addition,
        // and one of the product.
        assert!((exact - 1.0).abs() < 4.0 / f64::from(1 << 24), "{stride}: {exact}");
        let bound = (count + 5.0) / f64::from(1 << 24);
        for (sum, density) in line.iter().zip(densities) {
            let error = f64::from(*sum) / f64::from(density) - 1.0;
            eprintln!("{count} windows: {error:.1e} of {density:e}, bound {bound:.1e}");
            assert!(error.abs() < bound, "{stride} {blend:?}: {error:e}");
        }
    }
}

#[test]
fn a_column_of_any_density_has_its_exact_height() {
    let levels = 320;
    let z = (0..levels).map(|k| ((2 * k + 1) as f64 / f64::from(levels) - 1.0) as f32).collect();
    let city = City {
        size: [1, 1],
        footprint: Footprint::of_gsd([1, 1], [0.25, 0.25]),
        assumed: true,
        levels: Levels { z, ends: [-1.0, 1.0] },
        vertical_m: 32.24,
        along: Along::X,
    };
    let integral = ColumnIntegral::new(&city);
    let mut worst = 0.0_f64;
    for power in -300..300 {
        let density = libm::powf(10.0, power as f32 * 0.1);
        let height = integral.heights(&vec![density; levels as usize])[0];
        let tau = 2.0 * f64::from(density);
        if -libm::expm1(-tau) < 0.05 {
            assert!(height.is_nan(), "{density:e}: {height}");
            continue;
        }
        let want = (2.0 - 2.0 * (1.0 / tau - 1.0 / libm::expm1(tau))) * 32.24;
        worst = worst.max((f64::from(height) - want).abs());
    }
    eprintln!("columns of one density: {worst:e} m");
    // Rounding to 32 bits: 3.8e-6 m at 64 m.
    assert!(worst < 4e-6, "{worst}");
}
