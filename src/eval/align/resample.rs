//! Shifting and rotating a grid with linear interpolation, by the rules of `scipy.ndimage` (`shift`
//! and `rotate` with `order=1`, `mode="constant"`).
//!
//! A coordinate is inside when it lies in `[0, n - 1]`. Each value has two taps per axis even where
//! the second has weight 0, and a tap without data makes the value no data whatever its weight: that
//! is what `SciPy` does, and it decides which pixels the published scores are taken over. At the last
//! row or column the second tap is mirrored. Only where a shift comes from another protocol does a
//! tap of weight 0 not count.

use super::{Alignment, AlignmentFlag, Shift};
use crate::eval::Surface;

/// The two taps of a coordinate along one axis.
#[derive(Clone, Copy)]
struct Taps {
    first: usize,
    second: usize,
    first_weight: f64,
    second_weight: f64,
}

impl Taps {
    /// Taps of a coordinate among `count` samples; none when it is outside.
    fn at(coordinate: f64, count: usize) -> Option<Self> {
        // False for NaN too.
        if !(coordinate >= 0.0 && coordinate <= (count - 1) as f64) {
            return None;
        }
        let floor = coordinate.floor();
        let first = floor as usize;
        let second = if first + 1 < count { first + 1 } else { count.saturating_sub(2) };
        let first_weight = 1.0 - (coordinate - floor);
        Some(Self { first, second, first_weight, second_weight: 1.0 - first_weight })
    }
}

/// Whether a second tap of weight 0 counts.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Weightless {
    /// As in `SciPy`: without data, it makes the value no data.
    Counts,
    /// It is not looked at.
    Ignored,
}

/// Interpolates; sums in the order of rows, then columns.
fn blend<T: Copy + Into<f64>>(values: &[T], width: usize, rows: Taps, columns: Taps) -> f64 {
    let value = |row: usize, column: usize| -> f64 { values[row * width + column].into() };
    value(rows.first, columns.first) * rows.first_weight * columns.first_weight
        + value(rows.first, columns.second) * rows.first_weight * columns.second_weight
        + value(rows.second, columns.first) * rows.second_weight * columns.first_weight
        + value(rows.second, columns.second) * rows.second_weight * columns.second_weight
}

/// A rotation about the centre of an image, as a map from output to source coordinates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rotation {
    cosine: f64,
    sine: f64,
    row_offset: f64,
    column_offset: f64,
}

impl Rotation {
    /// Rotation by an angle in degrees, sign of `scipy.ndimage.rotate`.
    pub(super) fn new(angle_deg: f64, width: usize, height: usize) -> Self {
        let (cosine, sine) = (libm::cos(angle_deg.to_radians()), libm::sin(angle_deg.to_radians()));
        let (row, column) = ((height as f64 - 1.0) / 2.0, (width as f64 - 1.0) / 2.0);
        Self {
            cosine,
            sine,
            row_offset: row - (cosine * row + sine * column),
            column_offset: column - (-sine * row + cosine * column),
        }
    }

    /// Source row and column of an output pixel.
    pub(super) fn source(&self, row: usize, column: usize) -> (f64, f64) {
        let (row, column) = (row as f64, column as f64);
        (
            row * self.cosine + column * self.sine + self.row_offset,
            row * -self.sine + column * self.cosine + self.column_offset,
        )
    }

    /// How the source row and column change from one output column to the next.
    pub(super) const fn step(&self) -> (f64, f64) {
        (self.sine, self.cosine)
    }

    /// The columns of an output row whose sources are inside, as a half-open range: linear
    /// functions are monotone even when rounded, so that they are one range.
    pub(super) fn inside(&self, row: usize, width: usize, height: usize) -> (usize, usize) {
        let (mut low, mut high) = (0.0_f64, width as f64 - 1.0);
        let start = self.source(row, 0);
        for (at, step, last) in
            [(start.0, self.sine, height as f64 - 1.0), (start.1, self.cosine, width as f64 - 1.0)]
        {
            // A slower change is lost in rounding; the exact test below does for it.
            if step.abs() > 1e-6 {
                let (a, b) = (-at / step, (last - at) / step);
                low = low.max(a.min(b));
                high = high.min(a.max(b));
            }
        }
        let inside = |column: usize| {
            let (y, x) = self.source(row, column);
            Taps::at(y, height).is_some() && Taps::at(x, width).is_some()
        };
        // One pixel of margin for rounding, then exactly.
        let mut begin = (low.ceil() - 1.0).max(0.0) as usize;
        let mut end = ((high.floor() + 2.0).max(0.0) as usize).min(width);
        while begin < end && !inside(begin) {
            begin += 1;
        }
        while begin < end && !inside(end - 1) {
            end -= 1;
        }
        if begin < end { (begin, end) } else { (0, 0) }
    }

    /// The shade at a source coordinate, rounded, as `SciPy` computes it; 0 outside.
    pub(super) fn shade(
        &self,
        shades: &[u8],
        width: usize,
        height: usize,
        at: (usize, usize),
    ) -> u8 {
        let (row, column) = self.source(at.0, at.1);
        match (Taps::at(row, height), Taps::at(column, width)) {
            (Some(rows), Some(columns)) => round_shade(blend(shades, width, rows, columns)),
            _ => 0,
        }
    }
}

/// Rounds half up; a cast saturates.
fn round_shade(value: f64) -> u8 {
    (value + 0.5) as u8
}

/// Taps of all rows or columns of a shifted image.
fn shift_taps(count: usize, shift: f64) -> Vec<Option<Taps>> {
    (0..count).map(|i| Taps::at(i as f64 - shift, count)).collect()
}

/// Shifts 8-bit shades; 0 outside.
pub(super) fn shift_shades(
    shades: &[u8],
    width: usize,
    height: usize,
    shift: Shift,
    out: &mut Vec<u8>,
) {
    let columns = shift_taps(width, shift.x);
    out.clear();
    for rows in shift_taps(height, shift.y) {
        out.extend(columns.iter().map(|columns| match (rows, *columns) {
            (Some(rows), Some(columns)) => round_shade(blend(shades, width, rows, columns)),
            _ => 0,
        }));
    }
}

/// Shifts heights; no data outside.
pub(super) fn shift_heights(layer: &Surface, shift: Shift, weightless: Weightless) -> Surface {
    let taps = |count: usize, shift: f64| {
        let mut taps = shift_taps(count, shift);
        if weightless == Weightless::Ignored {
            for taps in taps.iter_mut().flatten().filter(|taps| taps.second_weight == 0.0) {
                taps.second = taps.first;
            }
        }
        taps
    };
    let columns = taps(layer.width, shift.x);
    let mut values = Vec::with_capacity(layer.values.len());
    for rows in taps(layer.height, shift.y) {
        values.extend(columns.iter().map(|columns| match (rows, *columns) {
            (Some(rows), Some(columns)) => blend(&layer.values, layer.width, rows, columns) as f32,
            _ => f32::NAN,
        }));
    }
    Surface::new(layer.width, layer.height, values)
}

/// Rotates heights; no data outside.
fn rotate_heights(layer: &Surface, angle_deg: f64) -> Surface {
    let (width, height) = layer.size();
    let rotation = Rotation::new(angle_deg, width, height);
    let mut out = Surface::empty(width, height);
    for (row, line) in out.values.chunks_exact_mut(width).enumerate() {
        let (begin, end) = rotation.inside(row, width, height);
        for (column, value) in line.iter_mut().enumerate().take(end).skip(begin) {
            let (y, x) = rotation.source(row, column);
            if let (Some(rows), Some(columns)) = (Taps::at(y, height), Taps::at(x, width)) {
                *value = blend(&layer.values, width, rows, columns) as f32;
            }
        }
    }
    out
}

/// What is done to a layer.
enum Steps {
    /// Nothing.
    Keep,
    /// One interpolation.
    Shift,
    /// Two interpolations, one after the other, even where one moves nothing.
    ShiftAndRotate,
}

impl Steps {
    fn of(alignment: &Alignment) -> Self {
        // The published protocol interpolates twice whenever it found a shift, be it zero: that
        // widens holes by a pixel. It searched a rotation exactly then.
        if alignment.correlation.is_some()
            || alignment.flags.contains(&AlignmentFlag::NoRotation)
            || alignment.rotation_deg != 0.0
        {
            Self::ShiftAndRotate
        } else if alignment.shift_px == Shift::default() {
            Self::Keep
        } else {
            Self::Shift
        }
    }
}

/// The ground truth (or another layer on its grid) shifted and rotated, without the vertical
/// offset. Pixels whose source is outside, or touches a pixel without data, become NaN.
///
/// Interpolation is linear (an overshoot at walls, as cubic convolution has it, would be an error of
/// metres), first for the shift, then for the rotation, each rounded to 32 bits.
#[must_use]
pub fn apply(alignment: &Alignment, layer: &Surface) -> Surface {
    if layer.values.is_empty() {
        return layer.clone();
    }
    let layer = super::finite(layer);
    match Steps::of(alignment) {
        Steps::Keep => layer.into_owned(),
        Steps::Shift => shift_heights(&layer, alignment.shift_px, Weightless::Ignored),
        Steps::ShiftAndRotate => rotate_heights(
            &shift_heights(&layer, alignment.shift_px, Weightless::Counts),
            alignment.rotation_deg,
        ),
    }
}

/// A layer of classes, row-major, moved like [`apply`] moves heights, each pixel taking the class of
/// the nearest source pixel; `fill` where the source is outside.
///
/// # Panics
/// When `classes` does not hold `width * height` values.
#[must_use]
pub fn apply_nearest(
    alignment: &Alignment,
    width: usize,
    height: usize,
    classes: &[u16],
    fill: u16,
) -> Vec<u16> {
    assert_eq!(classes.len(), width * height, "classes of {width} x {height}");
    if matches!(Steps::of(alignment), Steps::Keep) {
        return classes.to_vec();
    }
    let rotation = Rotation::new(alignment.rotation_deg, width, height);
    let nearest = |coordinate: f64, count: usize| {
        (coordinate >= 0.0 && coordinate <= (count - 1) as f64)
            .then(|| (coordinate + 0.5).floor() as usize)
    };
    let mut out = Vec::with_capacity(classes.len());
    for row in 0..height {
        for column in 0..width {
            let (y, x) = rotation.source(row, column);
            // A pixel has a height only when the shifted image has it, too.
            let inside = nearest(y, height).is_some() && nearest(x, width).is_some();
            let source = (
                nearest(y - alignment.shift_px.y, height),
                nearest(x - alignment.shift_px.x, width),
            );
            out.push(match source {
                (Some(y), Some(x)) if inside => classes[y * width + x],
                _ => fill,
            });
        }
    }
    out
}
