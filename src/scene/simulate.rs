//! Writing a scene: lidar tiles, satellite images, labels, truth, and what was simulated.

use super::effects::Effect;
use super::error::SceneError;
use super::lidar::{Layer, Survey, Tile, tiles};
use super::object::Object;
use super::picture;
use super::pixels::PixelPositions;
use super::purpose;
use super::surface::Scene;
use super::truth::{self, Truth};
use super::vigor_files::{self, Image, Panorama};
use super::whole::{self, PictureFiles, PictureGrid};
use crate::batch::{AtomicFile, Interrupt, Progress, sync_folder, write_atomic};
use crate::grid::ImageGrid;
use crate::random::key;
use rayon::prelude::*;
use serde::Serialize;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// What a simulation wrote.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// The folder.
    pub out: PathBuf,
    /// Lidar tiles, surface and bare earth each.
    pub tiles: usize,
    /// Satellite images.
    pub images: usize,
    /// Panorama positions.
    pub panoramas: usize,
    /// Columns and rows of the picture of the whole extent, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub picture: Option<[u32; 2]>,
    /// Objects, of both epochs.
    pub objects: usize,
    /// SHA-256 of the plan.
    pub plan_hash: String,
    /// Effects that were simulated.
    pub effects: Vec<Effect>,
    /// Things the user should know.
    pub warnings: Vec<String>,
}

/// Contents of `scene.json`.
#[derive(Serialize)]
struct SceneFile<'a> {
    sat3d: &'static str,
    plan_hash: String,
    plan: &'a crate::plan::Plan,
    frame: FrameFile,
    tiles: &'a [Tile],
    images: &'a [Image],
    panoramas: &'a [Panorama],
    #[serde(skip_serializing_if = "Option::is_none")]
    picture: Option<PictureFiles>,
    streets: &'a super::streets::Streets,
    blocks: Vec<BlockFile>,
    objects: &'a [Object],
}

#[derive(Serialize)]
struct FrameFile {
    crs: String,
    origin_easting_us_survey_feet: f64,
    origin_northing_us_survey_feet: f64,
    true_north_degrees_from_grid_north: f64,
    grid_metres_per_ground_metre: f64,
}

#[derive(Serialize)]
struct BlockFile {
    streets: [i64; 2],
    used_as: super::layout::Use,
}

/// Writes everything that a scene holds into `out`.
///
/// # Errors
/// [`SceneError`] when the scene holds no image, a file cannot be written, or the run is
/// interrupted; files that were finished stay.
pub fn simulate(
    scene: &Scene,
    out: &Path,
    quiet: bool,
    interrupt: &Interrupt,
) -> Result<Summary, SceneError> {
    let images = vigor_files::images(scene)?;
    let panoramas = vigor_files::panoramas(scene, &images)?;
    let tiles = tiles(scene);
    let picture = PictureGrid::new(scene)?;
    let folders = Folders::create(out)?;
    write_tiles(scene, &tiles, &folders, quiet, interrupt)?;
    write_images(scene, &images, &folders, quiet, interrupt)?;
    for (name, text) in vigor_files::label_files(scene, &images, &panoramas)? {
        write(&folders.vigor.join(name), text.as_bytes())?;
    }
    if let Some(grid) = &picture {
        whole::write(scene, grid, out, quiet, interrupt)?;
    }
    let files = picture.map(|grid| PictureFiles::new(scene, &grid));
    let path = out.join("scene.json");
    write_scene_json(scene, &tiles, &images, &panoramas, files, &path)
        .map_err(|source| SceneError::Io { path, source })?;
    let mut warnings = Vec::new();
    if images.len() < 4 {
        warnings.push(format!(
            "{} images: labels name four each, so the label files are empty",
            images.len()
        ));
    }
    Ok(Summary {
        out: out.to_owned(),
        tiles: tiles.len(),
        images: images.len(),
        panoramas: panoramas.len(),
        picture: picture.map(|grid| grid.size()),
        objects: scene.layout.objects.len(),
        plan_hash: scene.plan.hash(),
        effects: Effect::ALL.into_iter().filter(|e| scene.effects.on(*e)).collect(),
        warnings,
    })
}

struct Folders {
    dsm: PathBuf,
    dtm: PathBuf,
    vigor: PathBuf,
    satellite: PathBuf,
    truth: PathBuf,
}

impl Folders {
    fn create(out: &Path) -> Result<Self, SceneError> {
        let vigor = out.join("vigor");
        let folders = Self {
            dsm: out.join("lidar"),
            dtm: out.join("lidar_dtm"),
            satellite: vigor.join("Seattle").join("satellite"),
            vigor,
            truth: out.join("truth"),
        };
        let splits = ["splits", "splits__corrected"].map(|s| folders.vigor.join(s).join("Seattle"));
        for folder in [&folders.dsm, &folders.dtm, &folders.satellite, &folders.truth]
            .into_iter()
            .chain(&splits)
        {
            std::fs::create_dir_all(folder)
                .map_err(|source| SceneError::Io { path: folder.clone(), source })?;
        }
        Ok(folders)
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), SceneError> {
    write_atomic(path, bytes).map_err(|source| SceneError::Io { path: path.to_owned(), source })
}

fn write_tiles(
    scene: &Scene,
    tiles: &[Tile],
    folders: &Folders,
    quiet: bool,
    interrupt: &Interrupt,
) -> Result<(), SceneError> {
    let rows: usize = tiles.iter().map(|t| 2 * t.height as usize).sum();
    let progress = Progress::new("lidar", "rows", rows, quiet);
    let survey = Survey::new(scene);
    for tile in tiles {
        survey.write(Layer::Dsm, tile, &folders.dsm, interrupt, &progress)?;
        survey.write(Layer::Dtm, tile, &folders.dtm, interrupt, &progress)?;
    }
    progress.finish();
    Ok(())
}

fn write_images(
    scene: &Scene,
    images: &[Image],
    folders: &Folders,
    quiet: bool,
    interrupt: &Interrupt,
) -> Result<(), SceneError> {
    let progress = Progress::new("images", "images", images.len(), quiet);
    let outcome = images.par_iter().try_for_each(|image| {
        if interrupt.requested() {
            return Err(SceneError::Interrupted);
        }
        write_image(scene, image, folders)?;
        progress.add(1);
        Ok(())
    });
    progress.finish();
    outcome
}

fn write_image(scene: &Scene, image: &Image, folders: &Folders) -> Result<(), SceneError> {
    let spec = &scene.spec.images;
    let grid = ImageGrid::new(image.center, spec.zoom, spec.size_pixels, spec.size_pixels)?;
    let margin = truth::margin(scene, grid.ground_sample_distance());
    let pixels = PixelPositions::new(&grid, &scene.frame, margin)?;
    let path = folders.satellite.join(format!("{}.png", image.stem));
    let seed = [image.center.lat_deg.to_bits(), image.center.lon_deg.to_bits()];
    let rgb = scene.render(&pixels, key(&[scene.spec.seed, purpose::SENSOR, seed[0], seed[1]]));
    write(&path, &picture::encode(&rgb, spec.size_pixels, spec.colours, &path)?)?;
    let truth = Truth::new(scene, &pixels).to_npz();
    write(&folders.truth.join(format!("{}_dsm.npz", image.stem)), &truth)
}

/// Streams what was resolved: of a large city it is hundreds of megabytes.
fn write_scene_json(
    scene: &Scene,
    tiles: &[Tile],
    images: &[Image],
    panoramas: &[Panorama],
    picture: Option<PictureFiles>,
    path: &Path,
) -> io::Result<()> {
    let [easting, northing] = scene.frame.origin_feet();
    let file = SceneFile {
        sat3d: env!("CARGO_PKG_VERSION"),
        plan_hash: scene.plan.hash(),
        plan: &scene.plan,
        frame: FrameFile {
            crs: format!("EPSG:{}", super::frame::LIDAR_CRS),
            origin_easting_us_survey_feet: easting,
            origin_northing_us_survey_feet: northing,
            true_north_degrees_from_grid_north: scene.frame.convergence().to_degrees(),
            grid_metres_per_ground_metre: scene.frame.scale(),
        },
        tiles,
        images,
        panoramas,
        picture,
        streets: &scene.streets,
        blocks: scene
            .layout
            .uses
            .iter()
            .map(|(streets, used_as)| BlockFile { streets: *streets, used_as: *used_as })
            .collect(),
        objects: &scene.layout.objects,
    };
    let mut target = AtomicFile::create(path)?;
    let mut writer = BufWriter::new(target.file());
    serde_json::to_writer_pretty(&mut writer, &file)?;
    writer.flush()?;
    drop(writer);
    target.commit()?;
    path.parent().map_or(Ok(()), sync_folder)
}
