//! Web Mercator at its limit, at the antimeridian, at zoom 0 and 23, and northings in 32 bits, each
//! naive form beside ours; `docs/numerics.md`.

use super::*;
use crate::oracle::{Real, degrees, nearest, off, pi, radians, real, relative};
use std::f64::consts::FRAC_PI_4;

/// Mercator's ordinate by its definition.
fn ordinate(lat_deg: f64) -> Real {
    radians(lat_deg).tan().asinh()
}

/// World pixels of a position by the definition, in a world of so many.
fn world_pixel(at: LonLat, world: f64) -> (Real, Real) {
    let half = real(0.5);
    let x = &half + real(at.lon_deg) / real(360.0);
    let y = half - ordinate(at.lat_deg) / (real(2.0) * pi());
    (x * real(world), y * real(world))
}

#[test]
fn mercator_keeps_its_digits_from_the_equator_to_its_limit() {
    let mut naive_at_equator = 0.0_f64;
    for lat in [1e-17, 1e-10, -1e-5, 0.25, 47.6, -66.5, 85.05, -85.05, MAX_LATITUDE_DEG] {
        let truth = ordinate(lat);
        let found = relative(mercator_of_latitude(lat), &truth);
        assert!(found < 4e-16, "{lat}: {found:e}");
        let naive = libm::log(libm::tan(FRAC_PI_4 + lat.to_radians() / 2.0));
        println!("latitude {lat:e}: naive {:.1e}, ours {found:.1e}", relative(naive, &truth));
        naive_at_equator = naive_at_equator.max(relative(naive, &truth));

        let y = nearest(&truth);
        let truth = degrees(&real(y).sinh().atan());
        let found = relative(latitude_of_mercator(y), &truth);
        assert!(found < 4e-16, "{lat}: {found:e} back");
        if lat == 1e-10 {
            let naive = (2.0 * libm::atan(libm::exp(y)) - 2.0 * FRAC_PI_4).to_degrees();
            println!("back: naive {:.1e}, ours {found:.1e}", relative(naive, &truth));
            assert!(relative(naive, &truth) > 1e-5, "{naive:e}");
        }
    }
    // Nothing but the rounding of pi / 4 is left of 1e-17 degrees.
    assert!(naive_at_equator > 100.0, "{naive_at_equator:e}");
    // Beyond the limit the map has no bound; on the ground the error stays.
    for lat in [86.0, 89.9, -89.999_999, 89.999_999_999_9] {
        let on_map = off(mercator_of_latitude(lat), &ordinate(lat)) * WGS84_A;
        let on_ground = on_map * libm::cos(lat.to_radians());
        assert!(on_ground < 2e-9, "{lat}: {on_ground:e}");
    }
}

#[test]
fn the_outermost_tiles_of_every_zoom_are_grids() {
    let (mut refused, mut all, mut beyond) = (0, 0, 0.0_f64);
    for zoom in 0..=23_u8 {
        let tiles = 1_u64 << zoom;
        let world = 256.0 * tiles as f64;
        for (column, row) in [(0, 0), (tiles - 1, 0), (0, tiles - 1), (tiles - 1, tiles - 1)] {
            let (x, y) = (column as f64 * 256.0 + 128.0, row as f64 * 256.0 + 128.0);
            let up = (real(1.0) - real(2.0 * y) / real(world)) * pi();
            let center = LonLat {
                lon_deg: 360.0 * x / world - 180.0,
                lat_deg: nearest(&degrees(&up.sinh().atan())),
            };
            // The rule as it stands in many programs: a corner below 0 is off the map.
            let north = world / 2.0
                - mercator_of_latitude(center.lat_deg) / (2.0 * std::f64::consts::PI) * world
                - 128.0;
            refused += u32::from(north < 0.0 || north + 256.0 > world);
            beyond = beyond.max(-north).max(north + 256.0 - world);
            all += 1;
            let grid = ImageGrid::new(center, zoom, 256, 256).expect("a tile of the map");
            let corner = grid.lonlat(PixelPoint { x: 0.0, y: 0.0 });
            assert!(corner.lon_deg >= -180.0 && corner.lat_deg <= MAX_LATITUDE_DEG + 1e-13);
            // A thousandth of a pixel farther is off the map.
            let pixel = 1e-3 * 360.0 / world * if column == 0 { -1.0 } else { 1.0 };
            let farther = LonLat { lon_deg: center.lon_deg + pixel, ..center };
            let found = ImageGrid::new(farther, zoom, 256, 256);
            assert!(matches!(found, Err(GridError::OffTheMap { edge: "antimeridian", .. })));
        }
    }
    println!("corner tiles: {refused} of {all} refused by the naive rule, {beyond:.1e} px beyond");
    assert!(refused >= all / 10, "{refused} of {all}");
}

#[test]
fn pixels_of_zoom_0_and_23_lie_where_48_digits_say() {
    let mut narrow: f64 = 0.0;
    for (zoom, lon_deg, lat_deg) in [
        (0, 0.0, 0.0),
        (23, -122.332_163, 47.610_335),
        (23, 179.999_9, 85.05),
        (23, -179.999_9, -85.05),
        (23, 1e-9, -1e-9),
    ] {
        let center = LonLat { lon_deg, lat_deg };
        let grid = ImageGrid::new(center, zoom, 256, 256).expect("a grid");
        let world = (256_u64 << zoom) as f64;
        let (x, y) = world_pixel(center, world);
        for (px, py) in [(0.0, 0.0), (0.5, 255.5), (128.0, 128.0), (200.25, 3.75), (256.0, 256.0)] {
            let found = grid.lonlat(PixelPoint { x: px, y: py });
            let truth = (&x + real(px - 128.0), &y + real(py - 128.0));
            // Where the position that was found lies, in pixels.
            let (fx, fy) = world_pixel(found, world);
            let miss = [nearest(&(fx - &truth.0)), nearest(&(fy - &truth.1))];
            // A few steps of a double in a world of that many pixels: 2.7e-8 m at zoom 23.
            let bound = 3.0 * f64::EPSILON * world;
            assert!(miss.iter().all(|m| m.abs() <= bound), "zoom {zoom}: {miss:?} px");
            let back = grid.pixel(found);
            assert!((back.x - px).abs() <= bound && (back.y - py).abs() <= bound);
            let in_f32 = f64::from(nearest(&truth.1) as f32);
            narrow = narrow.max(off(in_f32, &truth.1));
        }
    }
    // A world of 2^31 pixels has steps of up to 128 pixels in f32.
    println!("world pixels of zoom 23 in f32: {narrow} px off");
    assert!(narrow > 10.0, "{narrow} px");
}

#[test]
fn northings_in_f32_step_by_half_a_metre() {
    // A tenth of a metre per pixel near Seattle, UTM zone 10 north.
    let grid = GeoTransform::north_up(549_000.3, 5_272_000.7, 0.1, 0.1);
    let (mut narrow, mut ours) = (0.0_f64, 0.0_f64);
    let mut distinct: Vec<f32> = Vec::new();
    for row in 0..1000 {
        let y = f64::from(row) + 0.5;
        let truth = real(grid.0[3]) + real(y) * real(grid.0[5]);
        let in_f32 = grid.0[3] as f32 + y as f32 * grid.0[5] as f32;
        distinct.push(in_f32);
        narrow = narrow.max(off(f64::from(in_f32), &truth));
        ours = ours.max(off(grid.to_projected(PixelPoint { x: 0.5, y }).y, &truth));
    }
    distinct.dedup();
    println!("1000 rows: {} places in f32, off {narrow} m, ours {ours:.1e} m", distinct.len());
    assert_eq!(distinct.len(), 201, "places for 1000 rows");
    assert!(narrow > 0.4, "{narrow}");
    assert!(ours < 1e-9, "{ours:e}");
}
