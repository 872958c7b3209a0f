//! Phase correlation, RANSAC and co-registration where there is nothing to find, or the same thing many
//! times, each naive form beside ours; `docs/numerics.md`.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use super::phase::PhaseCorrelator;
use super::*;
use crate::random::{Draw, key, normal};
use rustfft::FftPlannerScalar;
use rustfft::num_complex::Complex64;

fn settings(protocol: Protocol, offset: OffsetMethod) -> AlignSettings {
    AlignSettings {
        protocol,
        offset,
        seed: 3,
        pixel_m: (0.25, 0.25),
        max_shift_px: 20.0,
        max_rotation_deg: 10.0,
    }
}

/// Both transforms of a square image, rows and columns.
fn transform(image: &mut Vec<Complex64>, side: usize, inverse: bool) {
    let mut planner = FftPlannerScalar::new();
    let plan =
        if inverse { planner.plan_fft_inverse(side) } else { planner.plan_fft_forward(side) };
    for _ in 0..2 {
        plan.process(image);
        *image = (0..side * side).map(|i| image[i % side * side + i / side]).collect();
    }
}

/// Phase correlation as the formula says it: the cross power spectrum over its magnitude, if that is
/// above a floor. The row and the column of the first largest correlation, and how large it is.
fn naive_shift(reference: &[u8], moving: &[u8], side: usize, floor: f64) -> (usize, usize, f64) {
    let spectrum = |image: &[u8]| {
        let mut image: Vec<_> = image.iter().map(|v| Complex64::new(f64::from(*v), 0.0)).collect();
        transform(&mut image, side, false);
        image
    };
    let (a, b) = (spectrum(reference), spectrum(moving));
    let mut power: Vec<Complex64> = a
        .iter()
        .zip(&b)
        .map(|(a, b)| {
            let product = a * b.conj();
            let amplitude = product.norm_sqr().sqrt();
            product / if amplitude < floor { floor } else { amplitude }
        })
        .collect();
    transform(&mut power, side, true);
    let mut best = (0, 0.0);
    for (i, value) in power.iter().enumerate() {
        if value.norm_sqr() > best.1 {
            best = (i, value.norm_sqr());
        }
    }
    (best.0 / side, best.0 % side, best.1.sqrt())
}

/// An image that repeats itself, moved by whole pixels.
fn periodic(side: usize, period: usize, (x, y): (usize, usize)) -> Vec<u8> {
    let mut draw = Draw::new(&[9]);
    let tile: Vec<u8> = (0..period * period).map(|_| draw.bits() as u8).collect();
    (0..side * side)
        .map(|i| tile[(i / side + y) % period * period + (i % side + x) % period])
        .collect()
}

#[test]
fn phase_correlation_of_a_periodic_image_is_the_least_of_the_shifts_that_explain_it() {
    let mut phase = PhaseCorrelator::default();
    let mut farthest = 0.0_f64;
    for (side, period) in [(256, 16), (240, 12), (320, 20), (250, 16)] {
        for (x, y) in [(0, 0), (3, 5), (period - 1, 1), (period / 2 + 1, period - 2)] {
            let (a, b) = (periodic(side, period, (0, 0)), periodic(side, period, (x, y)));
            // A whole number of periods has no wave at most frequencies: 0 / 0.
            let (.., largest) = naive_shift(&a, &b, side, 0.0);
            assert_eq!(largest == 0.0, side % period == 0, "{largest}");
            // With the published floor, rounding chooses among shifts that are periods apart.
            let (row, column, _) = naive_shift(&a, &b, side, 100.0 * f64::EPSILON);
            for at in [row, column] {
                let shift = if at > side / 2 { side - at } else { at };
                if side % period == 0 {
                    farthest = farthest.max(shift as f64 / period as f64);
                }
            }
            let found = phase.shift(&a, &b, side, side);
            for (found, by) in [(found.x, x), (found.y, y)] {
                let beyond = found - by as f64;
                let periods = (beyond / period as f64).round() * period as f64;
                // A step of a tenth, where the sides cut a period in two.
                assert!((beyond - periods).abs() < 0.15, "{side} {period} {by}: {found}");
                let shortest = 2.0 * found.abs() <= period as f64;
                assert!(shortest || side % period != 0, "{side} {period} {by}: {found}");
            }
        }
    }
    println!("periodic images: the published rule is up to {farthest:.1} periods off");
    assert!(farthest > 0.6, "{farthest}");
}

#[test]
fn flat_and_empty_images_are_said_to_have_no_texture() {
    let side = 64;
    let noise: Vec<f32> = (0..side * side).map(|k| normal(key(&[5, k as u64])) as f32).collect();
    let textured = Surface::new(side, side, noise.clone());
    let flat = |height: f32| Surface::new(side, side, vec![height; side * side]);
    let mut one_height = Surface::empty(side, side);
    one_height.values[77] = 3.0;
    for (name, hard) in [
        ("flat", flat(7.0)),
        ("flat at 4,000 m", flat(4000.1)),
        ("without heights", Surface::empty(side, side)),
        ("one height", one_height),
        ("infinite", flat(f32::INFINITY)),
    ] {
        for (prediction, truth) in [(&hard, &textured), (&textured, &hard), (&hard, &hard)] {
            let found = align(prediction, truth, &settings(Protocol::Paper, OffsetMethod::Median));
            match found {
                Ok(found) => {
                    assert_eq!(found.flags, [AlignmentFlag::NoTexture], "{name}");
                    assert_eq!((found.shift_px, found.rotation_deg), (Shift::default(), 0.0));
                    assert!(found.vertical_offset_m.is_finite());
                }
                Err(AlignError::TooFewPixels { pixels, .. }) => assert_eq!(pixels, 0, "{name}"),
            }
        }
    }
    // The formula divides 0 by 0 wherever a flat image has no wave, and its maximum is of NaN.
    let shades = vec![200_u8; side * side];
    assert_eq!(naive_shift(&shades, &shades, side, 0.0), (0, 0, 0.0));
    // The script's floor under the magnitude makes it 0 everywhere: its answer is the first corner of
    // its window, 0.7 pixels off; that is why flat images are not asked.
    let corner = PhaseCorrelator::default().shift(&[0; 4096], &[0; 4096], side, side);
    assert_eq!(corner, Shift { x: -0.7, y: -0.7 });
}

#[test]
fn holes_do_not_hide_a_shift_unless_both_have_the_same_ones_everywhere() {
    let side = 128;
    let city = |dx: usize, hole: &dyn Fn(usize, usize) -> bool| {
        let mut surface = Surface::new(side, side, vec![0.0; side * side]);
        let mut draw = Draw::new(&[31]);
        for _ in 0..40 {
            let (left, top) = (draw.index(side), draw.index(side));
            let (across, down) = (8 + draw.index(20), 8 + draw.index(20));
            let roof = draw.range(3.0, 30.0) as f32;
            for row in top..(top + down).min(side) {
                for column in (left + dx).min(side)..(left + dx + across).min(side) {
                    surface.values[row * side + column] = roof;
                }
            }
        }
        for k in 0..side * side {
            if hole(k % side, k / side) {
                surface.values[k] = f32::NAN;
            }
        }
        surface
    };
    let scattered = |x: usize, y: usize| normal(key(&[8, (y * side + x) as u64])) > 2.0;
    let none = |_: usize, _: usize| false;
    let square = |x: usize, y: usize| (40..60).contains(&x) && (70..90).contains(&y);
    let shift = |protocol, prediction: &Surface, truth: &Surface| {
        let found = align(prediction, truth, &settings(protocol, OffsetMethod::Median)).unwrap();
        assert!(found.flags.is_empty() && found.vertical_offset_m.abs() < 0.1, "{found:?}");
        found.shift_px
    };
    let off = |found: Shift| libm::hypot(found.x - 6.0, found.y);
    // Holes in one surface, and one hole in both.
    let paper = shift(Protocol::Paper, &city(6, &none), &city(0, &scattered));
    assert!(off(paper) < 0.15, "{paper:?}");
    let (prediction, truth) = (city(6, &square), city(0, &square));
    for protocol in [Protocol::Paper, Protocol::Coregister] {
        let found = shift(protocol, &prediction, &truth);
        assert!(off(found) < 0.15, "{protocol:?} {found:?}");
    }
    // The same pixels empty in both: black points that do not move outweigh roofs that do. The
    // published rule says 0; the fit of heights, which leaves empty pixels out, is right.
    let (prediction, truth) = (city(6, &scattered), city(0, &scattered));
    assert_eq!(shift(Protocol::Paper, &prediction, &truth), Shift::default());
    let found = shift(Protocol::Coregister, &prediction, &truth);
    assert!(off(found) < 0.02, "{found:?}");
}

fn ransac(differences: &[f32]) -> Result<Alignment, AlignError> {
    let count = differences.len();
    let prediction = Surface::new(count, 1, vec![0.0; count]);
    let truth = Surface::new(count, 1, differences.to_vec());
    align(&prediction, &truth, &settings(Protocol::Vertical, OffsetMethod::Ransac))
}

#[test]
fn ransac_of_few_equal_or_huge_differences_is_exact_or_refused() {
    for few in [0, 1, 49] {
        let refused = AlignError::TooFewPixels { pixels: few as u64, needed: 50 };
        assert_eq!(ransac(&vec![2.0; few]), Err(refused));
    }
    for equal in [4000.1_f32, -0.1, 1e-40, 1e30, 0.0] {
        for count in [50, 51, 1_000_000] {
            let found = ransac(&vec![equal; count]).unwrap();
            assert_eq!(found.vertical_offset_m, f64::from(equal), "{count} of {equal}");
            assert_eq!(found.inliers, Some(count as u64));
        }
    }
    // In f32 the mean of a million equal numbers is not that number.
    let narrow = (0..1_000_000).map(|_| 4000.1_f32).sum::<f32>() / 1e6;
    println!("mean of a million times 4000.1 in f32: {narrow}");
    assert!((narrow - 4000.1).abs() > 1.0, "{narrow}");

    // Two heights, as often: one of them, never the middle between them.
    let halves: Vec<f32> = (0..1000).map(|i| if i % 2 == 0 { 10.0 } else { 40.0 }).collect();
    let found = ransac(&halves).unwrap();
    let mean = halves.iter().map(|d| f64::from(*d)).sum::<f64>() / 1000.0;
    assert_eq!(mean, 25.0);
    assert!([10.0, 40.0].contains(&found.vertical_offset_m), "{found:?}");

    // Nothing agrees with anything: said, and still one of the differences' own middles.
    let apart: Vec<f32> = (0..200).map(|i| (i * 100) as f32).collect();
    let found = ransac(&apart).unwrap();
    assert_eq!(found.flags, [AlignmentFlag::FewInliers]);
    assert!((0.0..=19_900.0).contains(&found.vertical_offset_m));
    // The limit is 1.5 m, not equal to it.
    let edge: Vec<f32> = [vec![0.0; 60], vec![1.5; 10], vec![-1.5; 10], vec![1e30; 10]].concat();
    let found = ransac(&edge).unwrap();
    assert_eq!((found.vertical_offset_m, found.inliers), (0.0, Some(60)));
}

/// The shift of least squares with plain sums, wherever its determinant is not 0.
fn naive_coregister(prediction: &Surface, truth: &Surface) -> Option<Shift> {
    let (width, height) = truth.size();
    let mut n = [[0.0_f64; 4]; 3];
    for k in width..width * (height - 1) {
        if k % width == 0 || k % width == width - 1 {
            continue;
        }
        let at = |k: usize| f64::from(truth.values[k]);
        let gradient = [0.5 * (at(k + 1) - at(k - 1)), 0.5 * (at(k + width) - at(k - width)), 1.0];
        let difference = f64::from(prediction.values[k]) - at(k);
        if (gradient[0] + gradient[1] + difference).is_nan() {
            continue;
        }
        for i in 0..3 {
            for j in 0..3 {
                n[i][j] += gradient[i] * gradient[j];
            }
            n[i][3] -= gradient[i] * difference;
        }
    }
    let minor = |i: usize, j: usize| n[i][j] - n[i][2] * n[2][j] / n[2][2];
    let (xx, xy, yy) = (minor(0, 0), minor(0, 1), minor(1, 1));
    let (x, y) = (minor(0, 3), minor(1, 3));
    let determinant = xx * yy - xy * xy;
    (determinant != 0.0)
        .then(|| Shift { x: (yy * x - xy * y) / determinant, y: (xx * y - xy * x) / determinant })
}

#[test]
fn coregistration_on_planes_says_that_it_knows_nothing() {
    let side = 96;
    let plane = |slope: (f64, f64), zero: f64| {
        let at = |k: usize| slope.0 * (k % side) as f64 + slope.1 * (k / side) as f64 + zero;
        Surface::new(side, side, (0..side * side).map(|k| at(k) as f32).collect())
    };
    let mut invented = 0.0_f64;
    for (slope, zero) in
        [((0.1, 0.03), 0.0), ((0.1, 0.03), 4000.0), ((1e-3, 7e-4), 120.0), ((30.0, -20.0), 8000.0)]
    {
        // The same plane, moved by 2.3 pixels: any shift along the contours explains it as well.
        let truth = plane(slope, zero);
        let prediction = plane(slope, zero - 2.3 * slope.0);
        let found =
            align(&prediction, &truth, &settings(Protocol::Coregister, OffsetMethod::Median))
                .unwrap();
        assert_eq!(found.flags, [AlignmentFlag::NoInformation], "{slope:?} {zero}: {found:?}");
        assert_eq!(found.shift_px, Shift::default());
        assert!((found.vertical_offset_m - 2.3 * slope.0).abs() < 1e-3 * (1.0 + zero / 1000.0));
        let naive = naive_coregister(&prediction, &truth);
        println!("plane {slope:?} at {zero} m: naive {naive:?}");
        if let Some(naive) = naive {
            invented = invented.max(libm::hypot(naive.x, naive.y));
        }
    }
    assert!(invented > 0.5, "{invented} px out of rounding");
}

#[test]
fn coregistration_at_8_000_m_is_that_at_sea_level() {
    let side = 128;
    let hills = |dx: f64, zero: f64| {
        let at = |k: usize| {
            let (x, y) = ((k % side) as f64 - dx, (k / side) as f64);
            6.0 * libm::sin(x / 9.0) * libm::cos(y / 11.0) + 4.0 * libm::sin((x + y) / 17.0)
        };
        let noise = |k: usize| 0.05 * normal(key(&[3, k as u64, dx.to_bits()]));
        let values = (0..side * side).map(|k| (at(k) + noise(k) + zero) as f32);
        Surface::new(side, side, values.collect())
    };
    let shift = |zero: f64| {
        let settings = settings(Protocol::Coregister, OffsetMethod::Median);
        let found = align(&hills(1.7, zero + 55.0), &hills(0.0, zero), &settings).unwrap();
        assert!(found.flags.is_empty(), "{found:?}");
        assert!((found.vertical_offset_m + 55.0).abs() < 0.05, "{found:?}");
        found.shift_px
    };
    let (low, high) = (shift(0.0), shift(8000.0));
    println!("{low:?} {high:?}");
    assert!((low.x - 1.7).abs() < 0.05 && low.y.abs() < 0.05, "{low:?}");
    assert!((low.x - high.x).abs() < 2e-3 && (low.y - high.y).abs() < 2e-3, "{low:?} {high:?}");
}
