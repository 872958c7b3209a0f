//! Well-known binary (OGC Simple Features) of the two shapes that sat3d writes: points and
//! polygons of one ring, little-endian, two dimensions.

const LITTLE_ENDIAN: u8 = 1;
const POINT: u32 = 1;
const POLYGON: u32 = 3;

/// A point; `x` is the longitude or easting.
#[must_use]
pub fn point(x: f64, y: f64) -> Vec<u8> {
    let mut out = Vec::with_capacity(21);
    out.push(LITTLE_ENDIAN);
    out.extend_from_slice(&POINT.to_le_bytes());
    out.extend_from_slice(&x.to_le_bytes());
    out.extend_from_slice(&y.to_le_bytes());
    out
}

/// A polygon of one ring `(x, y)`. The ring is closed here if its last point is not the first.
#[must_use]
pub fn polygon(ring: &[(f64, f64)]) -> Vec<u8> {
    let closing = match (ring.first(), ring.last()) {
        (Some(first), Some(last)) if first != last => Some(*first),
        _ => None,
    };
    let points = ring.len() + usize::from(closing.is_some());
    let mut out = Vec::with_capacity(13 + 16 * points);
    out.push(LITTLE_ENDIAN);
    out.extend_from_slice(&POLYGON.to_le_bytes());
    out.extend_from_slice(&1_u32.to_le_bytes());
    out.extend_from_slice(&(points as u32).to_le_bytes());
    for (x, y) in ring.iter().copied().chain(closing) {
        out.extend_from_slice(&x.to_le_bytes());
        out.extend_from_slice(&y.to_le_bytes());
    }
    out
}

/// An axis-aligned rectangle, counter-clockwise (as RFC 7946 and GeoParquet recommend).
#[must_use]
pub fn rectangle(west: f64, south: f64, east: f64, north: f64) -> Vec<u8> {
    polygon(&[(west, south), (east, south), (east, north), (west, north), (west, south)])
}

/// What GeoParquet wants to know of a column of geometries.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Summary {
    pub has_points: bool,
    pub has_polygons: bool,
    /// West, south, east, north of all finite coordinates.
    pub bbox: Option<[f64; 4]>,
}

impl Summary {
    /// Takes in one geometry; `None` if it is no little-endian 2-D point or polygon.
    pub fn add(&mut self, wkb: &[u8]) -> Option<()> {
        let (&order, rest) = wkb.split_first()?;
        if order != LITTLE_ENDIAN {
            return None;
        }
        let (kind, mut rest) = take_u32(rest)?;
        match kind {
            POINT => {
                self.has_points = true;
                rest = self.add_coordinates(rest, 1)?;
            }
            POLYGON => {
                self.has_polygons = true;
                let rings;
                (rings, rest) = take_u32(rest)?;
                for _ in 0..rings {
                    let points;
                    (points, rest) = take_u32(rest)?;
                    rest = self.add_coordinates(rest, points as usize)?;
                }
            }
            _ => return None,
        }
        rest.is_empty().then_some(())
    }

    fn add_coordinates<'a>(&mut self, bytes: &'a [u8], points: usize) -> Option<&'a [u8]> {
        let (mine, rest) = bytes.split_at_checked(points.checked_mul(16)?)?;
        for pair in mine.chunks_exact(16) {
            let x = f64::from_le_bytes(pair[..8].try_into().ok()?);
            let y = f64::from_le_bytes(pair[8..].try_into().ok()?);
            // An empty point is written as NaN, NaN.
            if !(x.is_finite() && y.is_finite()) {
                continue;
            }
            let b = self.bbox.get_or_insert([x, y, x, y]);
            *b = [b[0].min(x), b[1].min(y), b[2].max(x), b[3].max(y)];
        }
        Some(rest)
    }

    /// Names of the kinds present, in GeoParquet's words.
    pub fn types(&self) -> Vec<&'static str> {
        [(self.has_points, "Point"), (self.has_polygons, "Polygon")]
            .into_iter()
            .filter_map(|(has, name)| has.then_some(name))
            .collect()
    }
}

fn take_u32(bytes: &[u8]) -> Option<(u32, &[u8])> {
    let (head, rest) = bytes.split_first_chunk::<4>()?;
    Some((u32::from_le_bytes(*head), rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_follow_the_standard() {
        // POINT(1 2), as in the OGC standard's example but little-endian.
        let hex: String = point(1.0, 2.0).iter().map(|b| format!("{b:02x}")).collect();
        assert_eq!(hex, "0101000000000000000000f03f0000000000000040");
        let open = polygon(&[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]);
        let closed = polygon(&[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)]);
        assert_eq!(open, closed);
        assert_eq!(closed.len(), 13 + 4 * 16);
    }

    #[test]
    fn the_summary_reads_what_is_written_and_nothing_else() {
        let mut summary = Summary::default();
        summary.add(&point(5.0, -1.0)).expect("a point");
        summary.add(&rectangle(-2.0, 0.0, 3.0, 4.0)).expect("a polygon");
        summary.add(&point(f64::NAN, f64::NAN)).expect("an empty point");
        assert_eq!(summary.bbox, Some([-2.0, -1.0, 5.0, 4.0]));
        assert_eq!(summary.types(), ["Point", "Polygon"]);

        let good = rectangle(0.0, 0.0, 1.0, 1.0);
        for cut in 0..good.len() {
            assert_eq!(Summary::default().add(&good[..cut]), None, "cut to {cut} bytes");
        }
        let mut long = good.clone();
        long.push(0);
        assert_eq!(Summary::default().add(&long), None);
        let mut line_string = point(0.0, 0.0);
        line_string[1] = 2;
        assert_eq!(Summary::default().add(&line_string), None);
    }
}
