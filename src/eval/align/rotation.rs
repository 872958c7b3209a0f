//! The published search of a rotation: the angle at which two 8-bit images correlate best.

use super::resample::Rotation;

/// Degrees between two angles tried.
const STEP_DEG: f64 = 0.5;
/// Pixels above 0 in both images that an angle needs.
const LEAST_PIXELS: u64 = 100;
/// Fractional bits of the source coordinates.
const COORDINATE_BITS: u32 = 32;
/// Pixels interpolated together, so that the arithmetic is done by vector instructions.
const LANES: usize = 16;
/// An interpolated shade is recomputed when it is closer than this to where rounding turns over. Its
/// error is at most a few `255 * 2^-24` of arithmetic and `2 * 255 * 2^-24` of either weight (and a
/// rounding of the step times the number of columns, far below that): a twentieth of this.
const MARGIN: f32 = 1.0 / 512.0;

/// The best angle.
pub(super) struct BestRotation {
    /// Degrees.
    pub(super) angle_deg: f64,
    /// Pearson's correlation there.
    pub(super) correlation: f64,
}

/// One angle: the map and the columns of each row that have a source.
struct Angle {
    angle_deg: f64,
    rotation: Rotation,
    inside: Vec<(u32, u32)>,
}

/// Tables of one size of image, and buffers.
#[derive(Default)]
pub(super) struct RotationSearch {
    key: Option<(usize, usize, u64)>,
    angles: Vec<Angle>,
    corners: Vec<u32>,
    line: Vec<u8>,
}

impl RotationSearch {
    /// The angle within +-`max_deg` at which the turned `moving` correlates best with `reference`,
    /// over the pixels where both are above 0. The first of equals wins; none when no angle has at
    /// least 100 such pixels and a correlation above -1.
    pub(super) fn search(
        &mut self,
        reference: &[u8],
        moving: &[u8],
        width: usize,
        height: usize,
        max_deg: f64,
    ) -> Option<BestRotation> {
        self.prepare(width, height, max_deg);
        corners(moving, width, height, &mut self.corners);
        self.line.resize(width, 0);
        // With the widest vectors that the processor has. The arithmetic is the same on all: nothing is
        // fused, and the sums are whole numbers.
        pulp::Arch::new().dispatch(TryAngles { tables: self, reference, moving, width, height })
    }

    fn prepare(&mut self, width: usize, height: usize, max_deg: f64) {
        let max_deg = if max_deg.is_finite() { max_deg.clamp(0.0, 180.0) } else { 0.0 };
        let key = (width, height, max_deg.to_bits());
        if self.key == Some(key) {
            return;
        }
        let count = ((2.0 * max_deg + STEP_DEG) / STEP_DEG).ceil() as u32;
        self.angles = (0..count)
            .map(|i| {
                let angle_deg = STEP_DEG.mul_add(f64::from(i), -max_deg);
                let rotation = Rotation::new(angle_deg, width, height);
                let inside = (0..height)
                    .map(|row| {
                        let (begin, end) = rotation.inside(row, width, height);
                        (begin as u32, end as u32)
                    })
                    .collect();
                Angle { angle_deg, rotation, inside }
            })
            .collect();
        self.key = Some(key);
    }
}

/// The loop over all angles, for [`pulp::Arch::dispatch`].
struct TryAngles<'a> {
    tables: &'a mut RotationSearch,
    reference: &'a [u8],
    moving: &'a [u8],
    width: usize,
    height: usize,
}

impl pulp::NullaryFnOnce for TryAngles<'_> {
    type Output = Option<BestRotation>;

    #[inline(always)]
    fn call(self) -> Option<BestRotation> {
        let Self { tables, reference, moving, width, height } = self;
        let mut best: Option<BestRotation> = None;
        let mut best_correlation = -1.0;
        for angle in &tables.angles {
            let mut sums = Sums::default();
            for (row, &(begin, end)) in angle.inside.iter().enumerate() {
                let (begin, end) = (begin as usize, end as usize);
                let line = &mut tables.line[begin..end];
                turn_line(&angle.rotation, &tables.corners, width + 1, (row, begin), line, |at| {
                    angle.rotation.shade(moving, width, height, at)
                });
                sums.add(&reference[row * width + begin..row * width + end], line);
            }
            if sums.pixels < LEAST_PIXELS {
                continue;
            }
            // A constant overlap has no correlation: NaN, which is never above the best.
            let correlation = sums.correlation();
            if correlation > best_correlation {
                best_correlation = correlation;
                best = Some(BestRotation { angle_deg: angle.angle_deg, correlation });
            }
        }
        best
    }
}

/// The four shades around each point between pixels, packed (north-west in the lowest byte, then
/// north-east, south-west, south-east), in rows of `width + 1`; 0 outside. The frame makes that a
/// coordinate on the edge that is rounded outwards reads taps of (almost) no weight.
fn corners(shades: &[u8], width: usize, height: usize, corners: &mut Vec<u32>) {
    corners.clear();
    for row in 0..=height {
        let line = |row: Option<usize>| match row {
            Some(row) if row < height => &shades[row * width..][..width],
            _ => &[],
        };
        let (upper, lower) = (line(row.checked_sub(1)), line(Some(row)));
        let at = |line: &[u8], column: usize| line.get(column).copied().unwrap_or(0);
        let mut west = [0; 2];
        for column in 0..=width {
            let east = [at(upper, column), at(lower, column)];
            corners.push(u32::from_le_bytes([west[0], east[0], west[1], east[1]]));
            west = east;
        }
    }
}

/// Interpolates part of a row of the turned image, starting at the output pixel `at` (row, column).
///
/// In 32-bit floats with a known bound of the error; where the bound does not settle how a shade is
/// rounded, `exact` computes it. So the shades are those of the 64-bit rule at a fraction of its
/// cost.
#[inline(always)]
fn turn_line(
    rotation: &Rotation,
    corners: &[u32],
    stride: usize,
    at: (usize, usize),
    line: &mut [u8],
    exact: impl Fn((usize, usize)) -> u8,
) {
    const ONE: f64 = (1_u64 << COORDINATE_BITS) as f64;
    /// Added to a small number, leaves its nearest integer in the lowest bits.
    const INTEGER: f32 = (1 << 23) as f32;
    const WEIGHT: f32 = 1.0 / (1 << 24) as f32;
    let fixed = |value: f64| (value * ONE).round() as i64;
    let (row, column) = rotation.source(at.0, at.1);
    // One more for the frame.
    let (mut row, mut column) = (fixed(row + 1.0), fixed(column + 1.0));
    let step = rotation.step();
    let (row_step, column_step) = (fixed(step.0), fixed(step.1));
    // Fractions of the lanes' coordinates, which wrap around.
    let lanes = |step: i64| -> [u32; LANES] {
        std::array::from_fn(|lane| (step as u32).wrapping_mul(lane as u32))
    };
    let (row_lanes, column_lanes) = (lanes(row_step), lanes(column_step));
    let mut quads = [0_u32; LANES];
    let mut shades = [0_u8; LANES];
    let mut doubtful = [false; LANES];
    for (block, out) in line.chunks_mut(LANES).enumerate() {
        let (row_fraction, column_fraction) = (row as u32, column as u32);
        for quad in &mut quads[..out.len()] {
            let index =
                (row >> COORDINATE_BITS) as usize * stride + (column >> COORDINATE_BITS) as usize;
            // Never beyond the frame, but a check is cheap.
            *quad = corners.get(index).copied().unwrap_or(0);
            row += row_step;
            column += column_step;
        }
        for lane in 0..LANES {
            let quad = quads[lane];
            let shade = |shift: u32| ((quad >> shift) & 0xFF) as i32 as f32;
            let weight = |fraction: u32| (fraction >> 8) as i32 as f32 * WEIGHT;
            let down = weight(row_fraction.wrapping_add(row_lanes[lane]));
            let across = weight(column_fraction.wrapping_add(column_lanes[lane]));
            let upper = shade(0) + (shade(8) - shade(0)) * across;
            let lower = shade(16) + (shade(24) - shade(16)) * across;
            let value = upper + (lower - upper) * down;
            let rounded = value + INTEGER;
            shades[lane] = rounded.to_bits() as u8;
            doubtful[lane] = (value - (rounded - INTEGER)).abs() > 0.5 - MARGIN;
        }
        out.copy_from_slice(&shades[..out.len()]);
        if doubtful != [false; LANES] {
            for (lane, shade) in out.iter_mut().enumerate() {
                if doubtful[lane] {
                    *shade = exact((at.0, at.1 + block * LANES + lane));
                }
            }
        }
    }
}

/// Sums over pixels where both shades are above 0: integers, so exact in any order.
#[derive(Default)]
struct Sums {
    pixels: u64,
    a: u64,
    b: u64,
    aa: u64,
    bb: u64,
    ab: u64,
}

impl Sums {
    #[inline(always)]
    fn add(&mut self, a: &[u8], b: &[u8]) {
        // Short enough for sums of 32 bits.
        for (a, b) in a.chunks(1024).zip(b.chunks(1024)) {
            let (mut pixels, mut sum_a, mut sum_b) = (0_i32, 0_i32, 0_i32);
            let (mut aa, mut bb, mut ab) = (0_i32, 0_i32, 0_i32);
            for (&a, &b) in a.iter().zip(b) {
                let both = -i16::from(a != 0 && b != 0);
                let (a, b) = (i16::from(a) & both, i16::from(b) & both);
                pixels -= i32::from(both);
                sum_a += i32::from(a);
                sum_b += i32::from(b);
                aa += i32::from(a) * i32::from(a);
                bb += i32::from(b) * i32::from(b);
                ab += i32::from(a) * i32::from(b);
            }
            self.pixels += u64::from(pixels.cast_unsigned());
            self.a += u64::from(sum_a.cast_unsigned());
            self.b += u64::from(sum_b.cast_unsigned());
            self.aa += u64::from(aa.cast_unsigned());
            self.bb += u64::from(bb.cast_unsigned());
            self.ab += u64::from(ab.cast_unsigned());
        }
    }

    /// Pearson's correlation; NaN when either side is constant.
    fn correlation(&self) -> f64 {
        let n = i128::from(self.pixels);
        let (a, b) = (i128::from(self.a), i128::from(self.b));
        let covariance = (n * i128::from(self.ab) - a * b) as f64;
        let variance_a = (n * i128::from(self.aa) - a * a) as f64;
        let variance_b = (n * i128::from(self.bb) - b * b) as f64;
        (covariance / (variance_a.sqrt() * variance_b.sqrt())).clamp(-1.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;

    #[test]
    fn fixed_point_shades_are_the_exact_ones() {
        let mut draw = Draw::new(&[11]);
        for (width, height) in [(256, 256), (255, 257), (40, 7), (1, 9), (9, 1), (1, 1), (2, 2)] {
            let shades: Vec<u8> = (0..width * height).map(|_| draw.bits() as u8).collect();
            let mut table = Vec::new();
            corners(&shades, width, height, &mut table);
            for angle in [-10.0, -9.5, -0.5, 0.0, 0.5, 3.0, 45.0, 90.0, 180.0] {
                let rotation = Rotation::new(angle, width, height);
                for row in 0..height {
                    let (begin, end) = rotation.inside(row, width, height);
                    let mut line = vec![0; end - begin];
                    let exact = |at| rotation.shade(&shades, width, height, at);
                    turn_line(&rotation, &table, width + 1, (row, begin), &mut line, exact);
                    let expected: Vec<u8> = (begin..end).map(|c| exact((row, c))).collect();
                    assert_eq!(line, expected, "{width} x {height}, {angle} degrees, row {row}");
                    for column in (0..begin).chain(end..width) {
                        assert_eq!(exact((row, column)), 0);
                    }
                }
            }
        }
    }

    #[test]
    fn correlation_is_that_of_the_definition() {
        let mut draw = Draw::new(&[12]);
        let a: Vec<u8> = (0..5000).map(|_| (draw.bits() % 7 * 40) as u8).collect();
        let b: Vec<u8> = a.iter().map(|v| v / 2 + (draw.bits() % 90) as u8).collect();
        let mut sums = Sums::default();
        sums.add(&a, &b);
        let pairs: Vec<(f64, f64)> = a
            .iter()
            .zip(&b)
            .filter(|(a, b)| **a > 0 && **b > 0)
            .map(|(a, b)| (f64::from(*a), f64::from(*b)))
            .collect();
        let n = pairs.len() as f64;
        let mean = pairs.iter().fold((0.0, 0.0), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
        let moment = |f: &dyn Fn(f64, f64) -> f64| {
            pairs.iter().map(|p| f(p.0 - mean.0, p.1 - mean.1)).sum::<f64>()
        };
        let expected =
            moment(&|x, y| x * y) / (moment(&|x, _| x * x) * moment(&|_, y| y * y)).sqrt();
        assert_eq!(sums.pixels, pairs.len() as u64);
        assert!((sums.correlation() - expected).abs() < 1e-12);
        let mut constant = Sums::default();
        constant.add(&[5; 300], &[9; 300]);
        assert!(constant.correlation().is_nan());
    }

    #[test]
    fn a_constant_overlap_never_wins() {
        let flat = vec![9_u8; 64 * 64];
        let mut search = RotationSearch::default();
        assert!(search.search(&flat, &flat, 64, 64, 10.0).is_none());
    }
}
