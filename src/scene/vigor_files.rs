//! What VIGOR would hold of a scene: image centres and names, panorama positions, label files.
//!
//! Labels follow the documented formulas on purpose, errors included: the corrected ones are
//! differences of UTM coordinates over one resolution for the city, rounded; the original ones the
//! same over 0.114 m, not rounded. Readers can then be held to the true positions in `scene.json`.

use super::error::SceneError;
use super::purpose;
use super::surface::Scene;
use crate::crs::{CrsSpec, Projection, ResolveOptions, resolve};
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use crate::random::Draw;
use crate::units::US_SURVEY_FOOT_M;
use serde::Serialize;
use std::fmt::Write as _;
use std::sync::Arc;

/// Metres per pixel in the formula of Seattle's corrected labels.
pub const CORRECTED_RESOLUTION_M: f64 = 0.100_817;
/// Metres per pixel that the original labels assume in every city.
pub const ORIGINAL_RESOLUTION_M: f64 = 0.114;
/// Letters of panorama identifiers.
pub(super) const LETTERS: &[u8; 64] =
    b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
/// How often a place for a panorama is looked for.
const ATTEMPTS: u32 = 200;

/// One satellite image.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Image {
    /// `satellite_<lat>_<lon>`, without extension.
    pub stem: String,
    /// Centre, exactly as the name says.
    pub center: LonLat,
}

/// One panorama: a place on a street. No picture is made of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Panorama {
    /// Identifier.
    pub id: String,
    /// Position as the labels give it (6 decimals).
    pub at: LonLat,
    /// Positive image and the three semi-positives, as positions in the list of images.
    pub images: [usize; 4],
    /// Whether it is in the training half.
    pub train: bool,
}

impl Panorama {
    /// `<id>,<lat>,<lon>,.jpg`
    #[must_use]
    pub fn name(&self) -> String {
        format!("{},{:.6},{:.6},.jpg", self.id, self.at.lat_deg, self.at.lon_deg)
    }
}

/// The images of a scene: those listed, or all of a grid that lie inside the extent.
///
/// # Errors
/// [`SceneError::NoImage`] when none fits, [`SceneError::Grid`] for impossible image grids.
pub fn images(scene: &Scene) -> Result<Vec<Image>, SceneError> {
    let spec = &scene.spec.images;
    if !spec.centres_degrees.is_empty() {
        return spec
            .centres_degrees
            .iter()
            .map(|[lat_deg, lon_deg]| {
                let center = LonLat { lon_deg: *lon_deg, lat_deg: *lat_deg };
                ImageGrid::new(center, spec.zoom, spec.size_pixels, spec.size_pixels)?;
                Ok(Image { stem: stem(center), center })
            })
            .collect();
    }
    let place = LonLat {
        lon_deg: scene.spec.place.longitude_degrees,
        lat_deg: scene.spec.place.latitude_degrees,
    };
    let middle = ImageGrid::new(place, spec.zoom, spec.size_pixels, spec.size_pixels)?;
    let pixel = middle.ground_sample_distance();
    let extent = &scene.spec.extent;
    // The images' north is not the extent's: both sides lose a little.
    let turn = scene.frame.convergence().abs();
    let count = |along: f64, across: f64| {
        let room = (along - turn * across) / pixel - f64::from(spec.size_pixels);
        (room / spec.spacing_pixels).floor() + 1.0
    };
    let columns = count(extent.width_metres, extent.height_metres);
    let rows = count(extent.height_metres, extent.width_metres);
    let mut images = Vec::new();
    let half = f64::from(spec.size_pixels) / 2.0;
    for j in 0..rows.max(0.0) as i64 {
        for i in 0..columns.max(0.0) as i64 {
            let step = |k: i64, n: f64| (k as f64 - (n - 1.0) / 2.0) * spec.spacing_pixels;
            let p = PixelPoint { x: half + step(i, columns), y: half - step(j, rows) };
            let center = middle.lonlat(p);
            if fits(scene, center)? {
                images.push(Image { stem: stem(center), center });
            }
        }
    }
    if spec.maximum > 0 {
        images.truncate(spec.maximum as usize);
    }
    if images.is_empty() {
        return Err(SceneError::NoImage {
            size: spec.size_pixels,
            metres: f64::from(spec.size_pixels) * pixel,
            width: extent.width_metres,
            height: extent.height_metres,
        });
    }
    Ok(images)
}

/// Whether the whole image, and two lidar cells around it, lie in the extent.
fn fits(scene: &Scene, center: LonLat) -> Result<bool, SceneError> {
    let spec = &scene.spec;
    let size = spec.images.size_pixels;
    let grid = ImageGrid::new(center, spec.images.zoom, size, size)?;
    let border = 2.0 * spec.tiles.pixel_feet * US_SURVEY_FOOT_M;
    let (hw, hh) =
        (spec.extent.width_metres / 2.0 - border, spec.extent.height_metres / 2.0 - border);
    let far = f64::from(size);
    for (x, y) in [(0.0, 0.0), (far, 0.0), (0.0, far), (far, far)] {
        let [east, north] = scene.frame.to_local(grid.lonlat(PixelPoint { x, y }))?;
        if east.abs() > hw || north.abs() > hh {
            return Ok(false);
        }
    }
    Ok(true)
}

/// `satellite_<lat>_<lon>`.
pub(super) fn stem(center: LonLat) -> String {
    // The shortest decimals that read back as the same numbers, as VIGOR's names have.
    format!("satellite_{}_{}", center.lat_deg, center.lon_deg)
}

/// WGS 84 / UTM of the scene's place.
fn utm(scene: &Scene) -> Result<Arc<dyn Projection>, SceneError> {
    let zone = ((scene.spec.place.longitude_degrees + 180.0) / 6.0).floor() as u32 + 1;
    let spec = CrsSpec::from_user_input(&format!("EPSG:{}", 32_600 + zone))?;
    Ok(resolve(&spec, &ResolveOptions::default())?.projection)
}

/// Panoramas on the streets, within the hull of the image centres, each in four images.
///
/// # Errors
/// [`SceneError::Crs`] where a place cannot be projected.
pub fn panoramas(scene: &Scene, images: &[Image]) -> Result<Vec<Panorama>, SceneError> {
    // A label names four images; with fewer there is nothing to write.
    if images.len() < 4 {
        return Ok(Vec::new());
    }
    let utm = utm(scene)?;
    let centers: Vec<[f64; 2]> = images
        .iter()
        .map(|image| Ok(utm.forward(image.center).map(|p| [p.x, p.y])?))
        .collect::<Result<_, SceneError>>()?;
    let range = |pick: fn(&LonLat) -> f64| {
        let values = images.iter().map(|i| pick(&i.center));
        (values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max))
    };
    let (lon, lat) = (range(|c| c.lon_deg), range(|c| c.lat_deg));
    let wanted = (images.len() as f64 * scene.spec.images.panoramas_per_image).round() as u64;
    let mut all = Vec::new();
    for k in 0..wanted {
        let mut draw = Draw::new(&[scene.spec.seed, purpose::PANORAMAS, k]);
        let id: String = (0..22).map(|_| LETTERS[draw.index(64)] as char).collect();
        for _ in 0..ATTEMPTS {
            let round = |v: f64| (v * 1e6).round() / 1e6;
            let at = LonLat {
                lon_deg: round(draw.range(lon.0, lon.1)),
                lat_deg: round(draw.range(lat.0, lat.1)),
            };
            let [x, y] = scene.frame.to_local(at)?;
            let place = scene.streets.locate(x, y);
            let in_lane = place.across(0).abs().min(place.across(1).abs()) < 2.5;
            if !in_lane || !scene.is_street(x, y) {
                continue;
            }
            let p = utm.forward(at)?;
            let mut order: Vec<(f64, usize)> = centers
                .iter()
                .enumerate()
                .map(|(i, c)| (libm::hypot(c[0] - p.x, c[1] - p.y), i))
                .collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let images = [order[0].1, order[1].1, order[2].1, order[3].1];
            let train = draw.chance(0.5);
            all.push(Panorama { id, at, images, train });
            break;
        }
    }
    Ok(all)
}

/// Names and contents of the label and list files, relative to VIGOR's root.
///
/// # Errors
/// [`SceneError::Crs`] where a position cannot be projected.
pub fn label_files(
    scene: &Scene,
    images: &[Image],
    panoramas: &[Panorama],
) -> Result<Vec<(String, String)>, SceneError> {
    let list = images.iter().fold(String::new(), |mut text, image| {
        let _ = writeln!(text, "{}.png", image.stem);
        text
    });
    let mut files = vec![
        ("splits/Seattle/satellite_list.txt".to_owned(), list.clone()),
        ("splits__corrected/Seattle/satellite_list.txt".to_owned(), list),
    ];
    let utm = utm(scene)?;
    for (name, keep) in [
        ("same_area_balanced_train", Some(true)),
        ("same_area_balanced_test", Some(false)),
        ("pano_label_balanced", None),
    ] {
        let mut texts = [String::new(), String::new()];
        for panorama in panoramas.iter().filter(|p| keep.is_none_or(|train| p.train == train)) {
            let p = utm.forward(panorama.at)?;
            for text in &mut texts {
                text.push_str(&panorama.name());
            }
            for &image in &panorama.images {
                let image = &images[image];
                let c = utm.forward(image.center)?;
                let offset =
                    |resolution: f64| [-(p.y - c.y) / resolution, -(p.x - c.x) / resolution];
                let [d0, d1] = offset(ORIGINAL_RESOLUTION_M);
                let _ = write!(texts[0], " {}.png {d0} {d1}", image.stem);
                let [d0, d1] = offset(CORRECTED_RESOLUTION_M).map(f64::round_ties_even);
                // numpy writes -0.0 for a small negative offset; so does `{:.1}`.
                let _ = write!(texts[1], " {}.png {d0:.1} {d1:.1}", image.stem);
            }
            for text in &mut texts {
                text.push('\n');
            }
        }
        let [original, corrected] = texts;
        files.push((format!("splits/Seattle/{name}.txt"), original));
        files.push((format!("splits__corrected/Seattle/{name}__corrected.txt"), corrected));
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::effects::Options;
    use crate::scene::spec::SceneSpec;
    use crate::vigor::SatelliteName;

    fn scene() -> Scene {
        let mut spec = SceneSpec::default();
        spec.extent.width_metres = 180.0;
        spec.extent.height_metres = 150.0;
        Scene::new(spec, &Options::default()).expect("a scene")
    }

    #[test]
    fn images_stand_on_the_lattice_and_inside_the_extent() {
        let scene = scene();
        let images = images(&scene).expect("images");
        assert_eq!(images.len(), 12);
        let first = ImageGrid::new(images[0].center, 20, 640, 640).expect("a grid");
        for (k, image) in images.iter().enumerate() {
            let name = SatelliteName::parse(&format!("{}.png", image.stem)).expect("a name");
            assert_eq!(name.center(), image.center);
            let p = first.pixel(image.center);
            let expected = ((k % 4) as f64 * 362.5, (k / 4) as f64 * -362.5);
            assert!((p.x - 320.0 - expected.0).abs() < 1e-6);
            assert!((p.y - 320.0 - expected.1).abs() < 1e-6);
            assert!(fits(&scene, image.center).expect("projects"));
        }
    }

    #[test]
    fn a_scene_too_small_for_an_image_says_so() {
        let mut spec = SceneSpec::default();
        spec.extent.width_metres = 50.0;
        let scene = Scene::new(spec, &Options::default()).expect("a scene");
        let message = images(&scene).expect_err("too small").to_string();
        assert!(
            message.contains("640 pixels (64 m)") && message.contains("50 x 280 m"),
            "{message}"
        );
    }

    #[test]
    fn panoramas_are_on_streets_and_their_positive_image_is_the_nearest() {
        let scene = scene();
        let images = images(&scene).expect("images");
        let panoramas = panoramas(&scene, &images).expect("panoramas");
        assert!(panoramas.len() >= 10, "{}", panoramas.len());
        for p in &panoramas {
            let [x, y] = scene.frame.to_local(p.at).expect("projects");
            assert!(scene.is_street(x, y));
            let distance = |i: usize| {
                let c = scene.frame.to_local(images[i].center).expect("projects");
                libm::hypot(c[0] - x, c[1] - y)
            };
            let nearest = (0..images.len()).map(distance).fold(f64::INFINITY, f64::min);
            assert!((distance(p.images[0]) - nearest).abs() < 1e-3);
            assert!(distance(p.images[3]) < 60.0);
            assert_eq!(p.id.len(), 22);
        }
    }

    #[test]
    fn label_lines_have_thirteen_fields_and_the_documented_formula() {
        let scene = scene();
        let images = images(&scene).expect("images");
        let panoramas = panoramas(&scene, &images).expect("panoramas");
        let files = label_files(&scene, &images, &panoramas).expect("files");
        assert_eq!(files.len(), 8);
        let text = |name: &str| &files.iter().find(|f| f.0.ends_with(name)).expect("the file").1;
        let all = text("pano_label_balanced__corrected.txt");
        assert_eq!(all.lines().count(), panoramas.len());
        for (line, panorama) in all.lines().zip(&panoramas) {
            let fields: Vec<&str> = line.split(' ').collect();
            assert_eq!(fields.len(), 13);
            assert_eq!(fields[0], panorama.name());
            // x = 320 - d1, y = 320 + d0, off by a few pixels through grid convergence.
            let center = images[panorama.images[0]].center;
            let pixel = ImageGrid::new(center, 20, 640, 640).expect("a grid").pixel(panorama.at);
            let d = |i: usize| fields[i].parse::<f64>().expect("a number");
            assert!((320.0 - d(3) - pixel.x).abs() < 8.0 && (320.0 + d(2) - pixel.y).abs() < 8.0);
            assert!(d(2).fract() == 0.0 && fields[2].ends_with(".0"));
        }
        let (train, test) = (
            text("Seattle/same_area_balanced_train.txt"),
            text("Seattle/same_area_balanced_test.txt"),
        );
        assert_eq!(train.lines().count() + test.lines().count(), panoramas.len());
        assert!(train.lines().count() > 1 && test.lines().count() > 1);
    }
}
