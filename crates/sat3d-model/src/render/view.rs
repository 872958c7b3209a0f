//! Views: rays of a camera, row by row over all cores.

use super::camera::{Camera, Ray, crop_coordinate};
use super::frames::{flip_y, normalised};
use super::march::March;
use super::quadrature::Hit;
use super::sky::SkyMap;
use super::{Composite, DepthKind, LEAST_OPACITY, RenderOptions};
use crate::field::{ColumnRoom, ColumnTables, Field, Medium, RayInField};
use crate::tensor::Grid;
use rayon::prelude::*;

/// A sample's colour is left out where its share of the ray is below this: 96 of them change a
/// channel by less than 1e-6.
const LEAST_SHARE: f32 = 1e-8;

/// What a view should hold beside depth, opacity and depth spread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Colour channels.
    pub color: bool,
    /// Surface normals.
    pub normals: bool,
}

/// What a camera sees; `height x width` pixels, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Distance from the camera, cube units, in the sense of [`RenderOptions::depth_kind`].
    pub depth: Vec<f32>,
    /// How much of the light ends in the scene, 0 to 1.
    pub opacity: Vec<f32>,
    /// Standard deviation of the distance at which light ends, cube units; NaN where no surface was hit.
    pub depth_spread: Vec<f32>,
    /// Colour channels of the scene alone, multiplied by opacity; the first three are red, green, blue.
    pub feature: Option<Grid>,
    /// Colour channels over the sky, where a sky was given.
    pub composite: Option<Grid>,
    /// Unit normals of the surface in the camera-world frame (east, north, up); NaN where none was hit.
    pub normals: Option<Vec<[f32; 3]>>,
}

/// Heights of the crop as the released network exports them.
#[derive(Clone, Debug, PartialEq)]
pub struct Dsm {
    /// Pixels along each side; row 0 is north, column 0 west.
    pub size: usize,
    /// `(2 - depth) / 2`: 0 at the bottom of the cube, 1 at its top; NaN where normalised depth has none.
    pub height: Vec<f32>,
    /// How much of the light ends in the scene.
    pub opacity: Vec<f32>,
    /// Standard deviation of depth, cube units (twice the unit of `height`); NaN where nothing was hit.
    pub depth_spread: Vec<f32>,
}

/// The DSM of the crop with `size x size` pixels (256 as released).
#[must_use]
pub fn dsm(field: &Field, size: usize, options: &RenderOptions) -> Dsm {
    let view = render(field, None, &Camera::Ortho { size }, options, Wanted::default());
    let height = view.depth.iter().map(|depth| (2.0 - depth) / 2.0).collect();
    Dsm { size, height, opacity: view.opacity, depth_spread: view.depth_spread }
}

/// Renders what the camera sees. A ray that misses the cube is sky: opacity 0.
///
/// Rays are handled in batches of one image row, whatever the number of threads.
///
/// # Panics
/// When the sky map's channels are not the field's, and colour is wanted.
#[must_use]
pub fn render(
    field: &Field,
    sky: Option<&SkyMap>,
    camera: &Camera,
    options: &RenderOptions,
    wanted: Wanted,
) -> View {
    let (width, height) = camera.size();
    let channels = field.color_channels();
    if let Some(sky) = sky.filter(|_| wanted.color) {
        assert_eq!(sky.channels(), channels, "channels of the sky map and of the field");
    }
    let scale = exact_scale(field.scale());
    let columns = match camera {
        Camera::Ortho { size } => {
            let xs: Vec<f32> = (0..*size).map(|x| crop_coordinate(x, *size, scale)).collect();
            Some(ColumnTables::new(field, &xs))
        }
        _ => None,
    };
    let frame = Frame { field, sky, camera, options, wanted, scale, columns };
    let rows: Vec<Row> = (0..height)
        .into_par_iter()
        .map_init(|| Rays::new(field, options), |rays, row| frame.row(row, rays))
        .collect();
    let join = |part: fn(&Row) -> &[f32]| rows.iter().flat_map(part).copied().collect();
    let planes = |part: fn(&Row) -> &[f32]| {
        let mut data = Vec::with_capacity(channels * width * height);
        for channel in 0..channels {
            for row in &rows {
                data.extend(part(row).iter().skip(channel).step_by(channels));
            }
        }
        Grid::new(channels, height, width, data)
    };
    View {
        width,
        height,
        depth: join(|row| &row.depth),
        opacity: join(|row| &row.opacity),
        depth_spread: join(|row| &row.spread),
        feature: wanted.color.then(|| planes(|row| &row.feature)),
        composite: (wanted.color && sky.is_some()).then(|| planes(|row| &row.composite)),
        normals: wanted
            .normals
            .then(|| rows.iter().flat_map(|row| &row.normals).copied().collect()),
    }
}

/// The decimal number that was meant by an `f32`: 0.8, not 0.800000012, as the network's configuration
/// has it in double precision.
///
/// ```
/// assert_eq!(sat3d_model::render::exact_scale(0.8), 0.8);
/// ```
#[must_use]
pub fn exact_scale(scale: f32) -> f64 {
    scale.to_string().parse().unwrap_or(f64::from(scale))
}

struct Frame<'a> {
    field: &'a Field,
    sky: Option<&'a SkyMap>,
    camera: &'a Camera,
    options: &'a RenderOptions,
    wanted: Wanted,
    scale: f64,
    columns: Option<ColumnTables<'a>>,
}

#[derive(Default)]
struct Row {
    depth: Vec<f32>,
    opacity: Vec<f32>,
    spread: Vec<f32>,
    feature: Vec<f32>,
    composite: Vec<f32>,
    normals: Vec<[f32; 3]>,
}

/// Buffers that go from ray to ray.
struct Rays {
    march: March,
    column: ColumnRoom,
    points: Vec<[f32; 3]>,
    hidden: Vec<f32>,
    shares: Vec<f32>,
    colors: Vec<f32>,
    feature: Vec<f32>,
    sky: Vec<f32>,
}

impl Rays {
    fn new(field: &Field, options: &RenderOptions) -> Self {
        Self {
            march: March::new(field.arch(), options.sampling, options.samples, field.activation()),
            column: ColumnRoom::default(),
            points: Vec::new(),
            hidden: Vec::new(),
            shares: Vec::new(),
            colors: Vec::new(),
            feature: vec![0.0; field.color_channels()],
            sky: vec![0.0; field.color_channels()],
        }
    }

    /// The ray's colour into `feature`, from what the march has left.
    fn color(&mut self, field: &Field) {
        let (width, padded) = (field.hidden(), field.padded_colors());
        self.hidden.clear();
        self.shares.clear();
        for (share, hidden) in self.march.shares.iter().zip(self.march.hidden.chunks_exact(width)) {
            if *share > LEAST_SHARE {
                self.shares.push(*share);
                self.hidden.extend_from_slice(hidden);
            }
        }
        self.colors.clear();
        self.colors.resize(self.shares.len() * padded, 0.0);
        field.colors_of(&self.hidden, &mut self.colors);
        self.feature.fill(0.0);
        for (share, color) in self.shares.iter().zip(self.colors.chunks_exact(padded)) {
            for (feature, color) in self.feature.iter_mut().zip(color) {
                *feature += share * color;
            }
        }
    }
}

impl Frame<'_> {
    fn row(&self, row: usize, rays: &mut Rays) -> Row {
        let (width, _) = self.camera.size();
        let mut out = Row::default();
        let y = self.camera.ray(row, 0, self.scale).origin[1] as f32;
        let of_row = self.columns.as_ref().map(|columns| columns.row(y));
        for column in 0..width {
            let ray = self.camera.ray(row, column, self.scale);
            let color = self.wanted.color;
            let (near, hit) = match (ray.inside, &of_row) {
                (None, _) => (0.0, None),
                (Some((near, far)), Some(of_row)) => {
                    let mut medium = of_row.column(column, ray.origin[0] as f32, &mut rays.column);
                    (near, Some(rays.march.run(far - near, &mut medium, color)))
                }
                (Some((near, far)), None) => {
                    let start = [0, 1, 2].map(|k| (ray.origin[k] + near * ray.direction[k]) as f32);
                    let mut medium = RayInField {
                        field: self.field,
                        origin: start,
                        direction: ray.direction.map(|d| d as f32),
                        points: &mut rays.points,
                    };
                    (near, Some(rays.march.run(far - near, &mut medium, color)))
                }
            };
            self.pixel(&ray, near, hit, rays, &mut out);
        }
        out
    }

    fn pixel(&self, ray: &Ray, near: f64, hit: Option<Hit>, rays: &mut Rays, out: &mut Row) {
        let solid = hit.filter(|hit| hit.opacity >= LEAST_OPACITY);
        let depth = match self.options.depth_kind() {
            DepthKind::Raw => hit.map_or(0.0, |hit| hit.distance + near * hit.opacity),
            DepthKind::Normalised => solid.map_or(f64::NAN, |hit| hit.mean() + near),
        };
        let opacity = hit.map_or(0.0, |hit| hit.opacity);
        out.depth.push(depth as f32);
        out.opacity.push(opacity as f32);
        out.spread.push(solid.map_or(f32::NAN, |hit| hit.spread() as f32));
        if self.wanted.normals {
            out.normals
                .push(solid.map_or([f32::NAN; 3], |hit| self.normal(ray, near + hit.mean())));
        }
        if !self.wanted.color {
            return;
        }
        if hit.is_some() {
            rays.color(self.field);
        } else {
            rays.feature.fill(0.0);
        }
        out.feature.extend_from_slice(&rays.feature);
        if let Some(sky) = self.sky {
            sky.lookup(ray.direction, self.options.sky_seam, &mut rays.sky);
            let opacity = opacity as f32;
            let over = match self.options.composite {
                Composite::Squared => opacity,
                Composite::Once => 1.0,
            };
            let pixels = rays.feature.iter().zip(&rays.sky);
            out.composite.extend(pixels.map(|(scene, sky)| scene * over + sky * (1.0 - opacity)));
        }
    }

    /// Against the gradient of raw density (central differences over one texel) where light ends on
    /// average; towards the camera where there is no gradient.
    fn normal(&self, ray: &Ray, distance: f64) -> [f32; 3] {
        let step = f64::from(self.field.half_texel());
        let centre = [0, 1, 2].map(|k| ray.origin[k] + distance * ray.direction[k]);
        let points: [[f32; 3]; 6] = std::array::from_fn(|k| {
            let mut point = centre;
            point[k / 2] += if k % 2 == 0 { -step } else { step };
            point.map(|v| v as f32)
        });
        let mut raw = [0.0; 6];
        self.field.raw_at(&points, &mut raw, None);
        let outwards = [0, 1, 2].map(|k| f64::from(raw[2 * k]) - f64::from(raw[2 * k + 1]));
        let normal = normalised(outwards).unwrap_or(ray.direction.map(|d| -d));
        flip_y(normal).map(|v| v as f32)
    }
}

/// What a march along one ray left, for parity tests.
#[doc(hidden)]
pub struct Trace {
    /// Weights of the coarse intervals.
    pub coarse_weights: Vec<f32>,
    /// Coarse, then fine radii.
    pub radii: Vec<f32>,
    /// All radii, ascending.
    pub merged_radii: Vec<f32>,
    /// Raw densities at them.
    pub merged_raw: Vec<f32>,
}

/// Marches along one ray of a camera and returns what happened on the way.
#[doc(hidden)]
#[must_use]
pub fn trace(field: &Field, camera: &Camera, options: &RenderOptions, pixel: [usize; 2]) -> Trace {
    let ray = camera.ray(pixel[0], pixel[1], exact_scale(field.scale()));
    let mut march = March::new(field.arch(), options.sampling, options.samples, field.activation());
    let mut medium = RayInField {
        field,
        origin: ray.origin.map(|v| v as f32),
        direction: ray.direction.map(|v| v as f32),
        points: &mut Vec::new(),
    };
    debug_assert!(medium.hidden() > 0, "a field has hidden values");
    if let Some((_, far)) = ray.inside {
        march.run(far, &mut medium, false);
    }
    Trace {
        coarse_weights: march.coarse_weights,
        radii: march.radii,
        merged_radii: march.merged_radii,
        merged_raw: march.merged_raw,
    }
}
