//! What a view knows beside colour: distance, opacity, normals, places in metres.

use super::pixels::Picture;
use super::{ViewError, World};
use crate::model::render::frames::{Vector, flip_y, normalised};
use crate::model::render::{Camera, DepthKind, LEAST_OPACITY, RenderOptions, View};
use crate::raster::colour;
use crate::raster::npz::{self, Compression, NpyArray, NpyData};

/// Opacity under which a preview shows black, as the reference's.
const PREVIEW_OPACITY: f32 = 0.5;

/// The bytes of an npz with one value per ray, `height x width`:
///
/// * `depth`: metres from the camera along the ray, in the sense of the options (raw, or normalised with
///   NaN where nothing was hit);
/// * `opacity`: 0 to 1;
/// * `normals`: east, north, up of the surface's unit normal in metres; NaN where nothing was hit;
/// * `points`: east, north, up in metres of where the ray ends on average; NaN where nothing was hit.
pub(super) fn npz(world: &World, camera: &Camera, options: &RenderOptions, view: &View) -> Vec<u8> {
    let (width, height) = (view.width, view.height);
    let mut depth = Vec::with_capacity(width * height);
    let mut points = Vec::with_capacity(3 * width * height);
    let mut normals = Vec::with_capacity(3 * width * height);
    for row in 0..height {
        for column in 0..width {
            let pixel = row * width + column;
            let ray = camera.ray(row, column, world.scale());
            let stated = f64::from(view.depth[pixel]);
            let opacity = f64::from(view.opacity[pixel]);
            let end = match options.depth_kind() {
                DepthKind::Normalised => stated,
                DepthKind::Raw if opacity >= LEAST_OPACITY => stated / opacity,
                DepthKind::Raw => f64::NAN,
            };
            depth.push((stated * world.metres_along(ray.direction)) as f32);
            let place = [0, 1, 2].map(|axis| ray.origin[axis] + end * ray.direction[axis]);
            points.extend(world.to_metres(flip_y(place)).map(|v| v as f32));
            let normal = view.normals.as_ref().map_or([f32::NAN; 3], |normals| normals[pixel]);
            normals.extend(in_metres(world, normal.map(f64::from)).map(|v| v as f32));
        }
    }
    let (plane, vectors) = ([height, width], [height, width, 3]);
    let arrays = [
        NpyArray { name: "depth", shape: &plane, data: NpyData::F32(&depth) },
        NpyArray { name: "opacity", shape: &plane, data: NpyData::F32(&view.opacity) },
        NpyArray { name: "normals", shape: &vectors, data: NpyData::F32(&normals) },
        NpyArray { name: "points", shape: &vectors, data: NpyData::F32(&points) },
    ];
    npz::encode(&arrays, Compression::Fast)
}

fn in_metres(world: &World, normal: Vector) -> Vector {
    normalised(world.normal_to_metres(normal)).unwrap_or([f64::NAN; 3])
}

/// Distance as colour: near pale, far dark, black where less than half of the light ends in the scene.
pub(super) fn preview(view: &View) -> Result<Vec<u8>, ViewError> {
    let seen = |pixel: usize| {
        let (depth, opacity) = (view.depth[pixel], view.opacity[pixel]);
        (opacity >= PREVIEW_OPACITY && depth.is_finite()).then_some(depth)
    };
    let count = view.width * view.height;
    let farthest = (0..count).filter_map(seen).fold(1e-6, f32::max);
    let colours = colour::table::<256>(&colour::MAGNITUDE);
    let pixels = (0..count).map(|pixel| match seen(pixel) {
        Some(depth) => colours[(depth / farthest * 255.0) as usize],
        None => [0; 3],
    });
    let rgb = pixels.flatten().collect();
    Picture { width: view.width, height: view.height, rgb }.png()
}
