//! What the mesh tests share: topology from the definition, without the mesher's own means.
#![allow(dead_code, reason = "each test file uses a part")]
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use safetensors::SafeTensors;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// A file of the published parity data: from `SAT3D_GOLDENS`, from `shared/goldens` beside the repository, or
/// from the crate's fixtures; else a line that says what is skipped.
pub fn golden(config: &str, stage: &str) -> Option<Tensors> {
    let name = format!("{config}/{stage}.safetensors");
    let crate_root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let given = std::env::var_os("SAT3D_GOLDENS").map(PathBuf::from);
    let folders = [
        given,
        Some(crate_root.join("../../../shared/goldens")),
        Some(crate_root.join("fixtures")),
    ];
    let found =
        folders.into_iter().flatten().find_map(|folder| std::fs::read(folder.join(&name)).ok());
    if found.is_none() {
        eprintln!("SKIPPED {name}: no such parity data; name its folder in SAT3D_GOLDENS");
    }
    found.map(Tensors)
}

/// A safetensors file in memory.
pub struct Tensors(Vec<u8>);

impl Tensors {
    fn items<const N: usize, T>(&self, name: &str, read: impl Fn([u8; N]) -> T) -> Vec<T> {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let tensor = file.tensor(name).unwrap();
        tensor.data().as_chunks::<N>().0.iter().map(|bytes| read(*bytes)).collect()
    }

    pub fn f32(&self, name: &str) -> Vec<f32> {
        self.items(name, f32::from_le_bytes)
    }

    pub fn f64(&self, name: &str) -> Vec<f64> {
        self.items(name, f64::from_le_bytes)
    }

    pub fn i64(&self, name: &str) -> Vec<i64> {
        self.items(name, i64::from_le_bytes)
    }

    pub fn u8(&self, name: &str) -> Vec<u8> {
        self.items(name, u8::from_le_bytes)
    }
}

/// A mesh as the checks see it.
pub struct Checked {
    pub vertices: Vec<[f64; 3]>,
    pub triangles: Vec<[u32; 3]>,
}

pub fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|k| a[k] - b[k])
}

pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| a[k] * b[k]).sum()
}

pub fn length(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

impl Checked {
    pub fn corners(&self, triangle: [u32; 3]) -> [[f64; 3]; 3] {
        triangle.map(|index| self.vertices[index as usize])
    }

    /// Twice the area along the normal.
    pub fn normal(&self, triangle: [u32; 3]) -> [f64; 3] {
        let [a, b, c] = self.corners(triangle);
        cross(minus(b, a), minus(c, a))
    }

    pub fn area(&self) -> f64 {
        self.triangles.iter().map(|t| length(self.normal(*t)) / 2.0).sum()
    }

    pub fn volume(&self) -> f64 {
        let of = |[a, b, c]: [[f64; 3]; 3]| dot(cross(a, b), c) / 6.0;
        self.triangles.iter().map(|t| of(self.corners(*t))).sum()
    }

    /// Says what keeps this from being a closed, consistently wound 2-manifold without degenerate
    /// triangles and without vertices at one place; else its Euler number.
    pub fn manifold(&self) -> Result<i64, String> {
        let count = self.vertices.len();
        let mut sides = HashMap::new();
        // From each vertex, the side across from it in each of its triangles: its link.
        let mut links = vec![Vec::new(); count];
        for triangle in &self.triangles {
            for k in 0..3 {
                let [a, b, c] = [0, 1, 2].map(|step| triangle[(k + step) % 3]);
                if a == b || a as usize >= count {
                    return Err(format!("triangle {triangle:?}"));
                }
                if sides.insert((a, b), triangle).is_some() {
                    return Err(format!("side {a} {b} comes twice in one direction"));
                }
                links[a as usize].push((b, c));
            }
            let area = length(self.normal(*triangle));
            if area.is_nan() || area <= 0.0 {
                return Err(format!("triangle {triangle:?} has no area"));
            }
        }
        if let Some((a, b)) = sides.keys().find(|(a, b)| !sides.contains_key(&(*b, *a))) {
            return Err(format!("side {a} {b} has one triangle"));
        }
        for (vertex, link) in links.iter().enumerate() {
            let next: HashMap<u32, u32> = link.iter().copied().collect();
            let Some(first) = link.first() else { return Err(format!("{vertex} has no triangle")) };
            let (mut at, mut steps) = (first.0, 0);
            loop {
                at = *next.get(&at).ok_or_else(|| format!("the link of {vertex} is open"))?;
                steps += 1;
                if at == first.0 {
                    break;
                }
            }
            if steps != link.len() {
                return Err(format!("the link of {vertex} has several cycles"));
            }
        }
        let mut places = HashMap::new();
        for (index, vertex) in self.vertices.iter().enumerate() {
            if let Some(other) = places.insert(vertex.map(f64::to_bits), index) {
                return Err(format!("vertices {other} and {index} at {vertex:?}"));
            }
        }
        Ok(count as i64 - sides.len() as i64 / 2 + self.triangles.len() as i64)
    }

    /// How often the surface winds round a point: 1 inside, 0 outside (van Oosterom and Strackee 1983).
    pub fn winding(&self, point: [f64; 3]) -> f64 {
        let of = |triangle: &[u32; 3]| {
            let [a, b, c] = self.corners(*triangle).map(|corner| minus(corner, point));
            let (la, lb, lc) = (length(a), length(b), length(c));
            let above = dot(a, cross(b, c));
            let below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb;
            2.0 * libm::atan2(above, below)
        };
        self.triangles.iter().map(of).sum::<f64>() / (4.0 * std::f64::consts::PI)
    }
}

/// Which points of a grid are inside, in the grid's order.
pub struct Solid<'a> {
    pub shape: [usize; 3],
    pub inside: &'a dyn Fn([usize; 3]) -> bool,
}

impl Solid<'_> {
    fn at(&self, point: [isize; 3]) -> bool {
        let within = (0..3).all(|k| point[k] >= 0 && (point[k] as usize) < self.shape[k]);
        within && (self.inside)(point.map(|v| v as usize))
    }

    /// Euler number of the solid's surface: twice that of the solid, which is the sum over cells, faces,
    /// edges and points of the number of pieces in each, with alternating signs. Pieces hang together along
    /// edges with both ends inside, and across the diagonal of a face.
    pub fn euler(&self) -> i64 {
        let mut sum = 0;
        let range = |k: usize| -1..self.shape[k] as isize;
        for x in range(0) {
            for y in range(1) {
                for z in range(2) {
                    let corners: Vec<bool> = (0..8)
                        .map(|c| self.at([x + (c & 1), y + (c >> 1 & 1), z + (c >> 2 & 1)]))
                        .collect();
                    // The cell, and the faces, edges and the point at its lowest corner.
                    for axes in 0..8_usize {
                        let members: Vec<usize> = (0..8).filter(|c| c & !axes == 0).collect();
                        let sign = if axes.count_ones() % 2 == 1 { 1 } else { -1 };
                        sum += sign * pieces(&members, &corners);
                    }
                }
            }
        }
        // Cells have a plus.
        2 * sum
    }
}

/// Pieces of the inside corners among `members`.
fn pieces(members: &[usize], corners: &[bool]) -> i64 {
    let inside: Vec<usize> = members.iter().copied().filter(|c| corners[*c]).collect();
    let mut piece: Vec<usize> = (0..inside.len()).collect();
    for _ in &inside {
        for i in 0..inside.len() {
            for j in 0..inside.len() {
                if (inside[i] ^ inside[j]).count_ones() <= 2 {
                    let least = piece[i].min(piece[j]);
                    (piece[i], piece[j]) = (least, least);
                }
            }
        }
    }
    piece.iter().enumerate().filter(|(index, piece)| index == *piece).count() as i64
}
