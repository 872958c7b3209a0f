//! Evaluating the folded field: at points, along a ray, along a vertical column.

use super::fold::{Field, Line, Plane, Tables};
use super::kernel::{LANES, softplus, sum_lanes};
use rayon::prelude::*;

/// Points per parallel batch: fixed, so that the split never depends on the number of threads.
const BATCH: usize = 1024;

/// Something with a density along a ray, at given distances from the ray's start.
pub(crate) trait Medium {
    /// Raw densities at the distances `radii`; where `hidden` is given, the hidden values too
    /// (`radii.len()` times [`Medium::hidden`]), from which colours follow.
    fn raw(&mut self, radii: &[f32], raw: &mut [f32], hidden: Option<&mut [f32]>);

    /// Hidden values per point.
    fn hidden(&self) -> usize;
}

/// The texel below a coordinate in `[-1, 1]` (counted with the ring of zeros, so from 0) and the
/// weight of the texel above it: `align_corners=false`, in `f32` as the network samples.
#[inline(always)]
fn cell(coordinate: f32, count: usize) -> (usize, f32) {
    let size = count as f32;
    let index = ((coordinate + 1.0) * size - 1.0) / 2.0;
    // Written so that NaN lands outside as well.
    if index >= -1.0 && index < size {
        let below = index.floor();
        // Below + 1 is an integer from 0: added to 2^23 it is the low bits, which costs less than a
        // conversion that saturates.
        let cell = (below + 8_388_609.0).to_bits() & 0x007f_ffff;
        (cell as usize, index - below)
    } else {
        (0, 0.0)
    }
}

impl Plane {
    /// The four texels around `(u, v)` (u along columns) and their weights.
    #[inline(always)]
    fn taps(&self, u: f32, v: f32, hidden: usize) -> ([&[f32]; 4], [f32; 4]) {
        let (column, right) = cell(u, self.columns);
        let (row, below) = cell(v, self.rows);
        let pitch = (self.columns + 2) * hidden;
        let upper = &self.texels[row * pitch + column * hidden..][..2 * hidden];
        let lower = &self.texels[(row + 1) * pitch + column * hidden..][..2 * hidden];
        let (a, b) = upper.split_at(hidden);
        let (c, d) = lower.split_at(hidden);
        let (left, above) = (1.0 - right, 1.0 - below);
        ([a, b, c, d], [left * above, right * above, left * below, right * below])
    }

    /// Interpolated between columns at `u`: a line over rows.
    fn line_over_rows(&self, u: f32, hidden: usize) -> Line {
        let (column, right) = cell(u, self.columns);
        let pitch = (self.columns + 2) * hidden;
        let mut texels = Vec::with_capacity((self.rows + 2) * hidden);
        for row in self.texels.chunks_exact(pitch) {
            let (a, b) = row[column * hidden..][..2 * hidden].split_at(hidden);
            texels.extend(a.iter().zip(b).map(|(a, b)| (1.0 - right) * a + right * b));
        }
        Line { cells: self.rows, texels }
    }

    /// Interpolated between rows at `v`: a line over columns.
    fn line_over_columns(&self, v: f32, hidden: usize) -> Line {
        let (row, below) = cell(v, self.rows);
        let pitch = (self.columns + 2) * hidden;
        let (a, b) = self.texels[row * pitch..][..2 * pitch].split_at(pitch);
        let texels = a.iter().zip(b).map(|(a, b)| (1.0 - below) * a + below * b).collect();
        Line { cells: self.columns, texels }
    }
}

impl Line {
    #[inline(always)]
    fn taps(&self, z: f32, hidden: usize) -> ([&[f32]; 2], [f32; 2]) {
        let (index, above) = cell(z, self.cells);
        let (a, b) = self.texels[index * hidden..][..2 * hidden].split_at(hidden);
        ([a, b], [1.0 - above, above])
    }
}

/// Points whose hidden values are computed before their dot products are taken, where nobody wants to
/// keep them.
const ROOM: usize = 8;

/// Hidden values of one point before the softplus: `base` plus weighted texels.
///
/// One plain loop over slices of one length: that is the form which the compiler vectorises whole.
#[inline(always)]
fn sum_taps<const TAPS: usize>(
    base: &[f32],
    taps: [&[f32]; TAPS],
    weights: [f32; TAPS],
    out: &mut [f32],
) {
    let count = out.len();
    let base = &base[..count];
    let mut cut = taps;
    for tap in 0..TAPS {
        cut[tap] = &taps[tap][..count];
    }
    for index in 0..count {
        let mut value = base[index];
        for tap in 0..TAPS {
            value = weights[tap].mul_add(cut[tap][index], value);
        }
        out[index] = value;
    }
}

/// The dot product of hidden values and density weights, both whole groups of lanes.
#[inline(always)]
fn dot(values: &[f32], weights: &[f32]) -> f32 {
    let mut sum = [0.0_f32; LANES];
    let (values, weights) = (values.as_chunks::<LANES>().0, weights.as_chunks::<LANES>().0);
    for (values, weights) in values.iter().zip(weights) {
        for lane in 0..LANES {
            sum[lane] = values[lane].mul_add(weights[lane], sum[lane]);
        }
    }
    sum_lanes(sum)
}

/// Hidden values of numbered points before the softplus. A trait rather than a closure, because only a method can be
/// made to be inlined, and what is not inlined is compiled without the vector unit.
trait HiddenValues {
    fn at(&self, index: usize, out: &mut [f32]);
}

/// Hidden values of all points, in groups, and their dot products with the density weights. Without a
/// store the values go to a small buffer that is used again and again.
#[inline(always)]
fn head(field: &Field, raw: &mut [f32], store: Option<&mut [f32]>, source: &impl HiddenValues) {
    let hidden = field.hidden;
    let density = &field.density_weight[..hidden];
    let kept = store.is_some();
    let mut own = if kept { Vec::new() } else { vec![0.0; ROOM * hidden] };
    let slots = store.unwrap_or(&mut own);
    for (group, raw) in raw.chunks_mut(ROOM).enumerate() {
        let first = if kept { group * ROOM * hidden } else { 0 };
        let slots = &mut slots[first..][..raw.len() * hidden];
        for (index, slot) in slots.chunks_exact_mut(hidden).enumerate() {
            source.at(group * ROOM + index, slot);
        }
        for value in slots.iter_mut() {
            *value = softplus(*value);
        }
        for (raw, slot) in raw.iter_mut().zip(slots.chunks_exact(hidden)) {
            *raw = field.density_bias + dot(slot, density);
        }
    }
}

struct PointsOp<'a> {
    field: &'a Field,
    points: &'a [[f32; 3]],
    raw: &'a mut [f32],
    store: Option<&'a mut [f32]>,
}

impl pulp::NullaryFnOnce for PointsOp<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { field, points, raw, store } = self;
        let raw = &mut raw[..points.len()];
        match &*field.tables {
            Tables::PlaneAndLine(plane, line) => {
                head(field, raw, store, &PlaneAndLinePoints { field, points, plane, line });
            }
            Tables::Triplane(planes) => {
                head(field, raw, store, &TriplanePoints { field, points, planes });
            }
        }
    }
}

struct PlaneAndLinePoints<'a> {
    field: &'a Field,
    points: &'a [[f32; 3]],
    plane: &'a Plane,
    line: &'a Line,
}

impl HiddenValues for PlaneAndLinePoints<'_> {
    #[inline(always)]
    fn at(&self, index: usize, out: &mut [f32]) {
        let hidden = self.field.hidden;
        let [x, y, z] = self.points[index];
        let ([a, b, c, d], [wa, wb, wc, wd]) = self.plane.taps(x, y, hidden);
        let ([e, f], [we, wf]) = self.line.taps(z, hidden);
        let weights = [wa, wb, wc, wd, we, wf];
        sum_taps(&self.field.bias, [a, b, c, d, e, f], weights, out);
    }
}

struct TriplanePoints<'a> {
    field: &'a Field,
    points: &'a [[f32; 3]],
    planes: &'a [Plane; 3],
}

impl HiddenValues for TriplanePoints<'_> {
    #[inline(always)]
    fn at(&self, index: usize, out: &mut [f32]) {
        let hidden = self.field.hidden;
        let [x, y, z] = self.points[index];
        let ([a, b, c, d], [wa, wb, wc, wd]) = self.planes[0].taps(x, y, hidden);
        let ([e, f, g, h], [we, wf, wg, wh]) = self.planes[1].taps(x, z, hidden);
        let ([i, j, k, l], [wi, wj, wk, wl]) = self.planes[2].taps(z, y, hidden);
        let taps = [a, b, c, d, e, f, g, h, i, j, k, l];
        let weights = [wa, wb, wc, wd, we, wf, wg, wh, wi, wj, wk, wl];
        sum_taps(&self.field.bias, taps, weights, out);
    }
}

struct ColumnOp<'a> {
    field: &'a Field,
    base: &'a [f32],
    first: &'a Line,
    second: Option<&'a Line>,
    heights: &'a [f32],
    raw: &'a mut [f32],
    store: Option<&'a mut [f32]>,
}

impl pulp::NullaryFnOnce for ColumnOp<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { field, base, first, second, heights, raw, store } = self;
        let hidden = field.hidden;
        let raw = &mut raw[..heights.len()];
        match second {
            Some(second) => {
                head(field, raw, store, &TwoLines { hidden, base, first, second, heights });
            }
            None => head(field, raw, store, &OneLine { hidden, base, line: first, heights }),
        }
    }
}

struct OneLine<'a> {
    hidden: usize,
    base: &'a [f32],
    line: &'a Line,
    heights: &'a [f32],
}

impl HiddenValues for OneLine<'_> {
    #[inline(always)]
    fn at(&self, index: usize, out: &mut [f32]) {
        let (taps, weights) = self.line.taps(self.heights[index], self.hidden);
        sum_taps(self.base, taps, weights, out);
    }
}

struct TwoLines<'a> {
    hidden: usize,
    base: &'a [f32],
    first: &'a Line,
    second: &'a Line,
    heights: &'a [f32],
}

impl HiddenValues for TwoLines<'_> {
    #[inline(always)]
    fn at(&self, index: usize, out: &mut [f32]) {
        let ([a, b], [wa, wb]) = self.first.taps(self.heights[index], self.hidden);
        let ([c, d], [wc, wd]) = self.second.taps(self.heights[index], self.hidden);
        sum_taps(self.base, [a, b, c, d], [wa, wb, wc, wd], out);
    }
}

struct ActivateOp<'a> {
    field: &'a Field,
    values: &'a mut [f32],
}

impl pulp::NullaryFnOnce for ActivateOp<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let activation = self.field.activation;
        for value in self.values {
            *value = activation.apply(*value);
        }
    }
}

struct ColorOp<'a> {
    field: &'a Field,
    hidden: &'a [f32],
    out: &'a mut [f32],
}

impl pulp::NullaryFnOnce for ColorOp<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.field.color.colors(self.hidden, self.field.hidden, self.out);
    }
}

impl Field {
    /// Raw densities of points of the map frame, before the activation.
    #[must_use]
    pub fn raw_densities(&self, points: &[[f32; 3]]) -> Vec<f32> {
        let mut raw = vec![0.0; points.len()];
        raw.par_chunks_mut(BATCH).zip(points.par_chunks(BATCH)).for_each(|(raw, points)| {
            self.raw_at(points, raw, None);
        });
        raw
    }

    /// Volume densities (per cube unit) of points of the map frame.
    #[must_use]
    pub fn densities(&self, points: &[[f32; 3]]) -> Vec<f32> {
        let mut values = self.raw_densities(points);
        values.par_chunks_mut(BATCH).for_each(|values| self.activate(values));
        values
    }

    /// Volume densities and colours ([`Field::color_channels`] values a point, in `[0, 1]`) of points.
    #[must_use]
    pub fn densities_and_colors(&self, points: &[[f32; 3]]) -> (Vec<f32>, Vec<f32>) {
        let (channels, padded) = (self.color.channels, self.color.padded);
        let mut densities = vec![0.0; points.len()];
        let mut colors = vec![0.0; points.len() * channels];
        (densities.par_chunks_mut(BATCH).zip(colors.par_chunks_mut(BATCH * channels)))
            .zip(points.par_chunks(BATCH))
            .for_each(|((densities, colors), points)| {
                let mut hidden = vec![0.0; points.len() * self.hidden];
                let mut wide = vec![0.0; points.len() * padded];
                self.raw_at(points, densities, Some(&mut hidden));
                self.activate(densities);
                self.colors_of(&hidden, &mut wide);
                for (color, wide) in
                    colors.chunks_exact_mut(channels).zip(wide.chunks_exact(padded))
                {
                    color.copy_from_slice(&wide[..channels]);
                }
            });
        (densities, colors)
    }

    /// Raw densities on this thread.
    pub(crate) fn raw_at(&self, points: &[[f32; 3]], raw: &mut [f32], store: Option<&mut [f32]>) {
        self.arch.dispatch(PointsOp { field: self, points, raw, store });
    }

    /// Applies the density activation in place.
    pub(crate) fn activate(&self, values: &mut [f32]) {
        self.arch.dispatch(ActivateOp { field: self, values });
    }

    /// Colours, padded to [`Field::padded_colors`] a point, of points with these hidden values.
    pub(crate) fn colors_of(&self, hidden: &[f32], out: &mut [f32]) {
        self.arch.dispatch(ColorOp { field: self, hidden, out });
    }

    /// Values per point that [`Field::colors_of`] writes.
    pub(crate) fn padded_colors(&self) -> usize {
        self.color.padded
    }

    /// Hidden values per point.
    pub(crate) fn hidden(&self) -> usize {
        self.hidden
    }

    /// The vector unit that was found.
    pub(crate) fn arch(&self) -> pulp::Arch {
        self.arch
    }
}

/// A straight ray through a field.
pub(crate) struct RayInField<'a> {
    /// The field.
    pub field: &'a Field,
    /// Where radius 0 is, map frame.
    pub origin: [f32; 3],
    /// Unit direction, map frame.
    pub direction: [f32; 3],
    /// Room for the points.
    pub points: &'a mut Vec<[f32; 3]>,
}

impl Medium for RayInField<'_> {
    fn raw(&mut self, radii: &[f32], raw: &mut [f32], hidden: Option<&mut [f32]>) {
        self.points.clear();
        let (o, d) = (self.origin, self.direction);
        self.points
            .extend(radii.iter().map(|r| [o[0] + d[0] * r, o[1] + d[1] * r, o[2] + d[2] * r]));
        self.field.raw_at(self.points, raw, hidden);
    }

    fn hidden(&self) -> usize {
        self.field.hidden
    }
}

/// What columns at the same x share: nothing where x and y are read from one plane, and a line over z
/// for each x in a tri-plane.
pub(crate) struct ColumnTables<'a> {
    field: &'a Field,
    over_x: Vec<Line>,
}

impl<'a> ColumnTables<'a> {
    /// Tables for columns at these x.
    pub fn new(field: &'a Field, xs: &[f32]) -> Self {
        let over_x = match &*field.tables {
            Tables::PlaneAndLine(..) => Vec::new(),
            Tables::Triplane(planes) => {
                xs.par_iter().map(|x| planes[1].line_over_rows(*x, field.hidden)).collect()
            }
        };
        Self { field, over_x }
    }

    /// What columns at the same y share.
    pub fn row(&self, y: f32) -> ColumnRow<'_> {
        let over_y = match &*self.field.tables {
            Tables::PlaneAndLine(..) => None,
            Tables::Triplane(planes) => Some(planes[2].line_over_columns(y, self.field.hidden)),
        };
        ColumnRow { tables: self, y, over_y }
    }
}

/// Columns of one y.
pub(crate) struct ColumnRow<'a> {
    tables: &'a ColumnTables<'a>,
    y: f32,
    over_y: Option<Line>,
}

impl ColumnRow<'_> {
    /// The column at `x`, the `index`-th of those that the tables were made for.
    pub fn column<'a>(&'a self, index: usize, x: f32, room: &'a mut ColumnRoom) -> Column<'a> {
        let field = self.tables.field;
        let hidden = field.hidden;
        let (plane, first, second) = match (&*field.tables, &self.over_y) {
            (Tables::PlaneAndLine(plane, line), _) => (plane, line, None),
            (Tables::Triplane(planes), over_y) => {
                (&planes[0], &self.tables.over_x[index], over_y.as_ref())
            }
        };
        let (taps, weights) = plane.taps(x, self.y, hidden);
        room.base.clear();
        room.base.extend_from_slice(&field.bias);
        for (tap, weight) in taps.iter().zip(weights) {
            for (base, value) in room.base.iter_mut().zip(*tap) {
                *base += weight * value;
            }
        }
        Column { field, base: &room.base, first, second, heights: &mut room.heights }
    }
}

/// Buffers of a column, kept from one to the next.
#[derive(Default)]
pub(crate) struct ColumnRoom {
    base: Vec<f32>,
    heights: Vec<f32>,
}

/// A vertical line through the field: what depends on x and y is summed up once.
pub(crate) struct Column<'a> {
    field: &'a Field,
    base: &'a [f32],
    first: &'a Line,
    second: Option<&'a Line>,
    heights: &'a mut Vec<f32>,
}

impl Column<'_> {
    /// Raw densities at heights z.
    pub fn raw_at_heights(&self, heights: &[f32], raw: &mut [f32]) {
        let Self { field, base, first, second, .. } = *self;
        field.arch.dispatch(ColumnOp { field, base, first, second, heights, raw, store: None });
    }
}

/// As a ray from z = 1 downwards.
impl Medium for Column<'_> {
    fn raw(&mut self, radii: &[f32], raw: &mut [f32], store: Option<&mut [f32]>) {
        self.heights.clear();
        self.heights.extend(radii.iter().map(|radius| 1.0 - radius));
        let Self { field, base, first, second, .. } = *self;
        let heights = &self.heights[..];
        field.arch.dispatch(ColumnOp { field, base, first, second, heights, raw, store });
    }

    fn hidden(&self) -> usize {
        self.field.hidden
    }
}

#[cfg(test)]
mod tests;
