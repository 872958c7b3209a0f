//! Value noise for textures: smooth, cheap, a pure function of position. Pictures only; no height
//! depends on it except where a bare crown lets pulses through.

/// A 32-bit hash of a lattice point.
fn lattice(ix: i32, iy: i32, seed: u32) -> u32 {
    let mut h = (ix as u32)
        .wrapping_mul(0x9E37_79B1)
        .wrapping_add((iy as u32).wrapping_mul(0x85EB_CA77))
        .wrapping_add(seed.wrapping_mul(0xC2B2_AE3D));
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// A number in `[0, 1)` that belongs to a cell of a lattice.
#[must_use]
pub fn cell(ix: i32, iy: i32, seed: u32) -> f32 {
    (lattice(ix, iy, seed) >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Value noise in `[0, 1)`: random at whole coordinates, smooth between. Its scale is 1.
#[must_use]
pub fn value(x: f64, y: f64, seed: u32) -> f32 {
    let (fx, fy) = (x.floor(), y.floor());
    let (ix, iy) = (fx as i32, fy as i32);
    let (tx, ty) = ((x - fx) as f32, (y - fy) as f32);
    let (sx, sy) = (tx * tx * (3.0 - 2.0 * tx), ty * ty * (3.0 - 2.0 * ty));
    let (ix1, iy1) = (ix.wrapping_add(1), iy.wrapping_add(1));
    let (a, b) = (cell(ix, iy, seed), cell(ix1, iy, seed));
    let (c, d) = (cell(ix, iy1, seed), cell(ix1, iy1, seed));
    let top = a + (b - a) * sx;
    let bottom = c + (d - c) * sx;
    top + (bottom - top) * sy
}

/// Sum of `octaves` of value noise, each twice as fine and half as strong, scaled to `[0, 1)`.
#[must_use]
pub fn fractal(x: f64, y: f64, seed: u32, octaves: u32) -> f32 {
    let (mut sum, mut weight, mut total) = (0.0_f32, 1.0_f32, 0.0_f32);
    let (mut px, mut py) = (x, y);
    for octave in 0..octaves {
        sum += weight * value(px, py, seed.wrapping_add(octave));
        total += weight;
        weight *= 0.5;
        // Turning each octave a little hides the lattice.
        (px, py) = (1.75 * px + 0.95 * py + 17.3, 1.75 * py - 0.95 * px + 5.7);
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_and_within_its_range() {
        let mut previous = value(0.0, 0.37, 5);
        for i in 1..4000 {
            let v = value(f64::from(i) * 1e-3, 0.37, 5);
            assert!((0.0..1.0).contains(&v));
            // The steepest smoothstep has slope 1.5.
            assert!((v - previous).abs() < 1.6e-3);
            previous = v;
        }
        assert_eq!(value(3.0, -2.0, 9), cell(3, -2, 9));
        assert!((0..500).all(|i| (0.0..1.0).contains(&fractal(f64::from(i) * 0.7, -3.1, 1, 4))));
    }
}
