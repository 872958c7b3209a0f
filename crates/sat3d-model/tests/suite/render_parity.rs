//! The renderer beside the reference, where a list of errors is not enough: why sample densities differ, and
//! what the released grid does at its border. The list itself is [`sat3d_model::parity`]'s.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::support;

use sat3d_model::field::Field;
use sat3d_model::render::quadrature::ImportanceRoom;
use sat3d_model::render::{Border, Camera, ReferenceGrid, RenderOptions, reference_grid, trace};
use support::{Tensors, case, errors, fixture};

/// Rays of the fixtures whose densities were saved, with the camera size that numbers them.
const RAYS: [(&str, &str); 5] = [
    ("tiny", "04_ortho"),
    ("tiny", "06_pano"),
    ("tiny", "07_perspective"),
    ("tiny_triplane", "04_ortho"),
    ("tiny_triplane", "06_pano"),
];

fn parity(config: &str) -> Tensors {
    Tensors::open(&fixture(&format!("parity/{config}.safetensors"))).unwrap()
}

/// From the reference's own coarse weights our sampler, in double precision, finds the reference's fine radii to
/// the last bits of single precision: the order of operations is not where radii part.
#[test]
fn the_sampler_finds_the_references_radii_from_its_weights() {
    let mut room = ImportanceRoom::default();
    let mut fine = Vec::new();
    for (config, view) in RAYS {
        let golden = parity(config);
        let get = |key: &str| golden.f32(&format!("{view}/ray_{key}"));
        let (radii, weights) = (get("radii_coarse"), get("weights_coarse"));
        let mut all = Vec::new();
        for (radii, weights) in radii.chunks_exact(48).zip(weights.chunks_exact(47)) {
            room.released(radii, weights, 48, &mut fine);
            all.extend_from_slice(&fine);
        }
        let (relative, largest) = errors(&all, &get("radii_fine"));
        eprintln!("{config} {view}: relative L2 {relative:.2e}, largest {largest:.2e}");
        assert!(relative < 3e-7 && largest < 1.5e-6, "{config} {view}: {relative:e} {largest:e}");
    }
}

/// What the sampler cannot change: the densities of the fine samples belong to radii that follow from the coarse
/// weights, so that in a steep field a difference of 1e-5 between two maps becomes more than 1e-4. Noise in our
/// map that moves densities at fixed places by as much as they are from the reference's moves the densities along
/// our rays as far as those are from the reference's, sampler and order of operations being the same.
#[test]
fn sample_densities_part_as_the_planes_do() {
    // Chosen so that `noise_there` is `at_its_radii`.
    const NOISE: f32 = 1.6e-5;
    let golden = parity("tiny_triplane");
    let get = |key: &str| golden.f32(&format!("04_ortho/ray_{key}"));
    let mut case = case("tiny_triplane");
    let field = Field::new(&case.inputs, &case.head, None).unwrap();
    let map = &mut case.inputs.map.data;
    let rms = (map.iter().map(|v| v * v).sum::<f32>() / map.len() as f32).sqrt();
    let mut state = 1_u64;
    for value in map {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        // Uniform in [-1, 1) times the root of three: a standard deviation of one.
        let noise = ((state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0) * 1.732;
        *value += NOISE * rms * noise;
    }
    let disturbed = Field::new(&case.inputs, &case.head, None).unwrap();
    let camera = Camera::Ortho { size: 64 };
    let reference_radii = get("radii_all");
    let [mut ours, mut moved, mut there, mut moved_there]: [Vec<f32>; 4] = Default::default();
    let rays = golden.i64("04_ortho/ray_idx");
    for (index, radii) in rays.into_iter().zip(reference_radii.chunks_exact(96)) {
        let pixel = [index as usize / 64, index as usize % 64];
        let along = |field| trace(field, &camera, &RenderOptions::default(), pixel).merged_raw;
        ours.extend(along(&field));
        moved.extend(along(&disturbed));
        let [x, y, z] = camera.ray(pixel[0], pixel[1], 0.8).origin.map(|v| v as f32);
        let points: Vec<[f32; 3]> = radii.iter().map(|r| [x, y, z - r]).collect();
        there.extend(field.raw_densities(&points));
        moved_there.extend(disturbed.raw_densities(&points));
    }
    let want = get("density_all");
    let [along, noise_along] = [errors(&ours, &want).0, errors(&moved, &ours).0];
    let [at_its_radii, noise_there] = [errors(&there, &want).0, errors(&moved_there, &there).0];
    eprintln!(
        "densities from the reference's: {at_its_radii:.2e} at its radii, {along:.2e} along our rays; \
         moved by noise: {noise_there:.2e} and {noise_along:.2e}"
    );
    assert!(at_its_radii < 2e-5 && along < 5e-4, "{at_its_radii:e} {along:e}");
    assert!((0.5..2.0).contains(&(noise_there / at_its_radii)), "{noise_there:e}");
    assert!(along < 3.0 * noise_along, "{along:e} {noise_along:e}");
}

/// `crop=true` is a slice of the whole grid, `crop=false` that slice with zeros around it.
#[test]
fn the_released_grids_borders() {
    let case = case("tiny");
    let field = Field::new(&case.inputs, &case.head, None).unwrap();
    let of = |border| reference_grid(&field, &ReferenceGrid { count: 64, border });
    let (raw, cut, zero) = (of(Border::Keep), of(Border::Cut), of(Border::Zero));
    let p = parity("tiny").i64("08_grid/pad")[0] as usize;
    let mut within = 0;
    for (index, value) in raw.values.iter().enumerate() {
        let [x, y, z] = [index / 4096, index / 64 % 64, index % 64];
        let inside = (p..64 - p).contains(&x) && (p..64 - p).contains(&y) && z >= p;
        assert_eq!(zero.values[index], if inside { *value } else { 0.0 });
        if inside {
            let at = ((x - p) * (64 - 2 * p) + y - p) * (64 - p) + z - p;
            assert_eq!(cut.values[at], *value);
            within += 1;
        }
    }
    assert_eq!(within, cut.values.len());
}
