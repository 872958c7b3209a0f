//! Times each stage of the field and the renderer at the released size, with made-up weights:
//! `cargo run --release -p sat3d-model --example render_stages [oneplane|oneplane_multi|triplane [PART]]`,
//! PART being part of a stage's name.
//! `RAYON_NUM_THREADS` sets the number of threads; each line is the best of five runs.

use sat3d_model::Grid;
use sat3d_model::field::{
    DensityActivation, Field, FieldError, FieldInputs, Linear, PointHead, Representation,
};
use sat3d_model::render::{
    Angles, Border, Camera, Lattice, Pose, ReferenceGrid, RenderOptions, SkyMap, Wanted,
    density_grid, dsm, reference_grid, render,
};
use std::time::Instant;

/// Uniform in [-1, 1), the same in every run.
fn noise(count: usize, seed: u64, scale: f32) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    };
    (0..count).map(|_| scale * next()).collect()
}

fn linear(inputs: usize, outputs: usize, seed: u64, scale: f32) -> Linear {
    let weight = noise(inputs * outputs, seed, scale * (3.0 / inputs as f32).sqrt());
    Linear { inputs, outputs, weight, bias: noise(outputs, seed + 1, 0.1) }
}

fn time<T>(name: &str, mut run: impl FnMut() -> T) {
    let mut best = f64::INFINITY;
    if std::env::args().nth(2).is_some_and(|wanted| !name.contains(&wanted)) {
        return;
    }
    for _ in 0..5 {
        let start = Instant::now();
        std::hint::black_box(run());
        best = best.min(start.elapsed().as_secs_f64());
    }
    println!("{name:32} {:8.1} ms", best * 1e3);
}

fn main() -> Result<(), FieldError> {
    let (representation, channels, features) = match std::env::args().nth(1).as_deref() {
        Some("triplane") => (Representation::Triplane, 96, 32),
        Some("oneplane_multi") => (Representation::OneplaneMulti, 64, 32),
        _ => (Representation::Oneplane, 64, 64),
    };
    let mut density = linear(64, 1, 3, 4.0);
    density.bias = vec![-7.5];
    let head = PointHead {
        net0: linear(features, 64, 1, 1.0),
        density,
        feature: linear(64, 32, 5, 1.0),
        style: linear(512, 32, 7, 1.0),
        color: linear(64, 24, 9, 1.0),
    };
    let map = Grid::new(channels, 320, 320, noise(channels * 320 * 320, 11, 1.0));
    let inputs =
        FieldInputs { map, representation, activation: DensityActivation::Mipnerf, scale: 0.8 };
    let sky = SkyMap::from_decoder(&Grid::new(24, 512, 512, noise(24 * 512 * 512, 13, 1.0)));
    let field = Field::new(&inputs, &head, None)?;
    let position = [0.25, -0.3, -0.85];
    let angles = Angles { roll: 0.0, pitch: 10.0, yaw: 35.0 };
    let panorama = Camera::panorama(position, 0.8);
    let perspective = Camera::perspective(Pose::on_crop(position, angles, 0.8));
    let (released, stable) = (RenderOptions::default(), RenderOptions::stable());
    let color = Wanted { color: true, normals: false };
    println!("{representation:?}, {} threads", rayon::current_num_threads());
    time("fold", || Field::new(&inputs, &head, None));
    time("DSM 256 reference", || dsm(&field, 256, &released));
    time("DSM 256 stable", || dsm(&field, 256, &stable));
    time("satellite view 256 with colour", || {
        render(&field, None, &Camera::Ortho { size: 256 }, &released, color)
    });
    time("panorama 256 x 64", || render(&field, Some(&sky), &panorama, &released, color));
    time("panorama 256 x 64 stable", || render(&field, Some(&sky), &panorama, &stable, color));
    time("perspective 128 x 128", || render(&field, Some(&sky), &perspective, &released, color));
    let all = Wanted { color: true, normals: true };
    time("perspective with normals", || render(&field, Some(&sky), &perspective, &released, all));
    let grid = |border| ReferenceGrid { count: 320, border };
    time("grid 320 reference, whole", || reference_grid(&field, &grid(Border::Keep)));
    time("grid 320 reference, zeroed", || reference_grid(&field, &grid(Border::Zero)));
    time("grid pixels 256 x 256 x 320", || density_grid(&field, Lattice::pixels(256, 0.8)));
    Ok(())
}
