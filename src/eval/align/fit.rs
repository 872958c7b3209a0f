//! One robust fit of a shift to the differences of two surfaces.

use super::Shift;
use super::offset::median;
use crate::eval::Surface;

/// Pixels with gradients that a fit needs.
const LEAST_PIXELS: u64 = 50;
/// The image is divided into this many blocks along each axis for the standard errors: leaving out
/// whole blocks (jackknife) respects that errors of neighbouring pixels are alike.
const BLOCKS: usize = 8;
/// Blocks that must have pixels for a standard error to mean anything.
const LEAST_BLOCKS: usize = 6;
/// Residuals of this many scales get half the weight (95 % efficiency for normal errors).
const CAUCHY: f64 = 2.385;
/// Pixels whose gradients differ by more than this many typical differences do not count.
const GRADIENT_LIMIT: f64 = 12.0;
/// Pixels looked at to find the scale of the residuals.
const SCALE_SAMPLE: usize = 1 << 15;
/// The noise-free moments are used when they are at least this part of the plain ones.
const LEAST_RATIO: f64 = 0.2;
/// Gradients that vary by less than this many roundings of the largest height are no relief.
const ROUNDINGS: f64 = 16.0;

/// What a fit says.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    /// Shift of the truth that the fit asks for, pixels.
    pub(super) step: Shift,
    /// Its standard error, pixels, by leaving out blocks.
    pub(super) error: Shift,
    /// Share of the relief that both surfaces have in common, in the direction where it is least.
    shared: f64,
    /// Standard error of that.
    shared_error: f64,
    /// Blocks with pixels.
    blocks: usize,
}

impl Fit {
    /// Whether both axes of the shift are determined.
    pub(super) fn is_determined(&self, shared: f64, significance: f64, error_px: f64) -> bool {
        self.blocks >= LEAST_BLOCKS
            && self.shared > shared
            && self.shared > significance * self.shared_error
            && self.error.x <= error_px
            && self.error.y <= error_px
    }
}

/// Weighted sums of one block: `g` mean gradient of both surfaces, `p` of the prediction, `t` of the
/// truth, `d` difference of heights.
#[derive(Clone, Copy, Default)]
struct Sums {
    pixels: u64,
    weight: f64,
    p: [f64; 2],
    t: [f64; 2],
    d: f64,
    /// xx, xy, yy of the mean gradient.
    plain: [f64; 3],
    /// xx, xy, yy of one surface's gradient with the other's.
    crossed: [f64; 3],
    gd: [f64; 2],
}

impl Sums {
    fn add(&mut self, pixel: &Pixel, weight: f64) {
        let Pixel { p, t, d } = pixel;
        let g = [0.5 * (p[0] + t[0]), 0.5 * (p[1] + t[1])];
        self.pixels += 1;
        self.weight += weight;
        self.d += weight * d;
        for i in 0..2 {
            self.p[i] += weight * p[i];
            self.t[i] += weight * t[i];
            self.gd[i] += weight * g[i] * d;
        }
        self.plain[0] += weight * g[0] * g[0];
        self.plain[1] += weight * g[0] * g[1];
        self.plain[2] += weight * g[1] * g[1];
        self.crossed[0] += weight * p[0] * t[0];
        self.crossed[1] += weight * 0.5 * (p[0] * t[1] + p[1] * t[0]);
        self.crossed[2] += weight * p[1] * t[1];
    }

    fn merge(&mut self, other: &Self, sign: f64) {
        self.pixels = self.pixels.wrapping_add_signed(other.pixels as i64 * sign as i64);
        self.weight += sign * other.weight;
        self.d += sign * other.d;
        for i in 0..2 {
            self.p[i] += sign * other.p[i];
            self.t[i] += sign * other.t[i];
            self.gd[i] += sign * other.gd[i];
        }
        for i in 0..3 {
            self.plain[i] += sign * other.plain[i];
            self.crossed[i] += sign * other.crossed[i];
        }
    }

    /// The shift and the share of common relief; none when there is no relief in some direction.
    fn solve(&self, least_relief: f64) -> Option<(Shift, f64)> {
        if self.pixels < LEAST_PIXELS {
            return None;
        }
        let w = self.weight;
        let g = [0.5 * (self.p[0] + self.t[0]), 0.5 * (self.p[1] + self.t[1])];
        let plain = [
            (self.plain[0] - g[0] * g[0] / w) / w,
            (self.plain[1] - g[0] * g[1] / w) / w,
            (self.plain[2] - g[1] * g[1] / w) / w,
        ];
        let crossed = [
            (self.crossed[0] - self.p[0] * self.t[0] / w) / w,
            (self.crossed[1] - 0.5 * (self.p[0] * self.t[1] + self.p[1] * self.t[0]) / w) / w,
            (self.crossed[2] - self.p[1] * self.t[1] / w) / w,
        ];
        let b = [(self.gd[0] - g[0] * self.d / w) / w, (self.gd[1] - g[1] * self.d / w) / w];
        let half_trace = 0.5 * (plain[0] + plain[2]);
        let spread = libm::hypot(0.5 * (plain[0] - plain[2]), plain[1]);
        // Written so that NaN is no relief. The second condition: sums of squares have no more
        // digits than that.
        if !(half_trace - spread > least_relief * least_relief
            && half_trace - spread > 1e-12 * (self.plain[0] + self.plain[2]) / w)
        {
            return None;
        }
        let shared = least_ratio(crossed, plain);
        let m = if shared > LEAST_RATIO { crossed } else { plain };
        let determinant = m[0] * m[2] - m[1] * m[1];
        let shift = Shift {
            x: -(m[2] * b[0] - m[1] * b[1]) / determinant,
            y: -(m[0] * b[1] - m[1] * b[0]) / determinant,
        };
        (shift.x.is_finite() && shift.y.is_finite() && shared.is_finite())
            .then_some((shift, shared))
    }
}

/// Smallest ratio of two quadratic forms (xx, xy, yy) over all directions; `b` is positive definite.
fn least_ratio(a: [f64; 3], b: [f64; 3]) -> f64 {
    let scale = 1.0 / (b[0] + b[2]);
    let (a, b) = (a.map(|v| v * scale), b.map(|v| v * scale));
    let quadratic = b[0] * b[2] - b[1] * b[1];
    let linear = 0.5 * (a[0] * b[2] + a[2] * b[0]) - a[1] * b[1];
    let constant = a[0] * a[2] - a[1] * a[1];
    (linear - (linear * linear - quadratic * constant).max(0.0).sqrt()) / quadratic
}

/// One pixel: gradients of prediction and truth, metres per pixel, and `prediction - truth`.
struct Pixel {
    p: [f64; 2],
    t: [f64; 2],
    d: f64,
}

impl Pixel {
    /// Length of the difference of the gradients.
    fn gradient_difference(&self) -> f64 {
        let (x, y) = (self.p[0] - self.t[0], self.p[1] - self.t[1]);
        (x * x + y * y).sqrt()
    }
}

/// Central differences at a pixel that is not on the edge; NaN where a neighbour has no height.
fn gradient(surface: &Surface, at: usize) -> [f64; 2] {
    let value = |i: usize| f64::from(surface.values[i]);
    [
        0.5 * (value(at + 1) - value(at - 1)),
        0.5 * (value(at + surface.width) - value(at - surface.width)),
    ]
}

fn pixel(prediction: &Surface, truth: &Surface, at: usize) -> Option<Pixel> {
    let d = f64::from(prediction.values[at]) - f64::from(truth.values[at]);
    let (p, t) = (gradient(prediction, at), gradient(truth, at));
    // One NaN makes the sum NaN.
    let sum = d + p[0] + p[1] + t[0] + t[1];
    (!sum.is_nan()).then_some(Pixel { p, t, d })
}

/// Fits the shift of `truth` that explains the differences of heights; none when there are too few
/// pixels or there is no relief in some direction.
pub(super) fn fit(prediction: &Surface, truth: &Surface) -> Option<Fit> {
    let (width, height) = prediction.size();
    if width < 3 || height < 3 {
        return None;
    }
    let spread = Spread::of(prediction, truth)?;
    let largest = prediction
        .values
        .iter()
        .chain(&truth.values)
        .map(|v| v.abs())
        // `max` passes NaN over.
        .fold(0.0_f32, f32::max);
    let least_relief = ROUNDINGS * f64::from(f32::EPSILON) * f64::from(largest);
    let mut blocks = [Sums::default(); BLOCKS * BLOCKS];
    for row in 1..height - 1 {
        for column in 1..width - 1 {
            if let Some(pixel) = pixel(prediction, truth, row * width + column) {
                // About the middle, which keeps digits.
                let pixel = Pixel { d: pixel.d - spread.middle, ..pixel };
                let block = row * BLOCKS / height * BLOCKS + column * BLOCKS / width;
                blocks[block].add(&pixel, spread.weight(&pixel));
            }
        }
    }
    let mut total = Sums::default();
    for block in &blocks {
        total.merge(block, 1.0);
    }
    let (step, shared) = total.solve(least_relief)?;
    let replicates: Vec<(Shift, f64)> = blocks
        .iter()
        .filter(|block| block.pixels > 0)
        .filter_map(|block| {
            let mut rest = total;
            rest.merge(block, -1.0);
            rest.solve(least_relief)
        })
        .collect();
    Some(Fit {
        step,
        error: Shift {
            x: jackknife(replicates.iter().map(|r| r.0.x)),
            y: jackknife(replicates.iter().map(|r| r.0.y)),
        },
        shared,
        shared_error: jackknife(replicates.iter().map(|r| r.1)),
        blocks: replicates.len(),
    })
}

/// Standard error from the values without one block each.
fn jackknife(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    ((n - 1.0) / n * values.map(|v| (v - mean) * (v - mean)).sum::<f64>()).sqrt()
}

/// What the differences are like where both surfaces have the same relief.
struct Spread {
    /// Median of all differences of height, metres.
    middle: f64,
    /// Scale (standard deviation, if normal) of the differences of height, metres.
    height: f64,
    /// Typical difference of gradients, metres per pixel.
    gradient: f64,
}

impl Spread {
    /// From a sample at equal steps. Pixels count by the product of the surfaces' gradients: in a
    /// city almost all are flat and say nothing, and the walls that do would be taken for outliers;
    /// a building that only one of the surfaces has is one.
    fn of(prediction: &Surface, truth: &Surface) -> Option<Self> {
        let (width, height) = prediction.size();
        let sample: Vec<Pixel> = (0..width * height)
            .step_by(sample_step(width, height))
            .filter(|at| {
                let (row, column) = (at / width, at % width);
                row > 0 && row + 1 < height && column > 0 && column + 1 < width
            })
            .filter_map(|at| pixel(prediction, truth, at))
            .collect();
        if sample.is_empty() {
            return None;
        }
        let middle = median(&mut sample.iter().map(|s| s.d).collect::<Vec<_>>());
        let weight = |s: &Pixel| (s.p[0] * s.t[0] + s.p[1] * s.t[1]).max(0.0);
        let median_of = |value: &dyn Fn(&Pixel) -> f64| {
            weighted_median(sample.iter().map(|s| (value(s), weight(s))).collect())
        };
        Some(Self {
            middle,
            height: 1.4826 * median_of(&|s| (s.d - middle).abs()),
            gradient: median_of(&|s| s.gradient_difference()),
        })
    }

    /// Weight of a pixel (its difference of height taken from the middle).
    fn weight(&self, pixel: &Pixel) -> f64 {
        // Beside a wall that only one surface has, heights agree and gradients do not at all. The
        // limit is so far out that noise never reaches it: weights that favour gradients which
        // agree would make noise look like common relief.
        if pixel.gradient_difference() > GRADIENT_LIMIT * self.gradient {
            return 0.0;
        }
        if self.height > 0.0 {
            let normalised = pixel.d / (CAUCHY * self.height);
            1.0 / (1.0 + normalised * normalised)
        } else {
            1.0
        }
    }
}

/// Smallest value at which half of the weight is reached; of a list that is not empty.
fn weighted_median(mut values: Vec<(f64, f64)>) -> f64 {
    values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let half = 0.5 * values.iter().map(|v| v.1).sum::<f64>();
    let mut sum = 0.0;
    values
        .iter()
        .find_map(|(value, weight)| {
            sum += weight;
            (sum >= half).then_some(*value)
        })
        .unwrap_or_default()
}

/// Pixels from one sample to the next: about [`SCALE_SAMPLE`] in all, over all columns, which steps do that
/// share no factor with the width.
fn sample_step(width: usize, height: usize) -> usize {
    let step = (width * height / SCALE_SAMPLE).max(1);
    (step..).find(|step| gcd(*step, width) == 1).unwrap_or(step)
}

fn gcd(a: usize, b: usize) -> usize {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn least_ratio_is_the_least_over_directions() {
        let (a, b) = ([2.0, 0.3, -0.5], [1.0, -0.4, 3.0]);
        let form = |m: [f64; 3], x: f64, y: f64| m[0] * x * x + 2.0 * m[1] * x * y + m[2] * y * y;
        let direct = (0..10_000)
            .map(|i| {
                let angle = f64::from(i) * std::f64::consts::PI / 10_000.0;
                let (x, y) = (libm::cos(angle), libm::sin(angle));
                form(a, x, y) / form(b, x, y)
            })
            .fold(f64::INFINITY, f64::min);
        assert!((least_ratio(a, b) - direct).abs() < 1e-6);
        assert!((least_ratio(b, b) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn jackknife_of_a_mean_is_its_standard_error() {
        let values = [1.0, 4.0, 2.0, 8.0, 5.0, 7.0];
        let sum: f64 = values.iter().sum();
        let n = values.len() as f64;
        let variance =
            values.iter().map(|v| (v - sum / n) * (v - sum / n)).sum::<f64>() / (n - 1.0);
        let found = jackknife(values.iter().map(|v| (sum - v) / (n - 1.0)));
        assert!((found - (variance / n).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn samples_are_taken_from_all_columns_of_every_width() {
        assert_eq!(
            (sample_step(640, 640), sample_step(100, 100), sample_step(256, 256)),
            (13, 1, 3)
        );
        for (width, height) in [(645, 800), (21 * 15, 1_600), (630, 800), (1, 65_536), (65_536, 2)]
        {
            let step = sample_step(width, height);
            assert_eq!(gcd(step, width), 1, "{width} {height}: {step}");
            let wanted = width * height / SCALE_SAMPLE;
            assert!((wanted..wanted + 8).contains(&step), "{width} {height}: {step}");
        }
    }

    /// Pixels whose differences are those of a shift, with a constant; both surfaces have the same relief.
    fn shifted(shift: Shift) -> impl Iterator<Item = (Pixel, f64)> {
        (0..200).map(move |k| {
            let k = f64::from(k);
            let p = [libm::cos(2.0 * k) + 0.3, 0.5 * libm::sin(3.0 * k) - 0.2 * libm::cos(2.0 * k)];
            let d = 1.5 - p[0] * shift.x - p[1] * shift.y;
            (Pixel { p, t: p, d }, 1.0 + 0.5 * libm::sin(7.0 * k))
        })
    }

    #[test]
    fn weighted_sums_give_back_the_shift_that_made_the_differences() {
        let shift = Shift { x: 0.7, y: -1.9 };
        let (mut all, mut part, mut rest) = (Sums::default(), Sums::default(), Sums::default());
        for (k, (pixel, weight)) in shifted(shift).enumerate() {
            all.add(&pixel, weight);
            if k < 70 { part.add(&pixel, weight) } else { rest.add(&pixel, weight) }
        }
        let (found, shared) = all.solve(1e-6).expect("relief");
        assert!(
            (found.x - shift.x).abs() < 1e-12 && (found.y - shift.y).abs() < 1e-12,
            "{found:?}"
        );
        assert!((shared - 1.0).abs() < 1e-12, "{shared}");
        // Sums without a block are those of the others.
        let mut without = all;
        without.merge(&part, -1.0);
        let [a, b] = [without, rest].map(|sums| {
            [sums.pixels as f64, sums.weight, sums.d, sums.p[0], sums.p[1], sums.t[0], sums.t[1]]
                .into_iter()
                .chain(sums.plain)
                .chain(sums.crossed)
                .chain(sums.gd)
                .collect::<Vec<_>>()
        });
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-12), "{a:?} {b:?}");
    }

    #[test]
    fn relief_of_one_direction_or_of_too_few_pixels_determines_no_shift() {
        let sums = |count: usize, squeeze: f64| {
            let mut sums = Sums::default();
            for (mut pixel, weight) in shifted(Shift { x: 1.0, y: 1.0 }).take(count) {
                pixel.p[1] = 0.5 * pixel.p[0] + squeeze * pixel.p[1];
                pixel.t = pixel.p;
                sums.add(&pixel, weight);
            }
            sums
        };
        assert!(sums(200, 1.0).solve(0.01).is_some() && sums(50, 1.0).solve(0.01).is_some());
        assert!(sums(49, 1.0).solve(0.01).is_none());
        assert!(sums(200, 0.0).solve(0.0).is_none() && sums(200, 0.01).solve(0.01).is_none());
        assert!(sums(200, 1.0).solve(f64::NAN).is_none());
    }

    #[test]
    fn relief_that_the_truth_has_alone_is_not_shared_and_does_not_shrink_the_shift() {
        // The prediction lacks half of the slopes: gradients t = p + noise that nothing explains.
        let mut sums = Sums::default();
        for k in 0..4_000 {
            let unit =
                |purpose: u64| 2.0 * crate::random::unit(crate::random::mix(k * 8 + purpose)) - 1.0;
            let p = [unit(0), 2.0 * unit(1)];
            let t = [p[0] + 0.5 * unit(2), p[1] + 2.0 * unit(3)];
            let d = 4.0 - 0.25 * p[0] - 0.5 * p[1];
            sums.add(&Pixel { p, t, d }, 1.0);
        }
        let (found, shared) = sums.solve(1e-6).expect("relief");
        assert!((found.x - 0.25).abs() < 0.01 && (found.y - 0.5).abs() < 0.02, "{found:?}");
        // Along y the mean gradient has 4/3 + 1/3 of variance where both have 4/3 in common.
        assert!((shared - 0.8).abs() < 0.02, "{shared}");
    }

    #[test]
    fn pixels_count_by_how_far_heights_and_gradients_disagree() {
        let spread = Spread { middle: 0.0, height: 0.5, gradient: 0.1 };
        let pixel = |x, d| Pixel { p: [1.0 + x, 2.0], t: [1.0, 2.0], d };
        assert_eq!(spread.weight(&pixel(0.0, 0.0)), 1.0);
        assert!((spread.weight(&pixel(0.0, -CAUCHY * 0.5)) - 0.5).abs() < 1e-15);
        assert!((spread.weight(&pixel(1.1, 3.0 * CAUCHY * 0.5)) - 0.1).abs() < 1e-15);
        assert_eq!(spread.weight(&pixel(-1.3, 0.0)), 0.0);
        assert_eq!(Spread { height: 0.0, ..spread }.weight(&pixel(0.0, 9.0)), 1.0);
        assert!(
            (Pixel { p: [3.0, 1.0], t: [0.0, 5.0], d: 0.0 }.gradient_difference() - 5.0).abs()
                < 1e-15
        );
    }

    #[test]
    fn a_weighted_median_is_where_half_of_the_weight_is_reached() {
        assert_eq!(weighted_median(vec![(3.0, 1.0), (1.0, 1.0), (2.0, 1.0)]), 2.0);
        assert_eq!(weighted_median(vec![(3.0, 5.0), (1.0, 1.0), (2.0, 1.0)]), 3.0);
        assert_eq!(weighted_median(vec![(1.0, 2.0), (2.0, 1.0), (3.0, 1.0)]), 1.0);
    }

    #[test]
    fn a_step_of_a_shifted_surface_is_its_shift_and_its_error_covers_the_miss() {
        let surface = |dx: f64, dy: f64, noise: f64| {
            let height = |k: usize| {
                let (x, y) = ((k % 72) as f64 - dx, (k / 72) as f64 - dy);
                let grain = crate::random::unit(crate::random::mix(k as u64)) - 0.5;
                (20.0 * libm::sin(0.11 * x + 0.05 * y)
                    + 15.0 * libm::cos(0.13 * y - 0.02 * x)
                    + noise * grain) as f32
            };
            Surface::new(72, 60, (0..72 * 60).map(height).collect())
        };
        let found = fit(&surface(0.3, -0.2, 0.02), &surface(0.0, 0.0, 0.0)).expect("a fit");
        assert!(
            (found.step.x - 0.3).abs() < 5e-3 && (found.step.y + 0.2).abs() < 5e-3,
            "{found:?}"
        );
        assert!(found.error.x > 1e-5 && found.error.x < 5e-3 && found.error.y < 5e-3, "{found:?}");
        assert!(found.blocks == 64 && (found.shared - 1.0).abs() < 0.02, "{found:?}");
        assert!(found.is_determined(0.5, 3.0, 0.01) && !found.is_determined(1.1, 3.0, 0.01));
        assert!(!found.is_determined(0.5, 3.0, 1e-6) && !found.is_determined(0.5, 1e9, 0.01));
        let flat = Surface::new(72, 60, vec![1.0; 72 * 60]);
        let alone = fit(&surface(0.0, 0.0, 0.0), &flat).expect("relief of one");
        assert!(!alone.is_determined(0.2, 3.0, 10.0) && fit(&flat, &flat).is_none(), "{alone:?}");
    }
}
