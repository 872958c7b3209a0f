//! Solids with exact geometry: rectangular prisms under plane roofs, upright cylinders, and crowns
//! made of spheroids. Each answers two questions in closed form: how high its top is over a
//! point, and which part of a straight ray lies inside it.

use super::noise;
use super::shape::{Bounds, Rect};
use serde::Serialize;

/// A straight ray: position `(x + t dx, y + t dy, z + t dz)`, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start: x, y, z.
    pub from: [f64; 3],
    /// Change per unit of the parameter.
    pub step: [f64; 3],
}

impl Ray {
    /// The point at a parameter.
    #[must_use]
    pub fn at(&self, t: f64) -> [f64; 3] {
        [0, 1, 2].map(|i| self.from[i] + t * self.step[i])
    }
}

/// A face of a solid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub enum Face {
    /// Roof plane (by number), flat top, or spheroid (by number) of a crown.
    Top(u8),
    /// A wall: 0 +u, 1 -u, 2 +v, 3 -v; a cylinder has one.
    Wall(u8),
    /// The underside.
    Bottom,
}

/// The part of a ray inside a solid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// Parameter where the ray comes in.
    pub enter: f64,
    /// Parameter where it goes out.
    pub exit: f64,
    /// The face through which it goes out.
    pub exit_face: Face,
}

/// A roof over a rectangle, in the rectangle's coordinates; heights are NAVD88 metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Roof {
    /// The plane `z + du * u + dv * v`; flat when both slopes are 0.
    Plane {
        /// Height over the centre, metres.
        z: f64,
        /// Rise per metre along u.
        du: f64,
        /// Rise per metre along v.
        dv: f64,
    },
    /// Two planes that meet in a ridge along u: `ridge - slope * |v|`.
    Gable {
        /// Height of the ridge, metres.
        ridge: f64,
        /// Fall per metre away from the ridge.
        slope: f64,
    },
    /// Four planes of one slope; the ridge runs along u, `half_u - half_v` to each side.
    Hip {
        /// Height of the ridge, metres.
        ridge: f64,
        /// Fall per metre.
        slope: f64,
    },
}

/// A flat horizontal roof.
#[must_use]
pub const fn flat(z: f64) -> Roof {
    Roof::Plane { z, du: 0.0, dv: 0.0 }
}

/// A plane over a rectangle: height `c + a u + b v`.
#[derive(Clone, Copy)]
struct Plane {
    c: f64,
    a: f64,
    b: f64,
}

/// A convex body: a rectangle between a level bottom and a roof. The roof is the lowest of its
/// planes, which is why a body with a gabled or hipped roof is convex.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Prism {
    /// Footprint.
    pub rect: Rect,
    /// Height of the underside, metres.
    pub bottom: f64,
    /// The roof.
    pub roof: Roof,
}

impl Prism {
    /// The roof's planes and how many there are.
    fn planes(&self) -> ([Plane; 4], usize) {
        let none = Plane { c: f64::INFINITY, a: 0.0, b: 0.0 };
        match self.roof {
            Roof::Plane { z, du, dv } => ([Plane { c: z, a: du, b: dv }, none, none, none], 1),
            Roof::Gable { ridge, slope } => (
                [
                    Plane { c: ridge, a: 0.0, b: -slope },
                    Plane { c: ridge, a: 0.0, b: slope },
                    none,
                    none,
                ],
                2,
            ),
            Roof::Hip { ridge, slope } => {
                let end = ridge + slope * (self.rect.half_u - self.rect.half_v);
                (
                    [
                        Plane { c: ridge, a: 0.0, b: -slope },
                        Plane { c: ridge, a: 0.0, b: slope },
                        Plane { c: end, a: -slope, b: 0.0 },
                        Plane { c: end, a: slope, b: 0.0 },
                    ],
                    4,
                )
            }
        }
    }

    /// Height of the roof over a point, and the plane it belongs to; `None` outside.
    #[must_use]
    pub fn top(&self, x: f64, y: f64) -> Option<(f64, Face)> {
        let (u, v) = self.rect.local(x, y);
        if !self.rect.holds(u, v) {
            return None;
        }
        let (planes, count) = self.planes();
        let mut best = (f64::INFINITY, Face::Top(0));
        for (i, p) in planes[..count].iter().enumerate() {
            let z = p.c + p.a * u + p.b * v;
            if z < best.0 {
                best = (z, Face::Top(i as u8));
            }
        }
        Some(best)
    }

    /// Highest point of the roof, metres.
    #[must_use]
    pub fn highest(&self) -> f64 {
        match self.roof {
            Roof::Plane { z, du, dv } => {
                z + du.abs() * self.rect.half_u + dv.abs() * self.rect.half_v
            }
            Roof::Gable { ridge, .. } | Roof::Hip { ridge, .. } => ridge,
        }
    }

    /// Rise of the roof per metre along u and v on one of its planes.
    #[must_use]
    pub fn gradient(&self, plane: u8) -> (f64, f64) {
        let (planes, count) = self.planes();
        let p = planes[usize::from(plane).min(count - 1)];
        (p.a, p.b)
    }

    /// The part of a ray inside.
    #[must_use]
    pub fn clip(&self, ray: &Ray) -> Option<Span> {
        let r = &self.rect;
        let (u, v) = r.local(ray.from[0], ray.from[1]);
        let [dx, dy, dz] = ray.step;
        let (du, dv) = (dx * r.cos + dy * r.sin, dy * r.cos - dx * r.sin);
        let mut span =
            Span { enter: f64::NEG_INFINITY, exit: f64::INFINITY, exit_face: Face::Bottom };
        // Roof first, so that a vertical ray leaves through the roof and not through an edge.
        let (planes, count) = self.planes();
        for (i, p) in planes[..count].iter().enumerate() {
            let over = p.c + p.a * u + p.b * v - ray.from[2];
            cut(&mut span, over, dz - p.a * du - p.b * dv, Face::Top(i as u8));
        }
        cut(&mut span, ray.from[2] - self.bottom, -dz, Face::Bottom);
        cut(&mut span, r.half_u - u, du, Face::Wall(0));
        cut(&mut span, r.half_u + u, -du, Face::Wall(1));
        cut(&mut span, r.half_v - v, dv, Face::Wall(2));
        cut(&mut span, r.half_v + v, -dv, Face::Wall(3));
        (span.enter <= span.exit).then_some(span)
    }
}

/// Keeps the part of a span where `room - t * speed >= 0`.
fn cut(span: &mut Span, room: f64, speed: f64, face: Face) {
    if speed > 0.0 {
        let t = room / speed;
        if t < span.exit {
            span.exit = t;
            span.exit_face = face;
        }
    } else if speed < 0.0 {
        span.enter = span.enter.max(room / speed);
    } else if room < 0.0 {
        span.exit = f64::NEG_INFINITY;
        span.enter = f64::INFINITY;
    }
}

/// An upright cylinder with a level top: tanks, poles, trunks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Cylinder {
    /// Axis, metres east.
    pub x: f64,
    /// Axis, metres north.
    pub y: f64,
    /// Radius, metres.
    pub radius: f64,
    /// Height of the underside, metres.
    pub bottom: f64,
    /// Height of the top, metres.
    pub top: f64,
}

impl Cylinder {
    fn clip(&self, ray: &Ray) -> Option<Span> {
        let (x, y) = (ray.from[0] - self.x, ray.from[1] - self.y);
        let [dx, dy, dz] = ray.step;
        let mut span =
            Span { enter: f64::NEG_INFINITY, exit: f64::INFINITY, exit_face: Face::Bottom };
        cut(&mut span, self.top - ray.from[2], dz, Face::Top(0));
        cut(&mut span, ray.from[2] - self.bottom, -dz, Face::Bottom);
        let a = dx * dx + dy * dy;
        let c = x * x + y * y - self.radius * self.radius;
        if a > 0.0 {
            let half_b = x * dx + y * dy;
            let discriminant = half_b * half_b - a * c;
            if discriminant < 0.0 {
                return None;
            }
            let root = discriminant.sqrt();
            span.enter = span.enter.max((-half_b - root) / a);
            let exit = (-half_b + root) / a;
            if exit < span.exit {
                span.exit = exit;
                span.exit_face = Face::Wall(0);
            }
        } else if c > 0.0 {
            return None;
        }
        (span.enter <= span.exit).then_some(span)
    }
}

/// One spheroid of a crown, its axis upright.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Puff {
    /// Centre: x, y, z in metres.
    pub center: [f64; 3],
    /// Horizontal radius, metres.
    pub radius: f64,
    /// Half the height, metres.
    pub half_height: f64,
}

impl Puff {
    fn top(&self, x: f64, y: f64) -> Option<f64> {
        let (dx, dy) = (x - self.center[0], y - self.center[1]);
        let inside = 1.0 - (dx * dx + dy * dy) / (self.radius * self.radius);
        (inside >= 0.0).then(|| self.center[2] + self.half_height * inside.sqrt())
    }

    fn clip(&self, ray: &Ray) -> Option<(f64, f64)> {
        let (r, h) = (1.0 / self.radius, 1.0 / self.half_height);
        let scale = [r, r, h];
        let (mut a, mut half_b, mut c) = (0.0, 0.0, -1.0);
        for (i, scale) in scale.into_iter().enumerate() {
            let p = (ray.from[i] - self.center[i]) * scale;
            let d = ray.step[i] * scale;
            a += d * d;
            half_b += p * d;
            c += p * p;
        }
        let discriminant = half_b * half_b - a * c;
        if discriminant < 0.0 {
            return None;
        }
        let root = discriminant.sqrt();
        Some(((-half_b - root) / a, (-half_b + root) / a))
    }
}

/// A tree's or shrub's crown: a union of spheroids over empty space.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Crown {
    /// Middle of the crown, metres east.
    pub x: f64,
    /// Middle of the crown, metres north.
    pub y: f64,
    /// No spheroid reaches farther from the middle, metres.
    pub radius: f64,
    /// Lowest point, metres.
    pub bottom: f64,
    /// Highest point, metres.
    pub top: f64,
    /// The spheroids.
    pub puffs: Vec<Puff>,
    /// Share of the crown that is holes through which pulses and light pass; 0 for a closed crown.
    pub porosity: f32,
    /// Seed of the pattern of holes.
    pub pattern: u32,
}

impl Crown {
    fn is_hole(&self, x: f64, y: f64) -> bool {
        // Twigs: ridges of noise a hand wide.
        self.porosity > 0.0 && {
            let n = noise::value(x * 2.6, y * 2.6, self.pattern);
            (n - 0.5).abs() > 0.5 * (1.0 - self.porosity)
        }
    }

    fn reach(&self, x: f64, y: f64) -> bool {
        let (dx, dy) = (x - self.x, y - self.y);
        dx * dx + dy * dy <= self.radius * self.radius
    }

    fn top(&self, x: f64, y: f64) -> Option<(f64, Face)> {
        if !self.reach(x, y) {
            return None;
        }
        let mut best = (f64::NEG_INFINITY, 0);
        for (i, puff) in self.puffs.iter().enumerate() {
            if let Some(z) = puff.top(x, y)
                && z > best.0
            {
                best = (z, i);
            }
        }
        (best.0 > f64::NEG_INFINITY && !self.is_hole(x, y))
            .then_some((best.0, Face::Top(best.1 as u8)))
    }

    /// The outermost exit of a ray, with the entry into the same spheroid.
    fn clip(&self, ray: &Ray) -> Option<Span> {
        let passing = Passing::new(ray);
        if !passing.reaches(self.x, self.y, self.radius) {
            return None;
        }
        let mut best: Option<Span> = None;
        for (i, puff) in self.puffs.iter().enumerate() {
            // A rising ray leaves a spheroid below its top.
            let top = puff.center[2] + puff.half_height - ray.from[2];
            let low = best.is_some_and(|b| ray.step[2] > 0.0 && top < b.exit * ray.step[2] - 1e-9);
            if low || !passing.reaches(puff.center[0], puff.center[1], puff.radius) {
                continue;
            }
            if let Some((enter, exit)) = puff.clip(ray)
                && best.is_none_or(|b| exit > b.exit)
            {
                let [x, y, _] = ray.at(exit);
                if !self.is_hole(x, y) {
                    best = Some(Span { enter, exit, exit_face: Face::Top(i as u8) });
                }
            }
        }
        best
    }

    /// The first entry of a ray into a spheroid beyond a parameter.
    fn enter(&self, ray: &Ray, after: f64) -> Option<(f64, Face)> {
        let passing = Passing::new(ray);
        if !passing.reaches(self.x, self.y, self.radius) {
            return None;
        }
        let mut best: Option<(f64, Face)> = None;
        for (i, puff) in self.puffs.iter().enumerate() {
            if passing.reaches(puff.center[0], puff.center[1], puff.radius)
                && let Some((enter, _)) = puff.clip(ray)
                && enter > after
                && best.is_none_or(|b| enter < b.0)
            {
                let [x, y, _] = ray.at(enter);
                if !self.is_hole(x, y) {
                    best = Some((enter, Face::Top(i as u8)));
                }
            }
        }
        best
    }

    /// Whether a ray meets the crown beyond a parameter. Cheaper than [`Self::clip`].
    fn blocks(&self, ray: &Ray, after: f64) -> bool {
        let passing = Passing::new(ray);
        if !passing.reaches(self.x, self.y, self.radius) {
            return false;
        }
        self.puffs.iter().any(|puff| {
            let top = puff.center[2] + puff.half_height - ray.from[2];
            // A rising ray passes over what is lower than its start.
            (ray.step[2] <= 0.0 || top >= after * ray.step[2] - 1e-9)
                && passing.reaches(puff.center[0], puff.center[1], puff.radius)
                && puff.clip(ray).is_some_and(|(enter, exit)| {
                    let at = if enter > after { enter } else { exit };
                    exit > after && {
                        let [x, y, _] = ray.at(at);
                        !self.is_hole(x, y)
                    }
                })
        })
    }
}

/// A ray seen from above: how close it passes by upright axes.
#[derive(Clone, Copy)]
struct Passing {
    from: [f64; 2],
    step: [f64; 2],
    /// Squared length of the step, a little enlarged so that rounding never rejects what is touched.
    length: f64,
}

impl Passing {
    fn new(ray: &Ray) -> Self {
        let [dx, dy, _] = ray.step;
        let length = (dx * dx + dy * dy) * (1.0 + 1e-9);
        Self { from: [ray.from[0], ray.from[1]], step: [dx, dy], length }
    }

    /// Whether the line comes within `radius` of an axis.
    fn reaches(&self, x: f64, y: f64, radius: f64) -> bool {
        let (x, y) = (x - self.from[0], y - self.from[1]);
        if self.length == 0.0 {
            return x * x + y * y <= radius * radius * (1.0 + 1e-9);
        }
        let cross = x * self.step[1] - y * self.step[0];
        cross * cross <= radius * radius * self.length
    }
}

/// Any solid.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// A rectangle under a roof.
    Prism(Prism),
    /// An upright cylinder.
    Cylinder(Cylinder),
    /// A crown.
    Crown(Crown),
}

impl Shape {
    /// Height of the top over a point and the face that it is on; `None` where the solid is not.
    #[must_use]
    pub fn top(&self, x: f64, y: f64) -> Option<(f64, Face)> {
        match self {
            Self::Prism(p) => p.top(x, y),
            Self::Cylinder(c) => {
                let (dx, dy) = (x - c.x, y - c.y);
                (dx * dx + dy * dy <= c.radius * c.radius).then_some((c.top, Face::Top(0)))
            }
            Self::Crown(c) => c.top(x, y),
        }
    }

    /// Highest point, metres.
    #[must_use]
    pub fn highest(&self) -> f64 {
        match self {
            Self::Prism(p) => p.highest(),
            Self::Cylinder(c) => c.top,
            Self::Crown(c) => c.top,
        }
    }

    /// The box around the footprint.
    #[must_use]
    pub fn bounds(&self) -> Bounds {
        match self {
            Self::Prism(p) => p.rect.bounds(),
            Self::Cylinder(c) => Bounds::around(c.x, c.y, c.radius),
            Self::Crown(c) => Bounds::around(c.x, c.y, c.radius),
        }
    }

    /// The part of a ray inside (of a crown: inside the spheroid that the ray leaves last).
    #[must_use]
    pub fn clip(&self, ray: &Ray) -> Option<Span> {
        match self {
            Self::Prism(p) => p.clip(ray),
            Self::Cylinder(c) => c.clip(ray),
            Self::Crown(c) => c.clip(ray),
        }
    }

    /// Where a ray first comes in from outside beyond a parameter, and through which face. A ray that starts
    /// inside a solid (of a crown: a spheroid) does not meet that one.
    #[must_use]
    pub fn enter(&self, ray: &Ray, after: f64) -> Option<(f64, Face)> {
        if let Self::Crown(crown) = self {
            return crown.enter(ray, after);
        }
        // A ray comes in where one that runs the other way goes out.
        let back = Ray { from: ray.from, step: ray.step.map(|d| -d) };
        let span = self.clip(&back)?;
        (-span.exit > after).then_some((-span.exit, span.exit_face))
    }

    /// Whether a ray meets the solid beyond a parameter.
    #[must_use]
    pub fn blocks(&self, ray: &Ray, after: f64) -> bool {
        match self {
            Self::Prism(p) => p.clip(ray).is_some_and(|s| s.exit > after),
            Self::Cylinder(c) => c.clip(ray).is_some_and(|s| s.exit > after),
            Self::Crown(c) => c.blocks(ray, after),
        }
    }

    /// Outward normal (not of unit length) of a face at a point on it.
    #[must_use]
    pub fn normal(&self, face: Face, at: [f64; 3]) -> [f64; 3] {
        match (self, face) {
            (_, Face::Bottom) => [0.0, 0.0, -1.0],
            (Self::Prism(p), Face::Top(plane)) => {
                let (a, b) = p.gradient(plane);
                let r = &p.rect;
                [-(a * r.cos - b * r.sin), -(a * r.sin + b * r.cos), 1.0]
            }
            (Self::Prism(p), Face::Wall(side)) => {
                let (c, s) = (p.rect.cos, p.rect.sin);
                match side {
                    0 => [c, s, 0.0],
                    1 => [-c, -s, 0.0],
                    2 => [-s, c, 0.0],
                    _ => [s, -c, 0.0],
                }
            }
            (Self::Cylinder(c), Face::Wall(_)) => [at[0] - c.x, at[1] - c.y, 0.0],
            (Self::Cylinder(_), Face::Top(_)) => [0.0, 0.0, 1.0],
            (Self::Crown(c), Face::Top(i) | Face::Wall(i)) => {
                let puff = &c.puffs[usize::from(i).min(c.puffs.len() - 1)];
                let (r2, h2) = (puff.radius * puff.radius, puff.half_height * puff.half_height);
                [
                    (at[0] - puff.center[0]) / r2,
                    (at[1] - puff.center[1]) / r2,
                    (at[2] - puff.center[2]) / h2,
                ]
            }
        }
    }
}

#[cfg(test)]
#[path = "solid_tests.rs"]
mod tests;
