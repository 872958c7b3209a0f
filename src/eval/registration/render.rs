//! The ground truth as an image with building lean would show it.

use super::super::surface::Surface;
use super::GROUND_RADIUS_M;
use super::fit::Parameters;

/// Prediction and ground truth at a coarser pixel size.
pub(super) struct Level {
    pub width: usize,
    pub height: usize,
    /// Size of a pixel, metres.
    pub pixel_m: (f64, f64),
    pub prediction: Vec<f32>,
    /// The ground truth, on smaller pixels, so that walls stay upright when roofs are displaced.
    model: Model,
    /// Pixels of the model in one of the level's.
    factor: (usize, usize),
}

/// Ground and what stands on it.
struct Model {
    width: usize,
    height: usize,
    pixel_m: (f64, f64),
    /// Height of the ground; NaN where truth or ground has none.
    ground: Vec<f32>,
    /// Height above it, at least 0.
    above: Vec<f32>,
    /// Largest of those.
    highest: f64,
}

/// A rendered ground truth, as soft as the prediction.
pub(super) struct Rendered {
    /// Heights, NaN where there are none.
    pub heights: Vec<f32>,
    /// Height above ground of each.
    pub above: Vec<f32>,
    /// What the heights lose for a metre per metre more of lean to the east and to the south.
    pub lean: Option<(Vec<f32>, Vec<f32>)>,
}

impl Level {
    /// Pixels of `model.0 x model.1` of the image's make one of the model's, `factor.0 x factor.1`
    /// of those one of the level's.
    pub fn new(
        prediction: &Surface,
        truth: &Surface,
        ground: Option<&Surface>,
        pixel_m: (f64, f64),
        model: (usize, usize),
        factor: (usize, usize),
    ) -> Self {
        let both = (model.0 * factor.0, model.1 * factor.1);
        let (width, height) = (truth.width / both.0, truth.height / both.1);
        let level_pixel = (pixel_m.0 * both.0 as f64, pixel_m.1 * both.1 as f64);
        let soft = smooth(
            reduce(&prediction.values, prediction.width, (width, height), both),
            width,
            PASSES,
        );
        let size = (width * factor.0, height * factor.1);
        Self {
            width,
            height,
            pixel_m: level_pixel,
            prediction: soft,
            model: Model::new(truth, ground, pixel_m, size, model),
            factor,
        }
    }

    /// The ground truth displaced by `shift + lean * height above ground`.
    pub fn render(&self, parameters: &Parameters, with_lean: bool) -> Rendered {
        let (heights, above) = self.model.displace((parameters.lean_x, parameters.lean_y));
        let size = (self.width, self.height);
        let coarse = |values: Vec<f32>| {
            let reduced = reduce(&values, self.model.width, size, self.factor);
            let (px, py) = self.pixel_m;
            shifted(&reduced, size, (parameters.x / px, parameters.y / py))
        };
        let (heights, above) = (coarse(heights), coarse(above));
        let pixel = self.pixel_m.0 * self.pixel_m.1;
        let more = (parameters.blur / (PASS_VARIANCE * pixel)).round() as usize;
        let passes = PASSES + more.min(MORE_PASSES);
        let soft = |values| smooth(values, self.width, passes);
        let lean = with_lean.then(|| {
            let (x, y) = self.lean_columns(&heights, &above);
            (soft(x), soft(y))
        });
        Rendered { heights: soft(heights), above: soft(above), lean }
    }

    /// Largest blur that is taken into account, square metres.
    pub fn most_blur(&self) -> f64 {
        MORE_PASSES as f64 * PASS_VARIANCE * self.pixel_m.0 * self.pixel_m.1
    }

    /// Gradient times the height above ground of what stands over the edge: that is how far an edge
    /// moves with the lean.
    fn lean_columns(&self, heights: &[f32], above: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (width, height) = (self.width, self.height);
        let mut x_column = vec![f32::NAN; heights.len()];
        let mut y_column = x_column.clone();
        let (over_x, over_y) = (0.5 / self.pixel_m.0 as f32, 0.5 / self.pixel_m.1 as f32);
        for y in 1..height.saturating_sub(1) {
            for k in y * width + 1..(y + 1) * width - 1 {
                let around = [k, k - 1, k + 1, k - width, k + width];
                let highest = around.into_iter().map(|k| above[k]).fold(0.0_f32, f32::max);
                x_column[k] = (heights[k + 1] - heights[k - 1]) * over_x * highest;
                y_column[k] = (heights[k + width] - heights[k - width]) * over_y * highest;
            }
        }
        (x_column, y_column)
    }
}

impl Model {
    fn new(
        truth: &Surface,
        ground: Option<&Surface>,
        pixel_m: (f64, f64),
        size: (usize, usize),
        factor: (usize, usize),
    ) -> Self {
        let pixel_m = (pixel_m.0 * factor.0 as f64, pixel_m.1 * factor.1 as f64);
        let truth = reduce(&truth.values, truth.width, size, factor);
        let mut ground = match ground {
            Some(ground) => reduce(&ground.values, ground.width, size, factor),
            None => lowest(&truth, size, pixel_m),
        };
        let above: Vec<f32> = truth
            .iter()
            .zip(&mut ground)
            .map(|(t, g)| {
                if t.is_nan() || g.is_nan() {
                    *g = f32::NAN;
                    return f32::NAN;
                }
                // Below its own ground, the surface is the ground.
                *g = g.min(*t);
                t - *g
            })
            .collect();
        let highest = above.iter().filter(|v| !v.is_nan()).fold(0.0_f32, |a, b| a.max(*b));
        let (width, height) = size;
        Self { width, height, pixel_m, ground, above, highest: f64::from(highest) }
    }

    /// Heights, and heights above ground, as they look with a lean. Every pixel is a column: its top
    /// is painted where the lean takes it, and below it its sides down to its lowest neighbour. Of
    /// what falls on one pixel the highest is seen.
    fn displace(&self, lean: (f64, f64)) -> (Vec<f32>, Vec<f32>) {
        let (lean_x, lean_y) = (lean.0 / self.pixel_m.0, lean.1 / self.pixel_m.1);
        let reach = lean_x.abs().max(lean_y.abs()) * self.highest;
        if reach < 0.5 {
            let heights = self.ground.iter().zip(&self.above).map(|(g, a)| g + a).collect();
            return (heights, self.above.clone());
        }
        // Heights at which a point moves by one pixel more.
        let steps = (reach.ceil() as usize).min(256);
        let fall = self.highest / steps as f64;
        let offsets: Vec<(isize, isize)> = (0..=2 * steps)
            .map(|k| {
                let h = k as f64 * fall / 2.0;
                ((lean_x * h).round() as isize, (lean_y * h).round() as isize)
            })
            .collect();
        // Never negative, so that adding a half rounds.
        let half = |h: f32| (f64::from(h) * (2.0 / fall) + 0.5) as usize;
        let (width, height) = (self.width as isize, self.height as isize);
        let mut above = vec![-1.0_f32; self.above.len()];
        let mut ground = self.ground.clone();
        for y in 0..height {
            for x in 0..width {
                let k = (y * width + x) as usize;
                let top = self.above[k];
                if top.is_nan() {
                    continue;
                }
                let last = half(top);
                if last == 0 {
                    // Ground, which no lean moves: most of an image.
                    if top > above[k] {
                        above[k] = top;
                        ground[k] = self.ground[k];
                    }
                    continue;
                }
                let neighbours = [
                    (x > 0).then(|| self.above[k - 1]),
                    (x + 1 < width).then(|| self.above[k + 1]),
                    (y > 0).then(|| self.above[k - self.width]),
                    (y + 1 < height).then(|| self.above[k + self.width]),
                ];
                // NaN is never the minimum.
                let foot = neighbours.into_iter().flatten().fold(top, f32::min);
                let first = half(foot);
                for step in (first..=last).rev() {
                    let (dx, dy) = offsets[step.min(2 * steps)];
                    let (to_x, to_y) = (x + dx, y + dy);
                    if to_x < 0 || to_y < 0 || to_x >= width || to_y >= height {
                        continue;
                    }
                    let to = (to_y * width + to_x) as usize;
                    let h = if step == last { top } else { (step as f64 * fall / 2.0) as f32 };
                    if h > above[to] {
                        above[to] = h;
                        ground[to] = self.ground[k];
                    }
                }
            }
        }
        // What nothing was painted on is bare ground, or as unknown as it was.
        for (painted, known) in above.iter_mut().zip(&self.above) {
            if *painted < 0.0 {
                *painted = if known.is_nan() { f32::NAN } else { 0.0 };
            }
        }
        (ground.iter().zip(&above).map(|(g, a)| g + a).collect(), above)
    }
}

/// Moved by a number of pixels to the east and south, bilinear; NaN outside and next to NaN.
fn shifted(values: &[f32], (width, height): (usize, usize), (dx, dy): (f64, f64)) -> Vec<f32> {
    let mut out = vec![f32::NAN; values.len()];
    let whole = |d: f64| (-d).floor();
    let (fx, fy) = ((-dx - whole(dx)) as f32, (-dy - whole(dy)) as f32);
    let (col0, row0) = (whole(dx) as isize, whole(dy) as isize);
    // Without a fraction the farther neighbour is not asked.
    let (next_col, next_row) = (usize::from(fx > 0.0), usize::from(fy > 0.0));
    for row in 0..height {
        let from = row as isize + row0;
        if from < 0 || from as usize + next_row >= height {
            continue;
        }
        let top = &values[from as usize * width..][..width];
        let bottom = &values[(from as usize + next_row) * width..][..width];
        for (col, out) in out[row * width..][..width].iter_mut().enumerate() {
            let from = col as isize + col0;
            if from < 0 || from as usize + next_col >= width {
                continue;
            }
            let (left, right) = (from as usize, from as usize + next_col);
            let above = top[left] + fx * (top[right] - top[left]);
            let below = bottom[left] + fx * (bottom[right] - bottom[left]);
            *out = above + fy * (below - above);
        }
    }
    out
}

/// Passes of the kernel 1 2 1 in both directions: a standard deviation of 1.4 pixels.
const PASSES: usize = 4;
/// Variance of one pass, square pixels.
const PASS_VARIANCE: f64 = 0.5;
/// Most passes that make the ground truth as soft as a prediction.
const MORE_PASSES: usize = 24;

/// Takes both sides to a common softness: predictions are blurred, and an edge that is sharp on one
/// side only leaves most of its difference where the other has no gradient. NaN spreads to the four
/// pixels around.
fn smooth(mut values: Vec<f32>, width: usize, passes: usize) -> Vec<f32> {
    if width < 3 || values.len() < 3 * width {
        return values;
    }
    let mut other = values.clone();
    for _ in 0..passes {
        for (line, out) in values.chunks_exact(width).zip(other.chunks_exact_mut(width)) {
            for (three, out) in line.windows(3).zip(&mut out[1..]) {
                *out = 0.25 * (three[0] + three[2]) + 0.5 * three[1];
            }
            out[0] = line[0];
            out[width - 1] = line[width - 1];
        }
        let last = other.len() - width;
        values[..width].copy_from_slice(&other[..width]);
        values[last..].copy_from_slice(&other[last..]);
        for k in width..last {
            values[k] = 0.25 * (other[k - width] + other[k + width]) + 0.5 * other[k];
        }
    }
    values
}

/// Means of blocks of pixels; NaN where half of them or more have no height.
fn reduce(
    values: &[f32],
    stride: usize,
    (width, height): (usize, usize),
    (fx, fy): (usize, usize),
) -> Vec<f32> {
    let mut out = Vec::with_capacity(width * height);
    let needed = fx * fy / 2;
    for row in 0..height {
        for col in 0..width {
            let (mut sum, mut count) = (0.0_f64, 0);
            for y in row * fy..(row + 1) * fy {
                let line = y * stride + col * fx;
                for value in &values[line..line + fx] {
                    if value.is_finite() {
                        sum += f64::from(*value);
                        count += 1;
                    }
                }
            }
            out.push(if count > needed {
                (sum / f64::from(count as u32)) as f32
            } else {
                f32::NAN
            });
        }
    }
    out
}

/// The lowest height within [`GROUND_RADIUS_M`] along both axes.
fn lowest(heights: &[f32], (width, height): (usize, usize), pixel_m: (f64, f64)) -> Vec<f32> {
    let radius = |pixel: f64| (GROUND_RADIUS_M / pixel).ceil() as usize;
    let mut rows = Vec::with_capacity(heights.len());
    for line in heights.chunks_exact(width.max(1)) {
        rows.extend(sliding_minimum(line.iter().copied(), width, radius(pixel_m.0)));
    }
    let mut out = vec![f32::NAN; heights.len()];
    for col in 0..width {
        let column = (0..height).map(|row| rows[row * width + col]);
        for (row, value) in
            sliding_minimum(column, height, radius(pixel_m.1)).into_iter().enumerate()
        {
            out[row * width + col] = value;
        }
    }
    out
}

/// The least of each value and its `radius` neighbours to both sides; NaN only among NaN. A queue
/// of candidates, each value entering and leaving once.
fn sliding_minimum(values: impl Iterator<Item = f32>, count: usize, radius: usize) -> Vec<f32> {
    let mut queue: std::collections::VecDeque<(usize, f32)> = std::collections::VecDeque::new();
    let mut out = Vec::with_capacity(count);
    let take = |queue: &mut std::collections::VecDeque<(usize, f32)>, at: usize| {
        while queue.front().is_some_and(|(place, _)| place + radius < at) {
            queue.pop_front();
        }
        queue.front().map_or(f32::NAN, |(_, value)| *value)
    };
    for (place, value) in values.enumerate() {
        if !value.is_nan() {
            while queue.back().is_some_and(|(_, last)| *last >= value) {
                queue.pop_back();
            }
            queue.push_back((place, value));
        }
        if place >= radius {
            let centre = place - radius;
            out.push(take(&mut queue, centre));
        }
    }
    while out.len() < count {
        let centre = out.len();
        out.push(take(&mut queue, centre));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sliding_minimum_is_the_minimum_of_each_window() {
        let nan = f32::NAN;
        let values = [3.0, nan, 7.0, 1.0, 9.0, 9.0, 9.0, nan, nan, nan, nan, 2.0];
        for radius in [0, 1, 2, 5, 20] {
            let found = sliding_minimum(values.iter().copied(), values.len(), radius);
            for (k, found) in found.iter().enumerate() {
                let window = &values[k.saturating_sub(radius)..(k + radius + 1).min(values.len())];
                let least = window.iter().copied().filter(|v| !v.is_nan()).reduce(f32::min);
                assert!(least.map_or(found.is_nan(), |least| least == *found), "{k} {radius}");
            }
        }
    }

    /// A block of 10 m on flat ground, lean east: the roof moves by lean * 10 m, the west wall shows.
    #[test]
    fn a_leaning_roof_hides_ground_on_one_side_and_shows_its_wall_on_the_other() {
        let at = |k: usize| if (8..16).contains(&(k % 32)) { 10.0 } else { 0.0 };
        let truth = Surface::new(32, 4, (0..128).map(at).collect());
        let ground = Surface::new(32, 4, vec![0.0; 128]);
        let model = Model::new(&truth, Some(&ground), (1.0, 1.0), (32, 4), (1, 1));
        let row: Vec<f32> = model.displace((0.4, 0.0)).0[32..64].to_vec();
        assert!(row[12..20].iter().all(|v| *v == 10.0), "{row:?}");
        assert!(row[..8].iter().chain(&row[20..]).all(|v| *v == 0.0), "{row:?}");
        // The wall's foot stays where it is, and it rises to the roof's edge.
        assert!(row[8..13].windows(2).all(|pair| pair[0] < pair[1]), "{row:?}");
        // Without lean: the surface itself, and a shift moves it.
        let same = model.displace((0.0, 0.0)).0;
        assert_eq!(same, truth.values);
        let moved = shifted(&same, (32, 4), (3.0, 0.0));
        assert!(moved[32..35].iter().all(|v| v.is_nan()));
        assert_eq!(moved[35..64], truth.values[32..61]);
    }
}
