use super::*;
use crate::scene::object::Epoch;
use crate::scene::{Options, pixels::PixelPositions};

const SCENES: RandomScenes = RandomScenes { seed: 7 };

#[test]
fn a_sample_is_the_scene_at_the_pixel_centres() {
    for index in 0..24 {
        let sample = SCENES.sample(index, 24, 64.0).expect("a sample");
        let scene = Scene::new(SCENES.spec_for(index, 64.0), &Options::default()).expect("a scene");
        let pixels = PixelPositions::square(&scene.frame, 24, [0.0; 2], 64.0);
        let mut mean = 0.0;
        for i in 0..24 * 24 {
            let [x, y] = pixels.row(i / 24)[i % 24];
            let surface = scene.surface(Epoch::Lidar, x, y);
            mean += scene.ground(x, y) / (24.0 * 24.0);
            assert_eq!(sample.surface[i], (surface.height - sample.datum) as f32);
            assert_eq!(sample.ground[i], (scene.ground(x, y) - sample.datum) as f32);
            let class = match scene.class(Epoch::Lidar, x, y) {
                crate::scene::object::Class::Building => 1,
                crate::scene::object::Class::Tree => 2,
                crate::scene::object::Class::Water => 3,
                _ => 0,
            };
            assert_eq!(sample.classes[i], class);
        }
        assert!((mean - sample.datum).abs() < 1e-9);
    }
}

#[test]
fn true_north_is_up_and_a_pixel_is_a_ground_length() {
    let scene = Scene::new(SCENES.spec(3), &Options::default()).expect("a scene");
    let pixels = PixelPositions::square(&scene.frame, 65, [0.0; 2], 65.0);
    let [x, y] = pixels.row(32)[32];
    assert!(libm::hypot(x, y) < 1e-9);
    let [top, right] = [pixels.row(0)[32], pixels.row(32)[64]];
    let at = |p: [f64; 2]| scene.frame.to_lonlat(p[0], p[1]).expect("inverse");
    let (middle, top, right) = (at([0.0, 0.0]), at(top), at(right));
    // 32 m of meridian and of parallel on the ellipsoid near 47.6 degrees north: 111 176 m and
    // 75 190 m a degree, to half a per cent over the city.
    assert!(((top.lat_deg - middle.lat_deg) * 111_176.0 - 32.0).abs() < 0.05);
    assert!((top.lon_deg - middle.lon_deg).abs() * 75_190.0 < 0.01);
    assert!(((right.lon_deg - middle.lon_deg) * 75_190.0 - 32.0).abs() < 0.2);
    assert!((right.lat_deg - middle.lat_deg).abs() * 111_176.0 < 0.01);
}

#[test]
fn every_kind_occurs_and_every_spec_is_one_that_a_file_may_hold() {
    let mut seen = std::collections::BTreeMap::new();
    for index in 0..600 {
        *seen.entry(SCENES.kind(index)).or_insert(0_u32) += 1;
        let spec = SCENES.spec_for(index, 130.0);
        spec.check(std::path::Path::new("random")).expect("a valid scene");
    }
    for kind in Kind::ALL {
        let expected = kind.share() as f64 * 6.0;
        let found = f64::from(seen[&kind]);
        assert!((found - expected).abs() < 5.0 * expected.sqrt(), "{kind}: {found}");
    }
    assert_eq!(Kind::ALL.iter().map(|k| k.share()).sum::<u64>(), 100);
}

#[test]
fn the_same_bytes_for_any_number_of_threads() {
    let sample = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| SCENES.sample(11, 96, 64.0).expect("a sample"))
    };
    let one = sample(1);
    assert_eq!(one, sample(3));
    assert_ne!(one, SCENES.sample(12, 96, 64.0).expect("a sample"));
    assert_ne!(one.rgb, RandomScenes { seed: 8 }.sample(11, 96, 64.0).expect("a sample").rgb);
}

#[test]
fn a_crop_is_a_part_of_the_whole() {
    let scene = SCENES.scene(4, 130.0).expect("a scene");
    let whole = Sample::new(&scene, Kind::Mixed, 130, &Crop::centred(130.0));
    let crop = Crop { east: 20.0, north: -13.0, metres: 50.0 };
    let part = Sample::new(&scene, Kind::Mixed, 50, &crop);
    let mut worst = 0.0_f64;
    for row in 0..50 {
        for column in 0..50 {
            // Middle of the part: 85 pixels from the west, 78 from the north.
            let i = (row + 78 - 25) * 130 + column + 85 - 25;
            let there = f64::from(whole.surface[i]) + whole.datum;
            let here = f64::from(part.surface[row * 50 + column]) + part.datum;
            worst = worst.max((there - here).abs());
        }
    }
    assert!(worst < 1e-5, "{worst}");
    // Its middle, and its north-eastern corner.
    let middle = crop.local(&scene.frame, [0.0, 0.0]);
    let corner = crop.local(&scene.frame, [-1.0, 1.0]);
    assert_eq!(middle, scene.frame.from_ground([20.0, -13.0]));
    assert_eq!(corner, scene.frame.from_ground([45.0, 12.0]));
}

#[test]
fn a_street_view_stands_free_and_its_sky_is_where_no_ray_ends() {
    let (mut on_street, mut found) = (0, 0);
    for index in 0..30 {
        let Some(street) = SCENES.street(index, 64.0, None, 32).expect("a scene") else {
            continue;
        };
        found += 1;
        on_street += u32::from(street.on_street);
        assert!(street.position.iter().all(|p| p.abs() <= 1.0));
        let scene = SCENES.scene(index, 64.0).expect("a scene");
        let [x, y] = Crop::centred(64.0).local(&scene.frame, street.position);
        assert!(!scene.terrain.at(x, y).water);
        if street.on_street {
            assert!(scene.is_street(x, y));
        }
        // The zenith is open or a crown; the nadir is never sky.
        let sky = &street.panorama.sky;
        assert_eq!(sky.len(), 32 * 16);
        assert!(sky[32 * 15..].iter().all(|s| *s == 0));
        assert!(sky.iter().all(|s| [0, 255].contains(s)));
        let again = SCENES.street(index, 64.0, Some(street.position), 32).expect("a scene");
        assert_eq!(again.expect("a view"), street);
    }
    assert!(found >= 27 && on_street >= 18, "{found} {on_street}");
}
