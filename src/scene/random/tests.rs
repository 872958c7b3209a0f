use super::*;
use crate::scene::object::Epoch;
use crate::scene::{Options, pixels::PixelPositions};

const SCENES: RandomScenes = RandomScenes { seed: 7 };

#[test]
fn a_sample_is_the_scene_at_the_pixel_centres() {
    for index in 0..24 {
        let sample = SCENES.sample(index, 24, 64.0).expect("a sample");
        let scene = Scene::new(SCENES.spec_for(index, 64.0), &Options::default()).expect("a scene");
        let pixels = PixelPositions::square(&scene.frame, 24, 64.0);
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
    let pixels = PixelPositions::square(&scene.frame, 65, 65.0);
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
