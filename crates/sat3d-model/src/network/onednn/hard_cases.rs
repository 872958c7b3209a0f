//! Statistics of group norms behind one pixel that is far from all others (`docs/numerics-field.md`); without the
//! library.

use super::passes::moments;
use crate::random::Draw;

const PIXELS: usize = 300 * 300;
const LANES: usize = 16;

/// Sums of differences from the first value and of their squares, in 32 bits for 256 values and then in 64: one pass, and right
/// where only the mean is large.
fn shifted_by_the_first(values: &[f32]) -> f64 {
    let count = values.len() as f64;
    let (mut plain, mut squares) = (0.0, 0.0);
    for run in values.chunks(256) {
        let off = |v: &f32| v - values[0];
        plain += f64::from(run.iter().map(off).sum::<f32>());
        squares += f64::from(run.iter().map(|v| off(v) * off(v)).sum::<f32>());
    }
    squares - plain * plain / count
}

#[test]
fn an_outlier_in_the_corner_costs_no_digit_of_the_deviation() {
    let mut draw = Draw::new(&[8]);
    for (centre, corner) in
        [(0.0, 0.0), (1e3, 0.0), (-1e5, 3.0), (0.0, 1e3), (0.0, -1e6), (5.0, 1e12)]
    {
        let plain: Vec<f32> =
            (0..LANES * PIXELS).map(|_| (centre + draw.range(-1.7, 1.7)) as f32).collect();
        let mut values = plain;
        values[..LANES].iter_mut().for_each(|value| *value += corner as f32);
        let found = moments(&values, LANES, LANES, PIXELS);
        for lane in [0, 7, 15] {
            let channel: Vec<f32> = values.iter().skip(lane).step_by(LANES).copied().collect();
            let wide = || channel.iter().map(|v| f64::from(*v));
            let mean = wide().sum::<f64>() / PIXELS as f64;
            let spread = wide().map(|v| (v - mean) * (v - mean)).sum::<f64>();
            let deviation = (spread / PIXELS as f64).sqrt();
            let errors = [(found[lane][0] - mean).abs() / deviation, found[lane][1] / spread - 1.0];
            let theirs = shifted_by_the_first(&channel) / spread - 1.0;
            if lane == 0 {
                eprintln!("{centre:e}, corner {corner:e}: {errors:?}, by the first {theirs:.1e}");
            }
            assert!(errors[0] < 1e-6 + 1e-8 * f64::abs(centre), "{centre} {corner}: {errors:?}");
            // 256 additions in 32 bits.
            assert!(errors[1].abs() < 1.6e-5, "{centre} {corner}: {errors:?}");
            if corner == -1e6 {
                assert!(theirs.abs() > 0.01, "{theirs}");
            }
        }
    }
}
