//! Least squares for shift, lean and vertical zero.

use super::render::{Level, Rendered};
use super::{FARTHEST_M, median};

/// What is sought: metres east and south, metres per metre of height above ground, metres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Parameters {
    pub x: f64,
    pub y: f64,
    pub lean_x: f64,
    pub lean_y: f64,
    /// Truth minus prediction at the ground.
    pub zero: f64,
    /// Share by which the prediction's heights above ground fall short.
    pub shortfall: f64,
    /// Variance of the prediction's blur, square metres.
    pub blur: f64,
}

/// Formal standard errors, the larger of both axes, as if pixels of the fit's level were
/// independent within patches of [`PATCH_PX`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Errors {
    pub shift: f64,
    /// Infinite where no lean was sought.
    pub lean: f64,
}

/// A finished fit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    pub parameters: Parameters,
    pub errors: Errors,
    pub correlation: f64,
    /// Median of truth minus prediction.
    pub vertical: f64,
}

/// Errors of neighbouring pixels are alike: so many pixels count as one.
const PATCH_PX: f64 = 16.0;
/// Pixels that have to take part.
const LEAST_PIXELS: usize = 400;
/// Standard deviation under which a surface is flat, metres.
const FLAT_M: f64 = 0.3;
/// Huber's constant, in robust standard deviations.
const HUBER: f64 = 1.345;
/// Smallest robust standard deviation, metres.
const LEAST_SCALE_M: f64 = 0.1;
/// Pixels that are skipped to one that is looked at while a start is sought: heights are smooth.
const STRIDE: usize = 2;
/// Pixels around the best start without lean in which starts with lean are sought.
const NEAR_PX: i64 = 3;
/// Settled when the next step is shorter, metres (of shift, and of a roof of 10 m).
const SETTLED_M: f64 = 0.01;
/// Standard deviation of what is expected of the shortfall before anything is seen. It settles
/// the matter where nothing stands above the ground.
const PRIOR_SHORTFALL: f64 = 0.5;
/// The same of a change of the blur, square metres.
const PRIOR_BLUR_M2: f64 = 4.0;
/// Largest change of the blur in one step, square metres.
const LONGEST_BLUR_M2: f64 = 0.5;
/// Leans at which a start is sought: none, and one in each direction.
const START_LEAN: f64 = 0.12;

/// Sums for the correlation of two sets of heights.
#[derive(Default)]
pub(super) struct Moments {
    n: f64,
    a: f64,
    b: f64,
    aa: f64,
    bb: f64,
    ab: f64,
}

impl Moments {
    pub(super) fn add(&mut self, a: f64, b: f64) {
        self.n += 1.0;
        self.a += a;
        self.b += b;
        self.aa += a * a;
        self.bb += b * b;
        self.ab += a * b;
    }

    /// Variances of both and their covariance.
    fn spread(&self) -> (f64, f64, f64) {
        let (a, b) = (self.a / self.n, self.b / self.n);
        (self.aa / self.n - a * a, self.bb / self.n - b * b, self.ab / self.n - a * b)
    }

    pub(super) fn correlation(&self) -> f64 {
        let (aa, bb, ab) = self.spread();
        ab / (aa * bb).sqrt()
    }
}

/// The best whole-pixel shifts, without lean and with a lean in each of eight directions; `None`
/// where the surfaces are too small or flat.
pub(super) fn starts(level: &Level) -> Option<Vec<Parameters>> {
    let reach = |pixel: f64, size: usize| ((FARTHEST_M / pixel).ceil() as i64).min(size as i64 / 4);
    let (rx, ry) = (reach(level.pixel_m.0, level.width), reach(level.pixel_m.1, level.height));
    // Heights near zero, so that sums of squares lose nothing.
    let origin = f64::from(*level.prediction.iter().find(|v| !v.is_nan())?);
    let search = |lean: Parameters, middle: (i64, i64), (rx, ry): (i64, i64)| {
        let rendered = level.render(&lean, false);
        let truth_origin = f64::from(*rendered.heights.iter().find(|v| !v.is_nan())?);
        let mut best: Option<(f64, (i64, i64))> = None;
        for dy in middle.1 - ry..=middle.1 + ry {
            for dx in middle.0 - rx..=middle.0 + rx {
                let moments = overlap(level, &rendered, (dx, dy), (origin, truth_origin));
                let (p, t, _) = moments.spread();
                let textured = p > FLAT_M * FLAT_M && t > FLAT_M * FLAT_M;
                let enough = moments.n * (STRIDE * STRIDE) as f64 >= LEAST_PIXELS as f64;
                if !enough || !textured {
                    continue;
                }
                let correlation = moments.correlation();
                if best.is_none_or(|(best, _)| correlation > best) {
                    best = Some((correlation, (dx, dy)));
                }
            }
        }
        let (correlation, (dx, dy)) = best?;
        let (x, y) = (dx as f64 * level.pixel_m.0, dy as f64 * level.pixel_m.1);
        Some((correlation, (dx, dy), Parameters { x, y, ..lean }))
    };
    let (_, middle, upright) = search(Parameters::default(), (0, 0), (rx, ry))?;
    let mut leaning: Option<(f64, Parameters)> = None;
    for direction in 0..8 {
        let angle = f64::from(direction) * std::f64::consts::FRAC_PI_4;
        let lean = Parameters {
            lean_x: START_LEAN * libm::cos(angle),
            lean_y: START_LEAN * libm::sin(angle),
            ..Parameters::default()
        };
        // A lean moves the best shift by no more than the tallest houses lean.
        let near = (rx.min(NEAR_PX), ry.min(NEAR_PX));
        if let Some((correlation, _, parameters)) = search(lean, middle, near)
            && leaning.is_none_or(|(best, _)| correlation > best)
        {
            leaning = Some((correlation, parameters));
        }
    }
    Some(std::iter::once(upright).chain(leaning.map(|(_, p)| p)).collect())
}

/// Prediction and rendered truth shifted by whole pixels, at every second pixel.
fn overlap(
    level: &Level,
    rendered: &Rendered,
    (dx, dy): (i64, i64),
    (origin, truth_origin): (f64, f64),
) -> Moments {
    let (width, height) = (level.width as i64, level.height as i64);
    let mut moments = Moments::default();
    let columns = dx.max(0)..(width + dx).min(width);
    for y in (dy.max(0)..(height + dy).min(height)).step_by(STRIDE) {
        let own = &level.prediction[(y * width) as usize..((y + 1) * width) as usize];
        let line = (y - dy) * width;
        for x in columns.clone().step_by(STRIDE) {
            let truth = rendered.heights[(line + x - dx) as usize];
            let prediction = own[x as usize];
            if !truth.is_nan() && !prediction.is_nan() {
                moments.add(f64::from(prediction) - origin, f64::from(truth) - truth_origin);
            }
        }
    }
    moments
}

/// Gauss-Newton steps from a start; `None` where the heights do not determine the parameters.
pub(super) fn refine(
    level: &Level,
    start: Parameters,
    with_lean: bool,
    iterations: u32,
) -> Option<Fit> {
    let mut parameters = start;
    let mut last: Option<Step> = None;
    for iteration in 0..iterations {
        let rendered = level.render(&parameters, with_lean);
        let step = step(level, &rendered, &parameters, iteration == 0)?;
        let [x, y, zero, shortfall, blur, lean_x, lean_y] = step.solution;
        // No step is longer than the linearisation holds.
        let longest = level.pixel_m.0.max(level.pixel_m.1) * 1.5;
        let length = libm::hypot(x, y).max(10.0 * libm::hypot(lean_x, lean_y));
        let damping = if length > longest { longest / length } else { 1.0 };
        parameters.x += damping * x;
        parameters.y += damping * y;
        parameters.lean_x += damping * lean_x;
        parameters.lean_y += damping * lean_y;
        parameters.zero = zero;
        parameters.shortfall = shortfall;
        let blur = parameters.blur + blur.clamp(-LONGEST_BLUR_M2, LONGEST_BLUR_M2);
        parameters.blur = blur.clamp(0.0, level.most_blur());
        let near = libm::hypot(parameters.x, parameters.y) < 2.0 * FARTHEST_M;
        if !near {
            return None;
        }
        last = Some(step);
        if damping * length < SETTLED_M {
            break;
        }
    }
    let step = last?;
    Some(Fit {
        parameters,
        errors: step.errors,
        correlation: step.correlation,
        vertical: step.vertical,
    })
}

/// Number of unknowns: x, y, zero, shortfall, blur, and the two of the lean.
pub(super) const UNKNOWNS: usize = 7;

/// One pixel of the fit.
struct Row {
    /// What each unknown adds to truth minus prediction.
    design: [f64; UNKNOWNS],
    /// Truth minus prediction.
    difference: f64,
}

struct Step {
    /// Changes of x, y, blur and lean; the new zero and shortfall.
    solution: [f64; UNKNOWNS],
    errors: Errors,
    correlation: f64,
    vertical: f64,
}

/// The pixels that have everything, with the moments of both heights.
fn rows(level: &Level, rendered: &Rendered) -> Option<(Vec<Row>, Moments)> {
    let (width, height) = (level.width, level.height);
    let mut rows = Vec::with_capacity(width * height);
    let mut moments = Moments::default();
    let mut origin: Option<(f64, f64)> = None;
    let (px, py) = level.pixel_m;
    for y in 1..height.saturating_sub(1) {
        for k in y * width + 1..(y + 1) * width - 1 {
            let at = |k: usize| f64::from(rendered.heights[k]);
            let (truth, prediction) = (at(k), f64::from(level.prediction[k]));
            let (west, east, north, south) = (at(k - 1), at(k + 1), at(k - width), at(k + width));
            let lean = rendered
                .lean
                .as_ref()
                .map_or((0.0, 0.0), |(x, y)| (f64::from(x[k]), f64::from(y[k])));
            let laplacian =
                (west + east - 2.0 * truth) / (px * px) + (north + south - 2.0 * truth) / (py * py);
            // truth - prediction = gradient . (shift + lean * above) + zero + shortfall * above
            // - blur / 2 * laplacian, to first order: moving the truth by d changes it by
            // -gradient . d.
            let design = [
                (east - west) / (2.0 * px),
                (south - north) / (2.0 * py),
                1.0,
                f64::from(rendered.above[k]),
                -0.5 * laplacian,
                lean.0,
                lean.1,
            ];
            let difference = truth - prediction;
            if (difference + laplacian + design[3] + lean.0 + lean.1).is_nan() {
                continue;
            }
            let (p, t) = *origin.get_or_insert((prediction, truth));
            moments.add(prediction - p, truth - t);
            rows.push(Row { design, difference });
        }
    }
    let (variance_p, variance_t, _) = moments.spread();
    let textured = variance_p > FLAT_M * FLAT_M && variance_t > FLAT_M * FLAT_M;
    (rows.len() >= LEAST_PIXELS && textured).then_some((rows, moments))
}

/// One step of iteratively reweighted least squares.
fn step(level: &Level, rendered: &Rendered, now: &Parameters, first: bool) -> Option<Step> {
    let (rows, moments) = rows(level, rendered)?;
    let vertical = median(rows.iter().map(|row| row.difference).collect());
    let zero = if first { vertical } else { now.zero };
    let residual = |row: &Row| row.difference - zero - now.shortfall * row.design[3];
    let scale = 1.4826 * median(rows.iter().map(|row| residual(row).abs()).collect());
    let scale = scale.max(LEAST_SCALE_M);
    let unknowns = if rendered.lean.is_some() { UNKNOWNS } else { UNKNOWNS - 2 };
    let mut normal = [[0.0; UNKNOWNS + 1]; UNKNOWNS];
    let mut energy = 0.0;
    for row in &rows {
        let size = residual(row).abs() / scale;
        let weight = if size > HUBER { HUBER / size } else { 1.0 };
        for (i, line) in normal.iter_mut().enumerate().take(unknowns) {
            let weighted = weight * row.design[i];
            for (sum, other) in line.iter_mut().zip(&row.design[..=i]) {
                *sum += weighted * other;
            }
            line[UNKNOWNS] += weighted * row.difference;
        }
        energy += weight * residual(row) * residual(row);
    }
    let patch_variance = scale * scale * PATCH_PX;
    normal[3][3] += patch_variance / (PRIOR_SHORTFALL * PRIOR_SHORTFALL);
    normal[4][4] += patch_variance / (PRIOR_BLUR_M2 * PRIOR_BLUR_M2);
    let (solution, inverse) = solve(&normal, unknowns)?;
    let variance = energy / rows.len() as f64 * PATCH_PX;
    let error = |i: usize| (variance * inverse[i]).sqrt();
    let lean = if rendered.lean.is_some() { error(5).max(error(6)) } else { f64::INFINITY };
    Some(Step {
        solution,
        errors: Errors { shift: error(0).max(error(1)), lean },
        correlation: moments.correlation(),
        vertical,
    })
}

/// Solves the first `n` normal equations by Cholesky's method after scaling; also the diagonal of
/// the inverse. `None` where they are singular.
pub(super) fn solve(
    normal: &[[f64; UNKNOWNS + 1]; UNKNOWNS],
    n: usize,
) -> Option<([f64; UNKNOWNS], [f64; UNKNOWNS])> {
    let mut size = [1.0; UNKNOWNS];
    for i in 0..n {
        size[i] = normal[i][i].sqrt();
        let usable = size[i] > 0.0 && size[i].is_finite();
        if !usable {
            return None;
        }
    }
    let mut factor = [[0.0; UNKNOWNS]; UNKNOWNS];
    for i in 0..n {
        for j in 0..=i {
            let mut sum = normal[i][j] / (size[i] * size[j]);
            for (a, b) in factor[i][..j].iter().zip(&factor[j][..j]) {
                sum -= a * b;
            }
            if i == j {
                // The square of what is left of a column once the others have explained it.
                // NaN is no more than that either.
                let independent = sum > 1e-6;
                if !independent {
                    return None;
                }
                factor[i][i] = sum.sqrt();
            } else {
                factor[i][j] = sum / factor[j][j];
            }
        }
    }
    let solve_for = |mut right: [f64; UNKNOWNS]| {
        for i in 0..n {
            for j in 0..i {
                right[i] -= factor[i][j] * right[j];
            }
            right[i] /= factor[i][i];
        }
        for i in (0..n).rev() {
            for j in i + 1..n {
                right[i] -= factor[j][i] * right[j];
            }
            right[i] /= factor[i][i];
        }
        right
    };
    let mut right = [0.0; UNKNOWNS];
    for i in 0..n {
        right[i] = normal[i][UNKNOWNS] / size[i];
    }
    let mut solution = solve_for(right);
    let mut inverse = [0.0; UNKNOWNS];
    for i in 0..n {
        solution[i] /= size[i];
        let mut unit = [0.0; UNKNOWNS];
        unit[i] = 1.0;
        inverse[i] = solve_for(unit)[i] / (size[i] * size[i]);
    }
    Some((solution, inverse))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_equations_are_solved_and_singular_ones_refused() {
        // x = (1, -2, 3), from a symmetric positive definite matrix.
        let a = [[4.0, 1.0, 0.5], [1.0, 900.0, -2.0], [0.5, -2.0, 0.01]];
        let x = [1.0, -2.0, 3.0];
        let mut normal = [[0.0; UNKNOWNS + 1]; UNKNOWNS];
        for i in 0..3 {
            normal[i][..3].copy_from_slice(&a[i]);
            normal[i][UNKNOWNS] = (0..3).map(|j| a[i][j] * x[j]).sum();
        }
        // numpy.linalg.eigvalsh of it is negative once: refused.
        assert!(solve(&normal, 3).is_none());
        normal[2][2] = 2.0;
        normal[2][UNKNOWNS] += 1.99 * x[2];
        let (solution, inverse) = solve(&normal, 3).expect("regular");
        for (found, expected) in solution.iter().zip(x) {
            assert!((found - expected).abs() < 1e-12, "{solution:?}");
        }
        // numpy.linalg.inv([[4, 1, .5], [1, 900, -2], [.5, -2, 2]]).diagonal()
        for (found, expected) in
            inverse.iter().zip([0.258231488138, 0.001114306254, 0.517469446441])
        {
            assert!((found - expected).abs() < 1e-9, "{inverse:?}");
        }
        normal[1] = normal[0];
        assert!(solve(&normal, 3).is_none());
    }
}
