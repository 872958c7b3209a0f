//! The fit of a shift where surfaces have no relief, or have it on top of a huge offset
//! (`docs/numerics-field.md`).

use super::fit::fit;
use super::offset::{OffsetFinder, median};
use super::{AlignSettings, Alignment};
use crate::eval::{OffsetMethod, Protocol, Surface};
use crate::random::Draw;

const SIDE: usize = 96;

/// Smooth relief of a few metres seen `shift` pixels further east, on an offset.
fn relief(offset: f64, shift: f64) -> Surface {
    let values = (0..SIDE * SIDE)
        .map(|k| {
            let (x, y) = ((k % SIDE) as f64 - shift, (k / SIDE) as f64);
            let waves = libm::sin(0.13 * x + 0.05 * y)
                + libm::cos(0.09 * y - 0.07 * x)
                + libm::sin(0.021 * x * y / 10.0);
            (offset + 3.0 * waves) as f32
        })
        .collect();
    Surface::new(SIDE, SIDE, values)
}

#[test]
fn a_shift_is_found_under_any_offset_and_none_is_invented_on_a_plateau() {
    let alone = fit(&relief(0.0, 0.4), &relief(0.0, 0.0)).expect("relief").step;
    assert!((alone.x - 0.4).abs() < 0.02 && alone.y.abs() < 0.02, "{alone:?}");
    for (offset, tolerance) in [(100.0, 1e-4), (4_000.0, 2e-3), (100_000.0, 0.05)] {
        let step = fit(&relief(offset, 0.4), &relief(0.0, 0.0)).expect("relief").step;
        // The offset's own steps of 32 bits are all that is left in the way.
        assert!((step.x - alone.x).abs() < tolerance, "{offset}: {step:?}");
        // Taken from differences as they stand, without their middle: d g and its mean cancel.
        assert!((step.y - alone.y).abs() < tolerance, "{offset}: {step:?}");
    }
    for height in [0.0, 0.1, 4321.987, 1e30] {
        let flat = Surface::new(SIDE, SIDE, vec![height; SIDE * SIDE]);
        assert!(fit(&flat, &flat).is_none(), "{height}");
        // Noise of the last digit is no relief.
        let mut draw = Draw::new(&[9]);
        let shaken = flat.values.iter().map(|v| if draw.chance(0.5) { v.next_up() } else { *v });
        let shaken = Surface::new(SIDE, SIDE, shaken.collect());
        if height > 0.0 {
            assert!(fit(&shaken, &flat).is_none() && fit(&shaken, &shaken).is_none(), "{height}");
        }
    }
    assert!(fit(&Surface::empty(SIDE, SIDE), &relief(0.0, 0.0)).is_none());
}

#[test]
fn vertical_offsets_of_any_size_come_out() {
    let offset = |prediction: &[f32], truth: &[f32], method| {
        let surface = |values: &[f32]| Surface::new(values.len(), 1, values.to_vec());
        let settings = AlignSettings {
            protocol: Protocol::Vertical,
            offset: method,
            seed: 3,
            pixel_m: (1.0, 1.0),
            max_shift_px: 0.0,
            max_rotation_deg: 0.0,
        };
        let mut alignment = Alignment::default();
        OffsetFinder::default()
            .find(&surface(prediction), &surface(truth), &settings, &mut alignment)
            .expect("an offset");
        alignment.vertical_offset_m
    };
    let methods = [OffsetMethod::Median, OffsetMethod::Mean, OffsetMethod::Ransac];
    for datum in [0.0_f32, -30.0, 2048.0, 1e6] {
        let truth: Vec<f32> = (0..100_000).map(|k| datum + (k % 7) as f32).collect();
        let prediction: Vec<f32> = (0..100_000).map(|k| (k % 7) as f32).collect();
        for method in methods {
            let found = offset(&prediction, &truth, method);
            assert!((found - f64::from(datum)).abs() <= 1e-9, "{datum} {method:?}: {found}");
        }
        // A mean in 32 bits.
        let sum: f32 = truth.iter().zip(&prediction).map(|(t, p)| t - p).sum();
        let naive = (sum / 100_000.0 - datum).abs();
        if datum == -30.0 {
            assert!(naive <= 0.01);
        }
        if datum == 1e6 {
            eprintln!("an offset of 1e6 m by a mean in 32 bits: {naive} m off");
            assert!(naive > 100.0, "{naive}");
        }
    }
    // A middle of two huge heights, by their sum and by ours.
    assert!((0.5 * (f64::MAX + f64::MAX)).is_infinite());
    assert_eq!(median(&mut [f64::MAX, f64::MAX]), f64::MAX);
}
