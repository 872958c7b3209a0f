//! Marching cubes, layer by layer.
//!
//! Layers are rows of bits (inside or not), so that 64 cells at a time are seen to be empty, and a
//! vertex's number is a count of the bits before its own: no map from edges to vertices is kept.

use super::cases::CASES;
use super::{CLAMP, MeshError};

/// Where the points of a grid lie along an axis, and the planes that close the mesh before the first and
/// behind the last.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// The closing plane before the first point, the points, the closing plane behind the last one.
    padded: Vec<f64>,
}

impl Axis {
    /// Points and closing planes, all strictly ascending.
    ///
    /// # Errors
    /// [`MeshError::Axis`] where they do not ascend or are not finite, or where there is no point.
    pub fn new(
        before: f64,
        points: impl IntoIterator<Item = f64>,
        behind: f64,
    ) -> Result<Self, MeshError> {
        let mut padded = vec![before];
        padded.extend(points);
        padded.push(behind);
        let falls = |pair: &[f64]| !(pair[0] < pair[1] && (pair[1] - pair[0]).is_finite());
        if let Some(index) = padded.windows(2).position(falls) {
            return Err(MeshError::Axis { before: padded[index], next: padded[index + 1] });
        }
        if padded.len() == 2 {
            return Err(MeshError::NoPoints);
        }
        Ok(Self { padded })
    }

    /// Number of points, the closing planes not counted.
    #[expect(clippy::len_without_is_empty, reason = "there is always a point")]
    #[must_use]
    pub fn len(&self) -> usize {
        self.padded.len() - 2
    }

    /// The closing plane before the first point, the points, the closing plane behind the last one.
    #[must_use]
    pub fn with_closing_planes(&self) -> &[f64] {
        &self.padded
    }

    /// The least distance between neighbours, closing planes included.
    #[must_use]
    pub fn least_step(&self) -> f64 {
        self.padded.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min)
    }
}

/// Takes vertices and triangles as soon as they are final.
pub trait SurfaceSink {
    /// The next vertex, in the axes' coordinates. The first one has number 0.
    fn vertex(&mut self, position: [f64; 3]);

    /// A triangle of vertices that have all been given, counter-clockwise seen from outside where the
    /// axes 0, 1, 2 are right-handed.
    fn triangle(&mut self, corners: [u32; 3]);

    /// Says that the triangles up to the next call lie in cells along axis 1 number `cells`: those between
    /// point `cells - 1` and point `cells` of that axis. Cells 0 lie before the first point and cells
    /// `rows.len()` behind the last one. It comes for each row of cells, with or without triangles.
    fn cells(&mut self, cells: usize) {
        let _ = cells;
    }
}

/// A surface in double precision, in the axes' coordinates.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// The vertices.
    pub vertices: Vec<[f64; 3]>,
    /// The triangles, as [`SurfaceSink::triangle`] has them.
    pub triangles: Vec<[u32; 3]>,
}

impl SurfaceSink for Surface {
    fn vertex(&mut self, position: [f64; 3]) {
        self.vertices.push(position);
    }

    fn triangle(&mut self, corners: [u32; 3]) {
        self.triangles.push(corners);
    }
}

/// Rows of bits; a set bit's number is `first + ` the count of set bits before it.
#[derive(Clone, Debug, Default)]
struct Bits {
    words: Vec<u64>,
    /// The number of each word's lowest bit.
    numbers: Vec<u32>,
}

impl Bits {
    fn clear(&mut self) {
        self.words.clear();
        self.numbers.clear();
    }

    #[inline]
    fn push(&mut self, word: u64, number: u64) {
        self.words.push(word);
        // Checked for the whole layer when it is complete.
        self.numbers.push(number as u32);
    }

    #[inline]
    fn number(&self, word: usize, bit: u32) -> u32 {
        self.numbers[word] + (self.words[word] & ((1 << bit) - 1)).count_ones()
    }
}

/// A layer: values of its points, which of them are inside, which of its edges are cut. Rows and columns
/// are counted with the closing planes.
#[derive(Clone, Debug)]
struct Layer<V> {
    coordinate: f64,
    /// Empty in a closing plane.
    values: Vec<V>,
    inside: Vec<u64>,
    /// Cut edges along axis 1: from each row to the next.
    along_rows: Bits,
    /// Cut edges along axis 2: from each column to the next.
    along_columns: Bits,
}

impl<V> Default for Layer<V> {
    fn default() -> Self {
        Self {
            coordinate: f64::NAN,
            values: Vec::new(),
            inside: Vec::new(),
            along_rows: Bits::default(),
            along_columns: Bits::default(),
        }
    }
}

/// Marching cubes over a grid that comes layer by layer along axis 0, values with axis 2 fastest.
///
/// A point is inside where its value is at least the isovalue; NaN is outside. Beyond the grid, all is
/// outside: the mesh closes next to the closing planes. Only two layers are held. Vertices and
/// triangles come in the same order and with the same bits as from [`mesh_grid`](super::mesh_grid).
#[derive(Clone, Debug)]
pub struct LayerMesher<V> {
    rows: Axis,
    columns: Axis,
    isovalue: f64,
    /// Words in a row of bits.
    width: usize,
    previous: Layer<V>,
    layer: Layer<V>,
    /// Cut edges along axis 0, from the previous layer to this one.
    upright: Bits,
    /// Vertices so far.
    count: u64,
}

impl<V: Copy + Into<f64>> LayerMesher<V> {
    /// A mesher of layers of `rows.len() * columns.len()` values, whose mesh closes at `start` before the
    /// first layer.
    ///
    /// # Errors
    /// [`MeshError::Isovalue`] where the isovalue is not finite.
    pub fn new(start: f64, rows: Axis, columns: Axis, isovalue: f64) -> Result<Self, MeshError> {
        if !isovalue.is_finite() {
            return Err(MeshError::Isovalue(isovalue));
        }
        let width = (columns.len() + 2).div_ceil(64);
        let mut mesher = Self {
            rows,
            columns,
            isovalue,
            width,
            previous: Layer::default(),
            layer: Layer::default(),
            upright: Bits::default(),
            count: 0,
        };
        mesher.layer.coordinate = start;
        mesher.find_inside();
        mesher.find_edges();
        Ok(mesher)
    }

    /// Adds the next layer.
    ///
    /// # Errors
    /// [`MeshError::Axis`] where its coordinate is not above the last one's, [`MeshError::Layer`] where it
    /// has another number of values, [`MeshError::TooManyVertices`] where 32 bits do not number the
    /// vertices. After an error the mesh is incomplete.
    pub fn push(
        &mut self,
        coordinate: f64,
        values: &[V],
        sink: &mut impl SurfaceSink,
    ) -> Result<(), MeshError> {
        let expected = self.rows.len() * self.columns.len();
        if values.len() != expected {
            return Err(MeshError::Layer { found: values.len(), expected });
        }
        self.advance(coordinate, values, sink)
    }

    /// Closes the mesh at `end`, behind the last layer. Layers that follow begin another body.
    ///
    /// # Errors
    /// As [`push`](Self::push).
    pub fn finish(&mut self, end: f64, sink: &mut impl SurfaceSink) -> Result<(), MeshError> {
        self.advance(end, &[], sink)
    }

    /// Vertices given so far.
    #[must_use]
    pub fn vertices(&self) -> u64 {
        self.count
    }

    /// Takes the layer before the first one that is to be meshed: its vertices are numbered from 0 and
    /// not given to a sink. With a count of vertices that ends with this layer's, numbers are global.
    pub(super) fn prime(&mut self, coordinate: f64, values: &[V]) {
        self.layer.coordinate = coordinate;
        self.layer.values.extend_from_slice(values);
        self.find_inside();
        self.find_edges();
    }

    fn advance(
        &mut self,
        coordinate: f64,
        values: &[V],
        sink: &mut impl SurfaceSink,
    ) -> Result<(), MeshError> {
        let before = self.layer.coordinate;
        if !(before < coordinate && (coordinate - before).is_finite()) {
            return Err(MeshError::Axis { before, next: coordinate });
        }
        std::mem::swap(&mut self.previous, &mut self.layer);
        self.layer.coordinate = coordinate;
        self.layer.values.clear();
        self.layer.values.extend_from_slice(values);
        self.find_inside();
        self.upright.clear();
        for (a, b) in self.previous.inside.iter().zip(&self.layer.inside) {
            self.upright.push(a ^ b, self.count);
            self.count += u64::from((a ^ b).count_ones());
        }
        self.find_edges();
        if self.count > u64::from(u32::MAX) {
            return Err(MeshError::TooManyVertices(self.count));
        }
        self.give_vertices(sink);
        for row in 0..=self.rows.len() {
            sink.cells(row);
            for word in 0..self.width {
                self.give_triangles(row, word, sink);
            }
        }
        Ok(())
    }

    fn find_inside(&mut self) {
        let Layer { values, inside, .. } = &mut self.layer;
        inside.clear();
        inside.resize((self.rows.len() + 2) * self.width, 0);
        if values.is_empty() {
            return;
        }
        let rows = inside.chunks_exact_mut(self.width).skip(1);
        for (bits, values) in rows.zip(values.chunks_exact(self.columns.len())) {
            for (index, value) in values.iter().enumerate() {
                let value: f64 = (*value).into();
                // False for NaN.
                let is_inside = value >= self.isovalue;
                bits[(index + 1) / 64] |= u64::from(is_inside) << ((index + 1) % 64);
            }
        }
    }

    fn find_edges(&mut self) {
        let Layer { inside, along_rows, along_columns, .. } = &mut self.layer;
        along_rows.clear();
        along_columns.clear();
        for (a, b) in inside.iter().zip(&inside[self.width..]) {
            along_rows.push(a ^ b, self.count);
            self.count += u64::from((a ^ b).count_ones());
        }
        for row in inside.chunks_exact(self.width) {
            for (index, word) in row.iter().enumerate() {
                let cut = word ^ shifted(row, index);
                along_columns.push(cut, self.count);
                self.count += u64::from(cut.count_ones());
            }
        }
    }

    /// Vertices in the order of their numbers.
    fn give_vertices(&self, sink: &mut impl SurfaceSink) {
        let (rows, columns) = (&self.rows.padded, &self.columns.padded);
        let (low, high) = (&self.previous, &self.layer);
        self.each(&self.upright, |row, column| {
            let ends = [self.value(low, row, column), self.value(high, row, column)];
            let x = self.crossing([low.coordinate, high.coordinate], ends);
            sink.vertex([x, rows[row], columns[column]]);
        });
        self.each(&high.along_rows, |row, column| {
            let ends = [self.value(high, row, column), self.value(high, row + 1, column)];
            let y = self.crossing([rows[row], rows[row + 1]], ends);
            sink.vertex([high.coordinate, y, columns[column]]);
        });
        self.each(&high.along_columns, |row, column| {
            let ends = [self.value(high, row, column), self.value(high, row, column + 1)];
            let z = self.crossing([columns[column], columns[column + 1]], ends);
            sink.vertex([high.coordinate, rows[row], z]);
        });
    }

    fn each(&self, bits: &Bits, mut visit: impl FnMut(usize, usize)) {
        for (index, word) in bits.words.iter().enumerate() {
            let mut left = *word;
            while left != 0 {
                let bit = left.trailing_zeros() as usize;
                left &= left - 1;
                visit(index / self.width, index % self.width * 64 + bit);
            }
        }
    }

    /// The value of a point; `None` on a closing plane.
    fn value(&self, layer: &Layer<V>, row: usize, column: usize) -> Option<f64> {
        let across = self.columns.len();
        // A closing plane's index wraps round or is too large.
        let (row, column) = (row.wrapping_sub(1), column.wrapping_sub(1));
        let inside = row < self.rows.len() && column < across;
        if inside {
            layer.values.get(row * across + column).map(|value| (*value).into())
        } else {
            None
        }
    }

    /// Where the surface cuts an edge, given its ends' coordinates and values.
    fn crossing(&self, ends: [f64; 2], values: [Option<f64>; 2]) -> f64 {
        let outer =
            |value: Option<f64>| value.is_none_or(|value| value.is_nan() || value < self.isovalue);
        let share = match values {
            [Some(a), Some(b)] if (b - a).is_finite() => (self.isovalue - a) / (b - a),
            // Their difference is beyond 64-bit floats, that of their halves is not.
            [Some(a), Some(b)] if a.is_finite() && b.is_finite() => {
                (0.5 * self.isovalue - 0.5 * a) / (0.5 * b - 0.5 * a)
            }
            // No slope: the surface is next to the outside point.
            [a, _] if outer(a) => 0.0,
            _ => 1.0,
        };
        ends[0] + (ends[1] - ends[0]) * share.clamp(CLAMP, 1.0 - CLAMP)
    }

    /// Triangles of the up to 64 cells between a row and the next.
    #[inline]
    fn give_triangles(&self, row: usize, word: usize, sink: &mut impl SurfaceSink) {
        let (low, high) = (&self.previous, &self.layer);
        // Corner c: layer c & 1, row c >> 1 & 1, column c >> 2 & 1.
        let mut corners = [0_u64; 8];
        for c in 0..4 {
            let inside = if c & 1 == 0 { &low.inside } else { &high.inside };
            let bits = &inside[(row + (c >> 1)) * self.width..][..self.width];
            corners[c] = bits[word];
            corners[c + 4] = shifted(bits, word);
        }
        let some = corners.iter().fold(0, |some, bits| some | bits);
        let all = corners.iter().fold(!0, |all, bits| all & bits);
        let mut left = some & !all;
        while left != 0 {
            let bit = left.trailing_zeros();
            left &= left - 1;
            let case = (0..8).fold(0, |case, c| case | (corners[c] >> bit & 1) << c);
            let case = &CASES[case as usize];
            for triangle in &case.triangles[..usize::from(case.count)] {
                sink.triangle(triangle.map(|edge| self.number(usize::from(edge), row, word, bit)));
            }
        }
    }

    /// The number of the vertex on an edge of the cell at a row, and at a bit of a word.
    #[inline]
    fn number(&self, edge: usize, row: usize, word: usize, bit: u32) -> u32 {
        let (first, second) = (edge & 1, edge >> 1 & 1);
        let step = |word: usize| (word + (bit as usize + second) / 64, (bit + second as u32) % 64);
        let layer = if first == 0 { &self.previous } else { &self.layer };
        match edge / 4 {
            0 => {
                let (word, bit) = step((row + first) * self.width + word);
                self.upright.number(word, bit)
            }
            1 => {
                let (word, bit) = step(row * self.width + word);
                layer.along_rows.number(word, bit)
            }
            _ => layer.along_columns.number((row + second) * self.width + word, bit),
        }
    }
}

/// Word `index` of a row of bits, moved down by one bit: each bit's neighbour in the next column.
#[inline]
fn shifted(row: &[u64], index: usize) -> u64 {
    row[index] >> 1 | row.get(index + 1).map_or(0, |next| next << 63)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may fail")]
    use super::*;

    #[test]
    fn vertices_are_numbered_up_to_the_last_number_of_32_bits_and_not_beyond() {
        let axis = || Axis::new(-1.0, [0.0, 1.0, 2.0], 3.0).unwrap();
        // One point inside, with two edges cut beside it in its layer, or four, and one before it.
        let push = |count: u64| {
            let mut mesher = LayerMesher::new(-1.0, axis(), axis(), 0.5).unwrap();
            mesher.count = count;
            let mut layer = [0.0_f32; 9];
            layer[4] = 1.0;
            let pushed = mesher.push(0.0, &layer, &mut Surface::default());
            (pushed, mesher.vertices())
        };
        let (pushed, vertices) = push(0);
        pushed.unwrap();
        assert_eq!(vertices, 5);
        let last = u64::from(u32::MAX);
        let (pushed, vertices) = push(last - 5);
        pushed.unwrap();
        assert_eq!(vertices, last);
        for beyond in [1, 2, 1 << 40] {
            let (pushed, vertices) = push(last - 5 + beyond);
            let Err(MeshError::TooManyVertices(found)) = pushed else { panic!("{pushed:?}") };
            assert_eq!((found, vertices), (last + beyond, last + beyond));
        }
    }
}
