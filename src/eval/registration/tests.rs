use super::*;
use crate::random::{Draw, normal};

const SIZE: usize = 256;
const PIXEL_M: f64 = 0.25;

/// A house: west, south, east and north walls in metres from the north-west corner (y to the
/// south), height.
#[derive(Clone, Copy)]
struct House {
    x: (f64, f64),
    y: (f64, f64),
    height: f64,
}

struct City {
    houses: Vec<House>,
    slope: (f64, f64),
}

#[derive(Clone, Copy)]
struct View {
    shift: (f64, f64),
    lean: (f64, f64),
    zero: f64,
    blur_px: f64,
    noise_m: f64,
}

impl City {
    fn new(seed: u64, heights: (f64, f64)) -> Self {
        let mut draw = Draw::new(&[seed, 77]);
        let mut houses = Vec::new();
        // A house on most lots of a grid that goes beyond the image.
        for lot in 0..49 {
            if draw.chance(0.2) {
                continue;
            }
            let (left, top) = (f64::from(lot % 7) * 14.0 - 17.0, f64::from(lot / 7) * 14.0 - 17.0);
            let (x, y) = (left + draw.range(1.0, 4.0), top + draw.range(1.0, 4.0));
            houses.push(House {
                x: (x, x + draw.range(5.0, 9.0)),
                y: (y, y + draw.range(5.0, 9.0)),
                height: draw.range(heights.0, heights.1),
            });
        }
        Self { houses, slope: (draw.range(-0.06, 0.06), draw.range(-0.06, 0.06)) }
    }

    fn ground(&self, x: f64, y: f64) -> f64 {
        40.0 + self.slope.0 * x + self.slope.1 * y
    }

    fn sampled(&self, at: impl Fn(f64, f64) -> f64) -> Surface {
        let metres = |k: usize| (k as f64 + 0.5) * PIXEL_M;
        let values = (0..SIZE * SIZE).map(|k| at(metres(k % SIZE), metres(k / SIZE)) as f32);
        Surface::new(SIZE, SIZE, values.collect())
    }

    fn truth(&self) -> Surface {
        self.sampled(|x, y| {
            let over = self.houses.iter().filter(|h| h.holds(x, y)).map(|h| h.height);
            self.ground(x, y) + over.fold(0.0, f64::max)
        })
    }

    fn bare(&self) -> Surface {
        self.sampled(|x, y| self.ground(x, y))
    }

    /// What a network makes of the leaning image: each house as it is seen (a roof displaced, a wall
    /// between its foot and its roof), a little too low or too high, blurred, with errors that reach
    /// over metres and others that do not.
    fn prediction(&self, seed: u64, view: View) -> Surface {
        let mut draw = Draw::new(&[seed, 78]);
        let scale: Vec<f64> = self.houses.iter().map(|_| draw.range(0.7, 1.1)).collect();
        let sharp = self.sampled(|x, y| {
            let (x, y) = (x - view.shift.0, y - view.shift.1);
            let mut seen: f64 = 0.0;
            for (house, scale) in self.houses.iter().zip(&scale) {
                for k in (0..=16).rev() {
                    let height = house.height * f64::from(k) / 16.0;
                    if house.holds(x - view.lean.0 * height, y - view.lean.1 * height) {
                        seen = seen.max(height * scale);
                        break;
                    }
                }
            }
            self.ground(x, y) + seen
        });
        let blurred = blur(&sharp, view.blur_px);
        let white = |stream: u64, k: usize| normal(crate::random::key(&[seed, stream, k as u64]));
        let patches =
            Surface::new(SIZE, SIZE, (0..SIZE * SIZE).map(|k| white(1, k) as f32).collect());
        let patches = blur(&patches, 12.0);
        // A blur by 12 px leaves 1 / (2 sqrt(pi) 12) of white noise.
        let patch_scale = view.noise_m * 42.5;
        let values = (0..SIZE * SIZE).map(|k| {
            let noise = view.noise_m * white(2, k) + patch_scale * f64::from(patches.values[k]);
            (f64::from(blurred.values[k]) + noise - view.zero) as f32
        });
        Surface::new(SIZE, SIZE, values.collect())
    }
}

impl House {
    fn holds(&self, x: f64, y: f64) -> bool {
        x >= self.x.0 && x < self.x.1 && y >= self.y.0 && y < self.y.1
    }
}

fn blur(surface: &Surface, sigma: f64) -> Surface {
    if sigma == 0.0 {
        return surface.clone();
    }
    let radius = (3.0 * sigma).ceil() as i64;
    let weights: Vec<f64> = (-radius..=radius)
        .map(|k| libm::exp(-0.5 * (k as f64 / sigma) * (k as f64 / sigma)))
        .collect();
    let sum: f64 = weights.iter().sum();
    let pass = |from: &[f32], step: (i64, i64)| -> Vec<f32> {
        (0..SIZE * SIZE)
            .map(|k| {
                let (x, y) = ((k % SIZE) as i64, (k / SIZE) as i64);
                let last = SIZE as i64 - 1;
                let value = |(d, w): (usize, &f64)| {
                    let d = d as i64 - radius;
                    let (x, y) = ((x + d * step.0).clamp(0, last), (y + d * step.1).clamp(0, last));
                    w * f64::from(from[y as usize * SIZE + x as usize])
                };
                (weights.iter().enumerate().map(value).sum::<f64>() / sum) as f32
            })
            .collect()
    };
    let rows = pass(&surface.values, (1, 0));
    Surface::new(SIZE, SIZE, pass(&rows, (0, 1)))
}

const VIEW: View =
    View { shift: (0.0, 0.0), lean: (0.0, 0.0), zero: 12.5, blur_px: 3.0, noise_m: 0.6 };

fn whole(view: View, heights: (f64, f64), images: u64, with_ground: bool) -> Registration {
    let found: Vec<ImageRegistration> = (0..images)
        .filter_map(|seed| {
            let city = City::new(seed, heights);
            let ground = with_ground.then(|| city.bare());
            let prediction = city.prediction(seed, view);
            of_image(&prediction, &city.truth(), ground.as_ref(), (PIXEL_M, PIXEL_M))
        })
        .collect();
    assert!(found.len() as u64 >= images * 9 / 10, "{} of {images}", found.len());
    combine(&found).unwrap()
}

fn show(name: &str, found: &Registration) {
    let text =
        |e: &Estimate| format!("{:.3} +- {:.3} ({:.3})", e.value, e.standard_error, e.spread);
    let lean = |e: &Option<Estimate>| e.as_ref().map_or_else(|| "none".to_owned(), text);
    eprintln!(
        "{name}: {} images, east {}, north {}, vertical {}, lean {} / {}",
        found.images,
        text(&found.east_m),
        text(&found.north_m),
        text(&found.vertical_m),
        lean(&found.lean_east),
        lean(&found.lean_north)
    );
}

#[test]
fn shift_lean_and_zero_of_a_city_are_found() {
    let mut cases = Vec::new();
    for (shift, lean) in [
        ((0.0, 0.0), (0.0, 0.0)),
        ((3.0, -2.0), (0.0, 0.0)),
        ((-1.3, 0.4), (0.1, 0.05)),
        ((2.0, 2.2), (-0.2, 0.0)),
        ((-2.1, -2.1), (0.08, -0.15)),
    ] {
        for blur_px in [0.0, 3.0, 6.0] {
            cases.push(View { shift, lean, blur_px, ..VIEW });
        }
    }
    for view in cases {
        let found = whole(view, (4.0, 24.0), 20, true);
        let name = format!("shift {:?} lean {:?} blur {}", view.shift, view.lean, view.blur_px);
        show(&name, &found);
        if std::env::var_os("JUST_SHOW").is_some() {
            continue;
        }
        let near = |e: &Estimate, truth: f64, within: f64| (e.value - truth).abs() < within;
        assert!(near(&found.east_m, view.shift.0, 0.2), "{name}");
        assert!(near(&found.north_m, -view.shift.1, 0.2), "{name}");
        assert!(near(&found.vertical_m, view.zero, 0.5), "{name}");
        let (east, north) = (found.lean_east.unwrap(), found.lean_north.unwrap());
        assert!(near(&east, view.lean.0, 0.03), "{name}");
        assert!(near(&north, -view.lean.1, 0.03), "{name}");
    }
}
