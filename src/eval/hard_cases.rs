//! Ground truths resized where sums lose digits, and where there is next to nothing to average
//! (`docs/numerics-field.md`).

use super::Surface;
use super::resize::{Resize, resize};
use crate::random::Draw;
use num_bigint::BigInt;
use num_rational::BigRational;
use num_traits::ToPrimitive;

/// A surface of noise about an offset, metres.
fn surface(side: usize, offset: f64, reach: f64) -> Surface {
    let mut draw = Draw::new(&[77]);
    let values = (0..side * side).map(|_| (offset + reach * draw.unit()) as f32).collect();
    Surface::new(side, side, values)
}

/// The mean over all of a surface, rounded once: every 32-bit float is a whole number of 2^-149.
fn exact_mean(surface: &Surface) -> f64 {
    let whole = |value: &f32| {
        let (exponent, fraction) = (value.to_bits() >> 23 & 0xFF, value.to_bits() & 0x007F_FFFF);
        let size = match exponent {
            0 => BigInt::from(fraction),
            _ => BigInt::from(fraction | 0x0080_0000) << (exponent - 1),
        };
        if value.is_sign_negative() { -size } else { size }
    };
    let sum: BigInt = surface.values.iter().map(whole).sum();
    let mean = BigRational::new(sum, BigInt::from(surface.values.len()) << 149);
    mean.to_f64().expect("a number")
}

#[test]
fn a_mean_over_an_area_does_not_lose_relief_on_a_plateau() {
    for (offset, reach) in [(0.0, 30.0), (4_000.0, 0.5), (-1e6, 10.0), (1e30, 1e29), (1e-30, 1e-31)]
    {
        let source = surface(600, offset, reach);
        let want = exact_mean(&source);
        let got = f64::from(resize(&source, 1, 1, Resize::Area).values[0]);
        let naive = f64::from(source.values.iter().sum::<f32>()) / 360_000.0;
        let [ours, theirs] = [got, naive].map(|mean| (mean - want).abs());
        eprintln!("about {offset:e}: ours {ours:.1e}, a sum in 32 bits {theirs:.1e}");
        // One rounding to 32 bits.
        assert!(ours <= 6e-8 * want.abs(), "{offset}: {got} {want}");
        if offset == 4_000.0 {
            assert!(theirs > 1.0, "{theirs}");
        }
    }
}

#[test]
fn areas_of_no_common_measure_are_shared_without_remainder() {
    // 641 source pixels over 640: every pixel is cut, and shares are whole numbers.
    let source = surface(641, 100.0, 20.0);
    let resized = resize(&source, 640, 640, Resize::Area);
    assert!((exact_mean(&source) - exact_mean(&resized)).abs() < 1e-6);
    let flat = Surface::new(641, 641, vec![0.1; 641 * 641]);
    assert!(resize(&flat, 640, 640, Resize::Area).values.iter().all(|v| *v == 0.1));
    // Edges found by adding the step up in 32 bits: the last one falls outside of the source or short of it.
    let step = 641.0_f32 / 640.0;
    let end = (0..640).fold(0.0, |at, _| at + step);
    assert!((f64::from(end) - 641.0).abs() > 5e-4, "{end}");
}

#[test]
fn a_plateau_stays_one_in_both_ways() {
    for height in [0.1_f32, 4321.987, -1e-30, 1e30, f32::MAX] {
        let source = Surface::new(50, 40, vec![height; 2000]);
        for how in [Resize::Reference, Resize::Area] {
            let resized = resize(&source, 33, 71, how);
            assert!(resized.values.iter().all(|v| *v == height), "{height} {how:?}");
        }
    }
    // By four weights that are added up the plateau is wavy.
    let (across, down) = (0.3_f32, 0.7_f32);
    let weights = [
        (1.0 - across) * (1.0 - down),
        across * (1.0 - down),
        (1.0 - across) * down,
        across * down,
    ];
    let naive = |height: f32| weights.iter().map(|weight| weight * height).sum::<f32>();
    let wavy = [0.1, 4321.987, 17.3, 1e30].into_iter().filter(|height| naive(*height) != *height);
    assert!(wavy.count() > 0);
}
