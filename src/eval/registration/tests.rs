use super::*;
use crate::random::{Draw, normal};
use rayon::prelude::*;

pub(super) const SIZE: usize = 256;
pub(super) const PIXEL_M: f64 = 0.25;

/// A house: west, south, east and north walls in metres from the north-west corner (y to the
/// south), height.
#[derive(Clone, Copy)]
struct House {
    x: (f64, f64),
    y: (f64, f64),
    height: f64,
}

pub(super) struct City {
    houses: Vec<House>,
    slope: (f64, f64),
}

#[derive(Clone, Copy)]
pub(super) struct View {
    pub(super) shift: (f64, f64),
    pub(super) lean: (f64, f64),
    pub(super) zero: f64,
    pub(super) blur_px: f64,
    pub(super) noise_m: f64,
}

impl City {
    pub(super) fn new(seed: u64, heights: (f64, f64)) -> Self {
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

    pub(super) fn truth(&self) -> Surface {
        self.sampled(|x, y| {
            let over = self.houses.iter().filter(|h| h.holds(x, y)).map(|h| h.height);
            self.ground(x, y) + over.fold(0.0, f64::max)
        })
    }

    pub(super) fn bare(&self) -> Surface {
        self.sampled(|x, y| self.ground(x, y))
    }

    /// What a network makes of the leaning image: each house as it is seen (a roof displaced, a wall
    /// between its foot and its roof), a little too low or too high, blurred, with errors that reach
    /// over metres and others that do not.
    pub(super) fn prediction(&self, seed: u64, view: View) -> Surface {
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
        // Errors alike over some 4 m, by interpolation between random numbers 16 pixels apart.
        let patch = |k: usize| {
            let (x, y) = ((k % SIZE) as f64 / 16.0, (k / SIZE) as f64 / 16.0);
            let at = |dx: usize, dy: usize| white(1, (y as usize + dy) * 64 + x as usize + dx);
            let (fx, fy) = (x.fract(), y.fract());
            let mix = |a: f64, b: f64, t: f64| a + t * (b - a);
            mix(mix(at(0, 0), at(1, 0), fx), mix(at(0, 1), at(1, 1), fx), fy)
        };
        let values = (0..SIZE * SIZE).map(|k| {
            let noise = view.noise_m * (white(2, k) + patch(k));
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

pub(super) const VIEW: View =
    View { shift: (0.0, 0.0), lean: (0.0, 0.0), zero: 12.5, blur_px: 3.0, noise_m: 0.6 };

fn whole(view: View, heights: (f64, f64), images: u64, with_ground: bool) -> Registration {
    let found: Vec<ImageRegistration> = (0..images)
        .into_par_iter()
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

/// Twenty images: what is stated has to hold, and the errors stated have to mean something.
#[test]
fn shift_lean_and_zero_of_a_city_are_found() {
    for (shift, lean, blur_px) in [
        ((0.0, 0.0), (0.0, 0.0), 3.0),
        ((3.0, -2.0), (0.0, 0.0), 0.0),
        ((-1.3, 0.4), (0.1, 0.05), 5.0),
        ((2.0, 2.2), (-0.2, 0.0), 3.0),
    ] {
        let view = View { shift, lean, blur_px, ..VIEW };
        let found = whole(view, (4.0, 24.0), 20, true);
        let name = format!("shift {shift:?} lean {lean:?} blur {blur_px}");
        show(&name, &found);
        let (east, north) = (found.lean_east.unwrap(), found.lean_north.unwrap());
        for (estimate, truth, within) in [
            (found.east_m, shift.0, 0.2),
            (found.north_m, -shift.1, 0.2),
            // Roofs that are 10 % too low on average are part of the median.
            (found.vertical_m, view.zero, 0.5),
            (east, lean.0, 0.03),
            (north, -lean.1, 0.03),
        ] {
            assert!((estimate.value - truth).abs() < within, "{name}: {estimate:?} {truth}");
            assert!(estimate.standard_error > 0.0 && estimate.standard_error < within, "{name}");
        }
        if lean == (0.0, 0.0) {
            for lean in [east, north] {
                assert!(lean.value.abs() < 3.0 * lean.standard_error + 0.003, "{name}: {lean:?}");
            }
        }
    }
}

#[test]
fn without_bare_earth_the_lowest_height_around_serves() {
    let view = View { shift: (1.0, -2.0), lean: (0.1, 0.0), ..VIEW };
    let found = whole(view, (4.0, 24.0), 12, false);
    show("without ground", &found);
    assert!((found.east_m.value - 1.0).abs() < 0.3 && (found.north_m.value - 2.0).abs() < 0.3);
    assert!((found.lean_east.unwrap().value - 0.1).abs() < 0.03);
}

#[test]
fn bare_terrain_has_no_lean_and_no_houses_do_not_matter() {
    let hills = |dx: f64, zero: f64| {
        let values = (0..SIZE * SIZE).map(|k| {
            let (x, y) = ((k % SIZE) as f64 * PIXEL_M - dx, (k / SIZE) as f64 * PIXEL_M);
            let z = 3.0 * libm::sin(x / 4.0) * libm::cos(y / 5.0) + 2.0 * libm::sin((x + y) / 3.0);
            (z - zero) as f32
        });
        Surface::new(SIZE, SIZE, values.collect())
    };
    let truth = hills(0.0, 0.0);
    let found = of_image(&hills(1.5, 7.0), &truth, Some(&truth), (PIXEL_M, PIXEL_M)).unwrap();
    assert!((found.east_m - 1.5).abs() < 0.02 && found.north_m.abs() < 0.02, "{found:?}");
    assert!((found.vertical_m - 7.0).abs() < 0.1 && found.lean.is_none(), "{found:?}");
    let whole = combine(&[found]).unwrap();
    assert!(whole.lean_east.is_none() && whole.east_m.standard_error.is_nan());
}

#[test]
fn what_says_nothing_gives_nothing() {
    let city = City::new(1, (4.0, 20.0));
    let (truth, bare) = (city.truth(), city.bare());
    let prediction = city.prediction(1, VIEW);
    let pixel = (PIXEL_M, PIXEL_M);
    let none = |p: &Surface, t: &Surface| {
        assert!(of_image(p, t, None, pixel).is_none());
        assert!(of_image(p, t, Some(&bare), pixel).is_none());
    };
    let flat = Surface::new(SIZE, SIZE, vec![3.0; SIZE * SIZE]);
    none(&flat, &truth);
    none(&prediction, &flat);
    none(&Surface::empty(SIZE, SIZE), &truth);
    none(&prediction, &Surface::empty(SIZE, SIZE));
    none(&Surface::new(SIZE, SIZE, vec![f32::INFINITY; SIZE * SIZE]), &truth);
    // Nothing but errors, wide ones and narrow ones.
    let nothing = City { houses: Vec::new(), slope: (0.0, 0.0) };
    none(&nothing.prediction(99, View { noise_m: 5.0, ..VIEW }), &truth);
    let noise = (0..SIZE * SIZE).map(|k| normal(crate::random::key(&[5, k as u64])) as f32);
    none(&Surface::new(SIZE, SIZE, noise.collect()), &truth);
    // Sizes: other, too small, none; pixels without a size.
    none(&Surface::new(2, 2, vec![0.0; 4]), &truth);
    for (w, h) in [(0, 0), (1, 1), (3, 200), (20, 20)] {
        let small = Surface::new(w, h, (0..w * h).map(|k| (k % 7) as f32).collect());
        assert!(of_image(&small, &small, None, pixel).is_none(), "{w} x {h}");
    }
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(of_image(&prediction, &truth, Some(&bare), (bad, PIXEL_M)).is_none());
    }
    assert!(combine(&[]).is_none());
}

#[test]
fn holes_are_left_out_of_the_estimate() {
    let city = City::new(3, (4.0, 20.0));
    let view = View { shift: (2.0, -1.0), ..VIEW };
    let (mut truth, mut prediction) = (city.truth(), city.prediction(3, view));
    for k in 0..SIZE * SIZE {
        if k % SIZE > 200 {
            truth.values[k] = f32::NAN;
        }
        if k / SIZE < 40 {
            prediction.values[k] = f32::NEG_INFINITY;
        }
    }
    let found = of_image(&prediction, &truth, Some(&city.bare()), (PIXEL_M, PIXEL_M)).unwrap();
    assert!((found.east_m - 2.0).abs() < 0.6 && (found.north_m - 1.0).abs() < 0.6, "{found:?}");
}

#[test]
fn outliers_do_not_move_the_mean_and_its_error_is_that_of_the_rest() {
    let image = |east_m: f64| ImageRegistration {
        east_m,
        north_m: 0.0,
        vertical_m: 1.0,
        lean: None,
        correlation: 0.9,
    };
    let mut images: Vec<_> = [1.0, 1.1, 0.9, 1.05, 0.95].map(image).to_vec();
    let clean = combine(&images).unwrap();
    images.push(image(40.0));
    let found = combine(&images).unwrap();
    assert_eq!(found.images, 6);
    assert!((found.east_m.value - 1.0).abs() < 1e-12);
    // numpy: std([1, 1.1, .9, 1.05, .95], ddof=1) / sqrt(5)
    assert!((found.east_m.standard_error - 0.035_355_339_059).abs() < 1e-9);
    assert!((clean.east_m.spread - 1.4826 * 0.05).abs() < 1e-12);
    assert_eq!(found.north_m, Estimate { value: 0.0, standard_error: 0.0, spread: 0.0 });
}
