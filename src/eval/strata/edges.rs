//! Distance to the nearest height discontinuity: an exact Euclidean distance transform (Felzenszwalb
//! and Huttenlocher, 2012) for pixels that are not square, with sites on the sides of pixels.
//!
//! Sides between columns lie half a pixel east of a centre, sides between rows half a pixel south.
//! Along each column a scan finds the nearest site above and below; along each row the squared
//! distance is then the lower envelope of parabolas, two for each column. Both are linear in the
//! number of pixels.

use super::super::surface::Surface;
use super::{NO_CLASS, bin};

/// The bin of each pixel; `limits` are squared distances in square metres.
pub(super) fn classes(
    truth: &Surface,
    pixel_m: (f64, f64),
    jump_m: f64,
    limits: &[f64],
) -> Vec<u16> {
    // Beyond the last limit nothing needs to be told apart.
    let reach = limits.last().copied().unwrap_or(0.0);
    let jump = |a: f32, b: f32| (f64::from(a) - f64::from(b)).abs() > jump_m;
    let known = |v: f32| v.is_finite();
    let jumps = |a: f32, b: f32| known(a) && known(b) && jump(a, b);
    let edges = squared_distances(truth, pixel_m, reach, jumps);
    let of = |edge: f64, value: f32| if known(value) { bin(limits, edge) } else { NO_CLASS };
    if truth.values.iter().all(|v| known(*v)) {
        return edges.iter().map(|edge| bin(limits, *edge)).collect();
    }
    let borders = squared_distances(truth, pixel_m, reach, |a, b| known(a) != known(b));
    let pixels = edges.iter().zip(&borders).zip(&truth.values);
    pixels
        .map(|((edge, border), value)| {
            let class = of(*edge, *value);
            if border < edge && bin(limits, *border) != class { NO_CLASS } else { class }
        })
        .collect()
}

/// Squared distance in square metres from each pixel's centre to the nearest side whose two pixels
/// are a `site`; infinite where there is none, or where it is `reach` (squared) or farther.
fn squared_distances(
    surface: &Surface,
    pixel_m: (f64, f64),
    reach: f64,
    site: impl Fn(f32, f32) -> bool,
) -> Vec<f64> {
    let (width, height) = surface.size();
    let mut out = vec![f64::INFINITY; width * height];
    if width == 0 || height == 0 {
        return out;
    }
    // Vertical distance in half pixels to the nearest site of the column: at even offsets for
    // sides between columns, odd ones for sides between rows. The column's slot 2x is for sides
    // south of its pixels, 2x + 1 for sides east of them.
    let slots = 2 * width;
    let far = 4 * height as u32 + 8;
    let mut halves = vec![far; slots * height];
    let values = &surface.values;
    for y in 0..height {
        let row = &values[y * width..(y + 1) * width];
        let line = &mut halves[y * slots..(y + 1) * slots];
        for x in 0..width - 1 {
            if site(row[x], row[x + 1]) {
                line[2 * x + 1] = 0;
            }
        }
        if y + 1 < height {
            let next = &values[(y + 1) * width..(y + 2) * width];
            for x in 0..width {
                if site(row[x], next[x]) {
                    line[2 * x] = 1;
                }
            }
        }
    }
    // Downwards: a side south of the pixel above is one half pixel away, not three.
    for y in 1..height {
        let (before, line) = halves.split_at_mut(y * slots);
        let before = &before[(y - 1) * slots..];
        for x in 0..width {
            let above = before[2 * x];
            let south = south_of(values, width, x, y - 1, &site);
            line[2 * x] = line[2 * x].min(if south { 1 } else { above.saturating_add(2) });
            line[2 * x + 1] = line[2 * x + 1].min(before[2 * x + 1] + 2);
        }
    }
    // Upwards.
    for y in (0..height - 1).rev() {
        let (line, after) = halves.split_at_mut((y + 1) * slots);
        let line = &mut line[y * slots..];
        for (own, below) in line.iter_mut().zip(&after[..slots]) {
            *own = (*own).min(below + 2);
        }
    }
    let mut envelope = Envelope::default();
    let (half_x, half_y) = (pixel_m.0 / 2.0, pixel_m.1 / 2.0);
    for (line, out) in halves.chunks_exact(slots).zip(out.chunks_exact_mut(width)) {
        envelope.clear();
        for (slot, halves) in line.iter().enumerate() {
            if *halves < far {
                let vertical = f64::from(*halves) * half_y;
                let lowest = vertical * vertical;
                if lowest < reach {
                    envelope.add(slot as f64 * half_x, lowest);
                }
            }
        }
        envelope.sample(out, pixel_m.0, reach);
    }
    out
}

fn south_of(
    values: &[f32],
    width: usize,
    x: usize,
    y: usize,
    site: &impl Fn(f32, f32) -> bool,
) -> bool {
    site(values[y * width + x], values[(y + 1) * width + x])
}

/// The lower envelope of the parabolas `(x - centre)^2 + lowest`.
#[derive(Default)]
struct Envelope {
    /// Centre and lowest value of each parabola that is seen from below, and where it begins.
    parts: Vec<(f64, f64, f64)>,
}

impl Envelope {
    fn clear(&mut self) {
        self.parts.clear();
    }

    /// Adds a parabola that lies east of all others.
    fn add(&mut self, centre: f64, lowest: f64) {
        let mut from = f64::NEG_INFINITY;
        while let Some(&(other, other_lowest, other_from)) = self.parts.last() {
            // Where both are equal.
            from = ((lowest - other_lowest) / (centre - other) + centre + other) / 2.0;
            if from > other_from {
                break;
            }
            self.parts.pop();
            from = f64::NEG_INFINITY;
        }
        self.parts.push((centre, lowest, from));
    }

    /// Values at 0, `step`, 2 `step`, ...; infinite from `reach` on.
    fn sample(&self, out: &mut [f64], step: f64, reach: f64) {
        let mut parts = self.parts.iter().copied().peekable();
        let Some(mut part) = parts.next() else { return };
        for (x, out) in out.iter_mut().enumerate() {
            let x = x as f64 * step;
            while let Some(next) = parts.next_if(|next| next.2 <= x) {
                part = next;
            }
            let value = (x - part.0) * (x - part.0) + part.1;
            if value < reach {
                *out = value;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Draw;
    use proptest::prelude::*;

    fn jump(a: f32, b: f32) -> bool {
        (a - b).abs() > 2.0
    }

    /// The middle of every jump, in pixels, compared with every pixel.
    fn brute(surface: &Surface, pixel_m: (f64, f64)) -> Vec<f64> {
        let (w, h) = surface.size();
        let at = |x: usize, y: usize| surface.values[y * w + x];
        let mut sites = Vec::new();
        for y in 0..h {
            for x in 0..w {
                if x + 1 < w && jump(at(x, y), at(x + 1, y)) {
                    sites.push((x as f64 + 0.5, y as f64));
                }
                if y + 1 < h && jump(at(x, y), at(x, y + 1)) {
                    sites.push((x as f64, y as f64 + 0.5));
                }
            }
        }
        (0..w * h)
            .map(|k| {
                let distance = |(x, y): &(f64, f64)| {
                    let dx = ((k % w) as f64 - x) * pixel_m.0;
                    let dy = ((k / w) as f64 - y) * pixel_m.1;
                    dx * dx + dy * dy
                };
                sites.iter().map(distance).fold(f64::INFINITY, f64::min)
            })
            .collect()
    }

    proptest! {
        #[test]
        fn distances_are_those_of_a_search_over_all_jumps(
            seed in any::<u64>(), width in 1_usize..40, height in 1_usize..40,
            px in 0.1_f64..2.0, py in 0.1_f64..2.0, share in 0.0_f64..0.3,
        ) {
            let mut draw = Draw::new(&[seed]);
            let values = (0..width * height)
                .map(|_| if draw.chance(share) { 9.0 } else { draw.unit() as f32 })
                .collect();
            let surface = Surface::new(width, height, values);
            let found = squared_distances(&surface, (px, py), f64::INFINITY, jump);
            for (found, expected) in found.iter().zip(brute(&surface, (px, py))) {
                prop_assert!(
                    (found - expected).abs() <= 1e-9 * expected.min(1e9) || *found == expected,
                    "{found} {expected}"
                );
            }
            // With a reach: the same below it, infinite from it on.
            let near = squared_distances(&surface, (px, py), 4.0, jump);
            for (near, all) in near.iter().zip(&found) {
                let expected = if *all < 4.0 { *all } else { f64::INFINITY };
                prop_assert_eq!(*near, expected);
            }
        }
    }

    #[test]
    fn a_wall_is_half_a_pixel_from_the_pixels_on_either_side() {
        let wall =
            Surface::new(60, 4, (0..240).map(|k| if k % 60 < 20 { 3.0 } else { 0.0 }).collect());
        let limits: Vec<f64> = [0.5, 1.0, 2.0, 4.0, 8.0].map(|v: f64| v * v).to_vec();
        let found = classes(&wall, (0.25, 0.25), 2.0, &limits);
        for (x, class) in found[..60].iter().enumerate() {
            let metres = (x as f64 - 19.5).abs() * 0.25;
            let expected = [0.5, 1.0, 2.0, 4.0, 8.0].iter().filter(|l| metres >= **l).count();
            assert_eq!(usize::from(*class), expected, "{x}");
        }
        // A step that is no jump: everything is far from any edge.
        let low = classes(&wall, (0.25, 0.25), 3.0, &limits);
        assert!(low.iter().all(|class| *class == 5));
    }

    #[test]
    fn a_pixel_next_to_missing_data_is_in_a_bin_only_where_that_is_certain() {
        let limits: Vec<f64> = [1.0, 4.0].map(|v: f64| v * v).to_vec();
        // A jump between columns 2 and 3, a hole at column 12, 1 m pixels.
        let mut values: Vec<f32> = (0..20).map(|x| if x < 3 { 9.0 } else { 0.0 }).collect();
        values[12] = f32::NAN;
        let found = classes(&Surface::new(20, 1, values), (1.0, 1.0), 2.0, &limits);
        let none = NO_CLASS;
        // Jump at 2.5, hole from 11.5 to 12.5.
        let expected =
            [1, 1, 0, 0, 1, 1, 1, 2, none, none, none, none, none, none, none, none, none, 2, 2, 2];
        assert_eq!(found, expected);
        // Nothing known at all, and infinities are as unknown.
        for value in [f32::NAN, f32::INFINITY] {
            let found = classes(&Surface::new(3, 3, vec![value; 9]), (1.0, 1.0), 2.0, &limits);
            assert!(found.iter().all(|class| *class == NO_CLASS));
        }
        assert!(classes(&Surface::new(0, 0, vec![]), (1.0, 1.0), 2.0, &limits).is_empty());
    }
}
