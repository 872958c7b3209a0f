use super::*;
use crate::raster::colour::HEIGHT;
use image::RgbaImage;
use proptest::prelude::*;

fn draw(heights: &[f32], width: usize, height: usize, pixel_m: f64) -> RgbaImage {
    let bytes = hillshade_png(heights, width, height, pixel_m);
    let picture = image::load_from_memory(&bytes).expect("a PNG");
    assert!(matches!(picture.color(), image::ColorType::Rgba8));
    picture.into_rgba8()
}

#[test]
fn a_plane_has_the_light_of_its_normal_everywhere() {
    let (width, height, pixel_m) = (7, 5, 0.25);
    for (east, north) in [(0.0, 0.0), (0.5, 0.0), (-0.7, 0.3), (-0.5, 0.5), (3.0, -3.0)] {
        let mut heights: Vec<f32> = (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as f64, (i / width) as f64);
                (pixel_m * (east * x - north * y)) as f32
            })
            .collect();
        heights[2 * width + 3] = f32::NAN;
        // The angle between normal and sun, by angles instead of the vectors in the code.
        let slope = libm::atan(libm::hypot(east, north));
        let aspect = libm::atan2(-east, -north);
        let (zenith, azimuth) = (45.0_f64.to_radians(), 315.0_f64.to_radians());
        let cosine = libm::cos(zenith) * libm::cos(slope)
            + libm::sin(zenith) * libm::sin(slope) * libm::cos(azimuth - aspect);
        let expected = AMBIENT + (1.0 - AMBIENT) * cosine.max(0.0) / libm::cos(zenith);
        let rows: Vec<&[f32]> = heights.chunks(width).collect();
        let row = |y: Option<usize>| y.and_then(|y| rows.get(y)).copied().unwrap_or_default();
        for (y, &line) in rows.iter().enumerate() {
            for (x, &z) in line.iter().enumerate() {
                if z.is_finite() {
                    let around = [row(y.checked_sub(1)), line, row(Some(y + 1))];
                    let light = Light::new(pixel_m).on(&window(around, x, z));
                    assert!(
                        (light - expected).abs() < 1e-5,
                        "{east} {north} ({x}, {y}): {light} {expected}"
                    );
                }
            }
        }
    }
}

#[test]
fn walls_towards_the_north_west_are_light_and_those_away_from_it_dark() {
    let mut heights = vec![0.0_f32; 100];
    for y in 3..7 {
        heights[y * 10 + 3..y * 10 + 7].fill(5.0);
    }
    let picture = draw(&heights, 10, 10, 0.5);
    let brightness =
        |x, y| picture.get_pixel(x, y).0[..3].iter().map(|&v| u32::from(v)).sum::<u32>();
    let (flat, lit, dark) = (brightness(0, 0), brightness(2, 2), brightness(7, 7));
    assert!(lit > flat && flat > dark, "{lit} {flat} {dark}");
}

#[test]
fn surfaces_without_relief_have_the_middle_colour() {
    let middle = colour::table::<STEPS>(&HEIGHT)[STEPS / 2];
    for (width, height) in [(1, 1), (3, 2), (1, 9)] {
        let picture = draw(&vec![12.5; width * height], width, height, 0.1);
        assert!(picture.pixels().all(|p| p.0[..3] == middle && p.0[3] == 255));
    }
}

#[test]
fn what_has_no_data_is_transparent() {
    let picture = draw(&[f32::NAN, 1.0, f32::INFINITY, f32::NEG_INFINITY, 2.0], 3, 2, 0.1);
    let alpha: Vec<u8> = picture.pixels().map(|p| p.0[3]).collect();
    assert_eq!(alpha, [0, 255, 0, 0, 255, 0]);
    assert!(draw(&[f32::NAN; 6], 3, 2, 0.1).pixels().all(|p| p.0 == [0; 4]));
    for (width, height) in [(0, 0), (0, 4), (4, 0)] {
        let picture = draw(&[1.0; 4], width, height, 0.1);
        assert_eq!(
            (picture.dimensions().0.min(9), picture.get_pixel(0, 0).0),
            (width.max(1) as u32, [0; 4])
        );
    }
}

#[test]
fn without_a_pixel_size_there_is_colour_and_no_light() {
    let heights: Vec<f32> = (0..101).map(|z| z as f32).collect();
    for pixel_m in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let picture = draw(&heights, 101, 1, pixel_m);
        assert_eq!(picture.get_pixel(2, 0).0[..3], HEIGHT[0]);
        assert_eq!(picture.get_pixel(98, 0).0[..3], HEIGHT[16]);
        assert_eq!(picture.get_pixel(50, 0).0[..3], colour::table::<STEPS>(&HEIGHT)[STEPS / 2]);
    }
}

proptest! {
    #[test]
    fn percentiles_are_those_of_the_sorted_values(
        values in prop::collection::vec(-1e6_f32..1e6, 1..200),
        share in 0.0..=1.0_f64,
    ) {
        let mut sorted = values.clone();
        sorted.sort_by(f32::total_cmp);
        let rank = share * (sorted.len() - 1) as f64;
        let low = f64::from(sorted[rank.floor() as usize]);
        let high = f64::from(sorted[rank.ceil() as usize]);
        let expected = low + (rank - rank.floor()) * (high - low);
        prop_assert_eq!(percentile(&mut values.clone(), share), expected);
    }

    #[test]
    fn every_grid_gives_a_picture_of_its_size(
        width in 1_usize..12,
        height in 1_usize..12,
        pool in prop::collection::vec(
            prop_oneof![
                Just(f32::NAN), Just(f32::MAX), Just(f32::MIN), Just(f32::INFINITY), Just(-0.0), -1e3_f32..1e3
            ],
            0..150,
        ),
        pixel_m in prop_oneof![Just(f64::MIN_POSITIVE), Just(f64::MAX), 1e-3..1e3_f64],
    ) {
        let picture = draw(&pool, width, height, pixel_m);
        prop_assert_eq!(picture.dimensions(), (width as u32, height as u32));
        for (i, pixel) in picture.pixels().enumerate() {
            let valid = pool.get(i).is_some_and(|z| z.is_finite());
            prop_assert_eq!(pixel.0[3], if valid { 255 } else { 0 });
        }
    }
}
