//! The truth on an image's own pixel grid: exact heights, and where the surface is smooth enough
//! for an interpolated raster to agree with them.

use super::object::{Class, Epoch};
use super::pixels::PixelPositions;
use super::solid::Face;
use super::surface::{Scene, Surface};
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use crate::units::US_SURVEY_FOOT_M;
use rayon::prelude::*;

/// A pixel is smooth if no edge lies within this many lidar cells of it: bilinear interpolation
/// reaches one cell, and its corner 1.42.
const SMOOTH_CELLS: f64 = 2.0;
/// Most pixels that are looked at around a pixel.
const MOST_MARGIN: f64 = 96.0;

/// Heights and masks of one image, row-major, row 0 in the north.
#[derive(Clone, Debug)]
pub struct Truth {
    /// Height of the surface at the images' time (NAVD88), metres.
    pub dsm: Vec<f32>,
    /// Height of the surface at the lidar's time, metres, if it may differ.
    pub dsm_lidar: Option<Vec<f32>>,
    /// Height of the bare earth (of the water over water), metres.
    pub dtm: Vec<f32>,
    /// 1 where one plane or the bare earth continues for two lidar cells on all sides, at both
    /// times and unchanged.
    pub smooth: Vec<u8>,
    /// [`Class`] at the images' time, in the order of its declaration.
    pub class: Vec<u8>,
    side: usize,
}

/// Pixels that must be known around an image so that smoothness can be told up to its border.
#[must_use]
pub fn margin(scene: &Scene, ground_pixel_m: f64) -> usize {
    let cell = scene.spec.tiles.pixel_feet * US_SURVEY_FOOT_M;
    (SMOOTH_CELLS * cell / ground_pixel_m).ceil().min(MOST_MARGIN) as usize + 1
}

impl Truth {
    /// Samples a scene at the pixel centres of a square image.
    #[must_use]
    pub fn new(scene: &Scene, pixels: &PixelPositions) -> Self {
        let ([side, _], margin) = (pixels.size(), pixels.margin());
        let size = side - 2 * margin;
        let image = look(scene, Epoch::Image, pixels);
        let mut smooth = smooth_mask(&image, side, margin);
        let inner = |of: &dyn Fn(&Look) -> f32, looks: &[Look]| -> Vec<f32> {
            (0..size)
                .flat_map(|row| &looks[(row + margin) * side + margin..][..size])
                .map(of)
                .collect()
        };
        let dsm = inner(&|l| l.height as f32, &image);
        let dtm = inner(&|l| l.ground as f32, &image);
        let class = (0..size)
            .flat_map(|row| &image[(row + margin) * side + margin..][..size])
            .map(|l| l.class as u8)
            .collect();
        let dsm_lidar = scene.changes().then(|| {
            let lidar = look(scene, Epoch::Lidar, pixels);
            let before = inner(&|l| l.height as f32, &lidar);
            let smooth_before = smooth_mask(&lidar, side, margin);
            for (i, now) in smooth.iter_mut().enumerate() {
                *now &= smooth_before[i] & u8::from(before[i].to_bits() == dsm[i].to_bits());
            }
            before
        });
        Self { dsm, dsm_lidar, dtm, smooth, class, side: size }
    }

    /// The truth as a `.npz`: keys `dsm`, `dtm`, `smooth`, `class`, and `dsm_lidar` if the scene
    /// changes between the lidar and the images.
    #[must_use]
    pub fn to_npz(&self) -> Vec<u8> {
        let shape = [self.side, self.side];
        let array = |name, data| NpyArray { name, shape: &shape, data };
        let mut arrays = vec![
            array("dsm", NpyData::F32(&self.dsm)),
            array("dtm", NpyData::F32(&self.dtm)),
            array("smooth", NpyData::U8(&self.smooth)),
            array("class", NpyData::U8(&self.class)),
        ];
        if let Some(before) = &self.dsm_lidar {
            arrays.push(array("dsm_lidar", NpyData::F32(before)));
        }
        npz::encode(&arrays, Compression::Fast)
    }
}

/// What is at one pixel.
#[derive(Clone, Copy, Debug)]
struct Look {
    height: f64,
    ground: f64,
    class: Class,
    /// The same number for pixels on the same plane; 0 where nothing is smooth.
    plane: u64,
}

fn look(scene: &Scene, epoch: Epoch, pixels: &PixelPositions) -> Vec<Look> {
    (0..pixels.size()[1])
        .into_par_iter()
        .flat_map_iter(|row| {
            pixels.row(row).iter().map(move |p| {
                let surface = scene.surface(epoch, p[0], p[1]);
                let class = match surface.solid {
                    Some((index, _)) => scene.world(epoch).solids[index as usize].class,
                    None if surface.ground.water => Class::Water,
                    None if scene.is_street(p[0], p[1]) => Class::Street,
                    None => Class::Ground,
                };
                let plane = plane_of(&surface, class);
                Look { height: surface.height, ground: surface.ground.z, class, plane }
            })
        })
        .collect()
}

fn plane_of(surface: &Surface, class: Class) -> u64 {
    match surface.solid {
        // Crowns are round everywhere, and lidar sees nothing of open water.
        Some(_) if class == Class::Tree => 0,
        Some((index, Face::Top(face))) => 2 + 256 * u64::from(index) + u64::from(face),
        Some(_) => 0,
        None if surface.ground.water => 0,
        None => 1,
    }
}

/// 1 where all pixels within `margin` (a square) are on one plane.
fn smooth_mask(looks: &[Look], side: usize, margin: usize) -> Vec<u8> {
    let size = side - 2 * margin;
    // Per row: whether the pixels within the margin to both sides are on one plane.
    let rows: Vec<u64> = (0..side)
        .into_par_iter()
        .flat_map_iter(|row| {
            let line = &looks[row * side..(row + 1) * side];
            (margin..margin + size).map(move |column| {
                let window = &line[column - margin..=column + margin];
                let plane = window[0].plane;
                if window.iter().all(|l| l.plane == plane) { plane } else { 0 }
            })
        })
        .collect();
    (0..size * size)
        .into_par_iter()
        .map(|i| {
            let (row, column) = (i / size, i % size);
            let plane = rows[row * size + column];
            let all = (row..=row + 2 * margin).all(|r| rows[r * size + column] == plane);
            u8::from(plane != 0 && all)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{ImageGrid, PixelPoint};
    use crate::scene::effects::Options;
    use crate::scene::spec::{ChangeSpec, SceneSpec};

    fn truth(spec: SceneSpec) -> (Scene, PixelPositions, Truth, ImageGrid) {
        let scene = Scene::new(spec, &Options::default()).expect("a scene");
        let at = scene.frame.to_lonlat(0.0, 0.0).expect("inverse");
        let grid = ImageGrid::new(at, 20, 96, 96).expect("a grid");
        let margin = margin(&scene, grid.ground_sample_distance());
        let pixels = PixelPositions::new(&grid, &scene.frame, margin).expect("projects");
        let truth = Truth::new(&scene, &pixels);
        (scene, pixels, truth, grid)
    }

    #[test]
    fn a_pixel_is_the_surface_at_its_own_position() {
        let (scene, _, truth, grid) = truth(SceneSpec::default());
        for i in (0..96 * 96).step_by(7) {
            let (row, column) = (i / 96, i % 96);
            let p = PixelPoint { x: column as f64 + 0.5, y: row as f64 + 0.5 };
            let [x, y] = scene.frame.to_local(grid.lonlat(p)).expect("projects");
            assert_eq!(truth.dsm[i], scene.surface(Epoch::Image, x, y).height as f32);
            assert_eq!(truth.dtm[i], scene.ground(x, y) as f32);
        }
        assert!(truth.dsm_lidar.is_none());
    }

    #[test]
    fn around_a_smooth_pixel_there_is_no_edge() {
        let mut spec = SceneSpec::default();
        spec.blocks.downtown = 8.0;
        let (scene, pixels, truth, grid) = truth(spec);
        let reach = 1.5 * 1.5 * US_SURVEY_FOOT_M;
        let mut smooth = 0;
        for i in (0..96 * 96).step_by(3) {
            if truth.smooth[i] == 0 {
                continue;
            }
            smooth += 1;
            let m = pixels.margin();
            let [x, y] = pixels.row(i / 96 + m)[i % 96 + m];
            let middle = scene.surface(Epoch::Image, x, y);
            for k in 0..16 {
                let (sin, cos) = libm::sincos(f64::from(k) * std::f64::consts::FRAC_PI_8);
                let s = scene.surface(Epoch::Image, x + reach * cos, y + reach * sin);
                assert_eq!(s.solid, middle.solid);
                assert!((s.height - middle.height).abs() < 1.5 * reach);
            }
        }
        assert!(smooth > 200, "{smooth}");
        assert!(truth.smooth.contains(&0), "some edges are in the picture");
        assert!(grid.width() == 96);
    }

    #[test]
    fn what_changes_is_not_smooth_and_both_heights_are_kept() {
        let mut spec = SceneSpec::default();
        spec.images.year = 2026;
        spec.change = Some(ChangeSpec { demolished_share_per_year: 0.2, ..ChangeSpec::default() });
        let (scene, _, truth, _) = truth(spec);
        assert!(scene.changes());
        let before = truth.dsm_lidar.as_ref().expect("the lidar's heights");
        let changed = before.iter().zip(&truth.dsm).filter(|(a, b)| a != b).count();
        assert!(changed > 50, "{changed}");
        for (i, (a, b)) in before.iter().zip(&truth.dsm).enumerate() {
            assert!(a == b || truth.smooth[i] == 0);
        }
        let names: Vec<String> = npz::parse(&truth.to_npz(), std::path::Path::new("t.npz"))
            .expect("reads")
            .into_iter()
            .map(|a| a.0)
            .collect();
        assert_eq!(names, ["dsm", "dtm", "smooth", "class", "dsm_lidar"]);
    }
}
