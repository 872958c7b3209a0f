//! Correlation where heights are equal, or tell apart only their last digits (`docs/numerics-field.md`).

use super::ImageScore;
use super::buildings::Building;
use super::measures::{Measure, Set};
use super::tests::image;
use crate::random::Draw;
use num_rational::BigRational;
use num_traits::{ToPrimitive, Zero};

/// A scene with these true and predicted heights.
fn scene(heights: &[[f64; 2]]) -> ImageScore {
    let buildings = heights
        .iter()
        .map(|[truth_m, prediction_m]| Building {
            pixels: 100,
            truth_m: *truth_m,
            prediction_m: *prediction_m,
        })
        .collect();
    ImageScore { buildings, ..image([7, 0], 10.0, 8.0, 7.0, 0) }
}

fn ours(heights: &[[f64; 2]]) -> f64 {
    let image = scene(heights);
    Set::new(&[&image]).measures(&[1])[Measure::BuildingCorrelation as usize]
}

/// Pearson's correlation about rounded means, as it stands in the definition.
fn about_means(heights: &[[f64; 2]]) -> f64 {
    let n = heights.len() as f64;
    let mean = |of: &dyn Fn(&[f64; 2]) -> f64| heights.iter().map(of).sum::<f64>() / n;
    let [t, p] = [0, 1].map(|k| mean(&|pair| pair[k]));
    let both = mean(&|pair| (pair[0] - t) * (pair[1] - p));
    both / (mean(&|pair| (pair[0] - t).powi(2)) * mean(&|pair| (pair[1] - p).powi(2))).sqrt()
}

/// The same in one pass: `E[xy] - E[x] E[y]`.
fn one_pass(heights: &[[f64; 2]]) -> f64 {
    let n = heights.len() as f64;
    let mean = |of: &dyn Fn(&[f64; 2]) -> f64| heights.iter().map(of).sum::<f64>() / n;
    let [t, p] = [0, 1].map(|k| mean(&|pair| pair[k]));
    let spread = |k: usize, about: f64| mean(&|pair| pair[k] * pair[k]) - about * about;
    (mean(&|pair| pair[0] * pair[1]) - t * p) / (spread(0, t) * spread(1, p)).sqrt()
}

/// The same in fractions, rounded once before the root.
fn exact(heights: &[[f64; 2]]) -> f64 {
    let whole = |value: f64| BigRational::from_float(value).expect("finite");
    let sum = |of: &dyn Fn(&[f64; 2]) -> BigRational| {
        heights.iter().map(of).fold(BigRational::zero(), |sum, term| sum + term)
    };
    let n = whole(heights.len() as f64);
    let [t, p] = [0, 1].map(|k| sum(&|pair| whole(pair[k])) / &n);
    let both = sum(&|pair| (whole(pair[0]) - &t) * (whole(pair[1]) - &p));
    let squares = |k: usize, about: &BigRational| {
        sum(&|pair| (whole(pair[k]) - about) * (whole(pair[k]) - about))
    };
    let square = &both * &both / (squares(0, &t) * squares(1, &p));
    let sign = if both < BigRational::zero() { -1.0 } else { 1.0 };
    sign * square.to_f64().expect("a number").sqrt()
}

#[test]
fn equal_heights_have_no_correlation_and_not_that_of_their_rounding() {
    // The mean of three times 0.1 is not 0.1.
    for (truth, found) in [(0.1, 0.1), (0.1, 0.7), (9.3, 0.1)] {
        let heights = [[truth, found]; 3];
        let naive = about_means(&heights);
        eprintln!("three buildings of {truth} m, found {found} m: {naive}");
        assert!(ours(&heights).is_nan(), "{}", ours(&heights));
    }
    assert!(about_means(&[[0.1, 0.1]; 3]) == 1.0);
    // One constant is enough.
    assert!(ours(&[[0.1, 3.0], [0.1, 5.0], [0.1, 9.0]]).is_nan());
    assert!(ours(&[[4.0, 0.7], [5.0, 0.7], [6.5, 0.7]]).is_nan());
    assert!(ours(&[]).is_nan());
}

#[test]
fn heights_far_from_nought_correlate_as_they_do_exactly() {
    let mut draw = Draw::new(&[12]);
    for (offset, reach) in [(0.0, 30.0), (1e5, 1e-3), (-1e9, 1e-2), (1e-80, 1e-90), (1e120, 1e110)]
    {
        let heights: Vec<[f64; 2]> = (0..40)
            .map(|_| {
                let truth = offset + reach * draw.unit();
                [truth, offset + 0.6 * (truth - offset) + 0.3 * reach * draw.unit()]
            })
            .collect();
        let (want, got) = (exact(&heights), ours(&heights));
        let naive = [about_means(&heights), one_pass(&heights)];
        eprintln!("about {offset:e}: {want}, ours {got}, about means and in one pass {naive:?}");
        assert!((got - want).abs() < 1e-7, "{offset:e}: {got} {want}");
        if offset.abs() > 1.0 {
            assert!(naive[1].is_nan() || (naive[1] - want).abs() > 1e-3, "{offset:e}: {naive:?}");
        }
    }
}
