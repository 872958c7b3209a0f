use super::*;

fn values(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

/// A panorama whose colours say the direction: red east, green north, blue up.
fn compass(width: usize, height: usize) -> Image8 {
    let mut data = Vec::new();
    for row in 0..height {
        for column in 0..width {
            let right = (column as f64 / (width - 1) as f64 - 0.5) * TAU;
            let down = (row as f64 / (height - 1) as f64 - 0.5) * PI;
            let level = libm::cos(down);
            let direction = [level * libm::sin(right), level * libm::cos(right), -libm::sin(down)];
            data.extend(direction.map(|value| ((value + 1.0) * 127.5).round() as u8));
        }
    }
    Image8 { width, height, channels: 3, data }
}

#[test]
fn perspective_views_see_what_their_rays_look_at() {
    let panorama = compass(512, 256);
    for (yaw, pitch) in [(0.0, 0.0), (90.0, 0.0), (-140.0, 15.0), (179.0, -20.0)] {
        let look = Look { field_of_view: [90.0, 120.0], pitch, yaw };
        for (side, antialias) in [(64, false), (24, true)] {
            let view = cut(&panorama, &look, side, antialias);
            let camera = look.camera(side, 1, [0.0; 3], 0.8);
            let mut worst = 0.0_f64;
            for row in 0..side {
                for column in 0..side {
                    let [x, y, z] = camera.ray(row, column, 0.8).direction;
                    let pixel = &view.data[(row * side + column) * 3..][..3];
                    for (value, wanted) in pixel.iter().zip([x, -y, z]) {
                        worst = worst.max((f64::from(*value) / 127.5 - 1.0 - wanted).abs());
                    }
                }
            }
            // A byte is 0.008; shrinking moves pixels by parts of one.
            let limit = if antialias { 0.06 } else { 0.013 };
            assert!(worst < limit, "yaw {yaw}, pitch {pitch}, {side}: {worst}");
        }
    }
}

#[test]
fn cubic_taps_sum_to_one_and_wrap() {
    for position in [0.0, 0.3, 6.999, 7.0, 3.5] {
        let taps = taps(position, 8);
        let sum: f64 = taps.iter().map(|tap| tap.1).sum();
        let at = taps.map(|tap| tap.0);
        assert!((sum - 1.0).abs() < 1e-12 && at.iter().all(|at| *at < 8), "{position}: {taps:?}");
    }
    assert_eq!(taps(7.5, 8).map(|tap| tap.0), [6, 7, 0, 1]);
    // OpenCV's weights at one half.
    assert_eq!(taps(2.5, 8).map(|tap| tap.1), [-0.09375, 0.59375, 0.59375, -0.09375]);
}

#[test]
fn halving_is_the_antialiased_one() {
    let device = Device::flex();
    let row = [1.0_f32, 2.0, 4.0, 8.0, 16.0, 32.0];
    let map = Tensor::<1>::from_floats(row, &device).reshape([1, 1, 1, 6]).repeat_dim(2, 4);
    let half = values(halved(map));
    // PyTorch 2: interpolate(x, scale_factor=0.5, mode="bilinear", antialias=True).
    let first = (3.0 * 1.0 + 3.0 * 2.0 + 4.0) / 7.0;
    let middle = (2.0 + 3.0 * 4.0 + 3.0 * 8.0 + 16.0) / 8.0;
    let last = (8.0 + 3.0 * 16.0 + 3.0 * 32.0) / 7.0;
    for (found, wanted) in half.iter().zip([first, middle, last, first, middle, last]) {
        assert!((found - wanted).abs() < 1e-5, "{found} {wanted}");
    }
}

#[test]
fn labels_keep_what_is_unknown() {
    let mut data: Vec<f32> = (0..64).map(|k| k as f32 / 63.0).collect();
    assert_eq!(label(&Grid::new(1, 8, 8, data.clone()), 8).expect("a label").data, data);
    data[9] = f32::NAN;
    let small = label(&Grid::new(1, 8, 8, data), 4).expect("a label").data;
    assert!(small[0].is_nan() && small[15].is_finite());
    assert!((small[15] - 58.0 / 63.0).abs() < 0.05, "{}", small[15]);
    assert!(label(&Grid::new(2, 1, 1, vec![0.0; 2]), 4).is_err());
}

fn example() -> Example {
    let panorama = compass(64, 32);
    let sky = (0..64 * 32).map(|k| if k < 64 * 10 { 255 } else { 0 }).collect();
    Example {
        name: "one".into(),
        satellite: Image8 { width: 20, height: 20, channels: 3, data: vec![100; 1200] },
        truth: None,
        street: Some(Street {
            panorama,
            sky: Image8 { width: 64, height: 32, channels: 1, data: sky },
            position: [0.1, 0.2, -0.85],
        }),
        depth: None,
    }
}

#[test]
fn targets_have_the_sizes_of_their_views() {
    let views = ViewSettings::small();
    let look = Look { field_of_view: [90.0; 2], pitch: 0.0, yaw: 0.0 };
    for enlarged in [1, 2] {
        let sizes = Sizes { views: &views, input: 32, enlarged };
        let targets = Targets::new(&example(), sizes, look).expect("targets");
        let street = targets.street.expect("a street");
        assert_eq!((targets.input.width, targets.satellite.width), (32, 64));
        assert_eq!((street.panorama.width, street.panorama.height), (64 * enlarged, 16 * enlarged));
        assert_eq!((street.sky.width, street.sky.height), (64, 16));
        assert_eq!(street.perspective.width, 32 * enlarged);
        // Ten of 32 rows are sky, and its mean colour points up.
        assert_eq!(street.sky.data.iter().sum::<f32>(), 64.0 * 5.0);
        assert!(street.sky_mean[2] > 0.8 && (street.sky_mean[0] - 0.5).abs() < 0.02);
        assert_eq!(street.histogram.len(), 270);
    }
}

#[test]
fn pictures_that_do_not_fit_are_named() {
    let views = ViewSettings::small();
    let sizes = Sizes { views: &views, input: 32, enlarged: 1 };
    let look = Look { field_of_view: [90.0; 2], pitch: 0.0, yaw: 0.0 };
    let mut wrong = example();
    if let Some(street) = &mut wrong.street {
        street.sky = Image8 { width: 2, height: 2, channels: 1, data: vec![0; 4] };
    }
    let error = Targets::new(&wrong, sizes, look).expect_err("another size").to_string();
    assert!(error.contains("one") && error.contains("2 x 2"), "{error}");
    let mut grey = example();
    grey.satellite = Image8 { width: 2, height: 2, channels: 1, data: vec![0; 4] };
    assert!(Targets::new(&grey, sizes, look).is_err());
}
