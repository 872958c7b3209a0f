//! Oriented rectangles in the local frame: footprints, lots, painted areas.

use serde::Serialize;

/// An axis-aligned box: west, south, east, north, metres in the local frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bounds {
    /// Lowest x.
    pub west: f64,
    /// Lowest y.
    pub south: f64,
    /// Highest x.
    pub east: f64,
    /// Highest y.
    pub north: f64,
}

impl Bounds {
    /// The box around a point.
    #[must_use]
    pub fn around(x: f64, y: f64, radius: f64) -> Self {
        Self { west: x - radius, south: y - radius, east: x + radius, north: y + radius }
    }

    /// The box grown on all sides.
    #[must_use]
    pub fn grown(self, by: f64) -> Self {
        Self {
            west: self.west - by,
            south: self.south - by,
            east: self.east + by,
            north: self.north + by,
        }
    }

    /// Whether a point lies in the box.
    #[must_use]
    pub fn contains(&self, x: f64, y: f64) -> bool {
        x >= self.west && x <= self.east && y >= self.south && y <= self.north
    }
}

/// A rectangle with its own axes: `u` at an angle from x, `v` to the left of `u`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Rect {
    /// Centre, metres east in the local frame.
    pub x: f64,
    /// Centre, metres north in the local frame.
    pub y: f64,
    /// Cosine of the angle from x to u, anticlockwise.
    pub cos: f64,
    /// Sine of that angle.
    pub sin: f64,
    /// Half the length along u, metres.
    pub half_u: f64,
    /// Half the width along v, metres.
    pub half_v: f64,
}

impl Rect {
    /// A rectangle whose u axis points along a unit vector.
    #[must_use]
    pub const fn new(center: [f64; 2], axis: [f64; 2], half_u: f64, half_v: f64) -> Self {
        Self { x: center[0], y: center[1], cos: axis[0], sin: axis[1], half_u, half_v }
    }

    /// Coordinates of a point along u and v, from the centre.
    #[must_use]
    pub fn local(&self, x: f64, y: f64) -> (f64, f64) {
        let (dx, dy) = (x - self.x, y - self.y);
        (dx * self.cos + dy * self.sin, dy * self.cos - dx * self.sin)
    }

    /// The point at local coordinates.
    #[must_use]
    pub fn at(&self, u: f64, v: f64) -> [f64; 2] {
        [self.x + u * self.cos - v * self.sin, self.y + u * self.sin + v * self.cos]
    }

    /// Whether local coordinates lie inside (the edge belongs to the rectangle).
    #[must_use]
    pub fn holds(&self, u: f64, v: f64) -> bool {
        u.abs() <= self.half_u && v.abs() <= self.half_v
    }

    /// Whether a point lies inside.
    #[must_use]
    pub fn contains(&self, x: f64, y: f64) -> bool {
        let (u, v) = self.local(x, y);
        self.holds(u, v)
    }

    /// The four corners.
    #[must_use]
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let (hu, hv) = (self.half_u, self.half_v);
        [self.at(-hu, -hv), self.at(hu, -hv), self.at(hu, hv), self.at(-hu, hv)]
    }

    /// The axis-aligned box around it.
    #[must_use]
    pub fn bounds(&self) -> Bounds {
        let w = self.half_u * self.cos.abs() + self.half_v * self.sin.abs();
        let h = self.half_u * self.sin.abs() + self.half_v * self.cos.abs();
        Bounds { west: self.x - w, south: self.y - h, east: self.x + w, north: self.y + h }
    }

    /// A rectangle given in this one's coordinates: centre `(u, v)`, half sizes, same axes.
    #[must_use]
    pub fn sub(&self, u: f64, v: f64, half_u: f64, half_v: f64) -> Self {
        let [x, y] = self.at(u, v);
        Self { x, y, half_u, half_v, ..*self }
    }

    /// The same rectangle with u and v exchanged.
    #[must_use]
    pub fn turned(&self) -> Self {
        Self { cos: -self.sin, sin: self.cos, half_u: self.half_v, half_v: self.half_u, ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_coordinates_and_back() {
        let (cos, sin) = (libm::cos(0.3), libm::sin(0.3));
        let rect = Rect::new([10.0, -4.0], [cos, sin], 5.0, 2.0);
        for (u, v) in [(0.0, 0.0), (4.9, -1.9), (-3.0, 1.0)] {
            let [x, y] = rect.at(u, v);
            let back = rect.local(x, y);
            assert!((back.0 - u).abs() < 1e-12 && (back.1 - v).abs() < 1e-12);
            assert!(rect.contains(x, y) && rect.turned().contains(x, y));
            assert!(rect.bounds().contains(x, y));
        }
        assert!(!rect.contains(10.0, -1.5));
        let area = rect.bounds();
        for [x, y] in rect.corners() {
            assert!(area.grown(1e-9).contains(x, y));
        }
    }
}
