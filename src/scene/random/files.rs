//! Writing random scenes as VIGOR lays them out, with panoramas, sky masks and exact heights.

use super::{Crop, Kind, RandomScenes, Street, purpose};
use crate::batch::{Interrupt, Progress, write_atomic};
use crate::grid::{ImageGrid, LonLat, PixelPoint};
use crate::random::{Draw, key};
use crate::raster::npz::{self, Compression, NpyArray, NpyData};
use crate::scene::error::SceneError;
use crate::scene::object::Epoch;
use crate::scene::picture;
use crate::scene::pixels::PixelPositions;
use crate::scene::spec::{ImageColours, SceneSpec, Season, SunSpec, ViewSpec};
use crate::scene::surface::Scene;
use crate::scene::vigor_files::{LETTERS, stem};
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Zoom of VIGOR's satellite images.
const ZOOM: u8 = 20;
/// Side of VIGOR's satellite images, pixels of that zoom: what an image here covers, whatever its own size.
const VIGOR_PIXELS: u32 = 640;
/// EPSG:3857 as WKT 1, which GDAL's side files hold.
const PSEUDO_MERCATOR: &str = r#"PROJCS["WGS 84 / Pseudo-Mercator",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]],PROJECTION["Mercator_1SP"],PARAMETER["central_meridian",0],PARAMETER["scale_factor",1],PARAMETER["false_easting",0],PARAMETER["false_northing",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],AXIS["Northing",NORTH],EXTENSION["PROJ4","+proj=merc +a=6378137 +b=6378137 +lat_ts=0 +lon_0=0 +x_0=0 +y_0=0 +k=1 +units=m +nadgrids=@null +wktext +no_defs"],AUTHORITY["EPSG","3857"]]"#;
/// Columns of a panorama.
pub const PANORAMA_WIDTH: usize = 512;
/// Quality of the panoramas' JPEG files.
const JPEG_QUALITY: u8 = 95;
/// Every so many scenes one belongs to the test split.
const TEST_EVERY: u64 = 8;

/// What was written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RandomSummary {
    /// The folder.
    pub out: PathBuf,
    /// Seed of the scenes.
    pub seed: u64,
    /// Satellite images.
    pub scenes: usize,
    /// Panoramas with sky masks.
    pub panoramas: usize,
    /// Side of the satellite images, pixels.
    pub size: u32,
    /// How many scenes there are of each kind.
    pub kinds: BTreeMap<Kind, usize>,
}

/// One scene in `scenes.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct SceneRow {
    index: u64,
    kind: Kind,
    split: &'static str,
    /// Seed of the scene itself.
    seed: u64,
    satellite: String,
    centre_degrees: [f64; 2],
    season: Season,
    sun: Option<SunSpec>,
    view: Option<ViewSpec>,
    panorama: Option<PanoramaRow>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct PanoramaRow {
    name: String,
    /// Down and right of the middle of the satellite image, -1 to 1.
    position: [f64; 2],
    on_street: bool,
}

/// Contents of `scenes.json`.
#[derive(Serialize)]
struct ScenesFile<'a> {
    sat3d: &'static str,
    seed: u64,
    size_pixels: u32,
    metres_per_side: f64,
    scenes: &'a [SceneRow],
}

/// What GDAL keeps beside a PNG. The name of an image places its middle, and every reader of VIGOR takes a pixel of it
/// for one of zoom 20; an image of another size, whose pixels are `factor` times as large, has to say so.
fn side_file(grid: &ImageGrid, factor: f64) -> String {
    let [x, width, row_x, y, column_y, height] = grid.geotransform().0;
    let numbers = [x, width * factor, row_x, y, column_y, height * factor];
    let numbers: Vec<String> = numbers.iter().map(|number| format!("{number:?}")).collect();
    let crs = PSEUDO_MERCATOR.replace('"', "&quot;");
    format!(
        "<PAMDataset>\n  <SRS>{crs}</SRS>\n  <GeoTransform>{}</GeoTransform>\n</PAMDataset>\n",
        numbers.join(", ")
    )
}

struct Folders {
    vigor: PathBuf,
    satellite: PathBuf,
    panorama: PathBuf,
    sky: PathBuf,
    truth: PathBuf,
}

impl Folders {
    fn create(out: &Path) -> Result<Self, SceneError> {
        let vigor = out.join("vigor");
        let city = vigor.join("Seattle");
        let folders = Self {
            satellite: city.join("satellite"),
            panorama: city.join("panorama"),
            sky: city.join("pano_sky_mask"),
            truth: out.join("truth"),
            vigor,
        };
        let lists = folders.vigor.join("splits").join("Seattle");
        for folder in [&folders.satellite, &folders.panorama, &folders.sky, &folders.truth, &lists]
        {
            std::fs::create_dir_all(folder)
                .map_err(|source| SceneError::Io { path: folder.clone(), source })?;
        }
        Ok(folders)
    }
}

impl RandomScenes {
    /// Writes scenes 0 to `count` into `out`: satellite images of `size` pixels a side that cover what VIGOR's do
    /// (640 pixels of zoom 20), a panorama and its sky mask each, split files, true heights, and `scenes.json`.
    /// The bytes do not hang on the number of threads.
    ///
    /// # Errors
    /// [`SceneError`] when a file cannot be written or the run is interrupted; files that were finished
    /// stay, and a second run writes everything again.
    pub fn write(
        &self,
        count: u64,
        size: u32,
        out: &Path,
        quiet: bool,
        interrupt: &Interrupt,
    ) -> Result<RandomSummary, SceneError> {
        let folders = Folders::create(out)?;
        let progress = Progress::new("scenes", "scenes", count as usize, quiet);
        let rows: Result<Vec<SceneRow>, SceneError> = (0..count)
            .into_par_iter()
            .map(|index| {
                if interrupt.requested() {
                    return Err(SceneError::Interrupted);
                }
                let row = self.write_one(index, size, &folders)?;
                progress.add(1);
                Ok(row)
            })
            .collect();
        progress.finish();
        let rows = rows?;
        self.write_lists(&rows, size, &folders, out)?;
        let mut kinds = BTreeMap::new();
        for row in &rows {
            *kinds.entry(row.kind).or_insert(0) += 1;
        }
        Ok(RandomSummary {
            out: out.to_owned(),
            seed: self.seed,
            scenes: rows.len(),
            panoramas: rows.iter().filter(|r| r.panorama.is_some()).count(),
            size,
            kinds,
        })
    }

    fn write_one(&self, index: u64, size: u32, to: &Folders) -> Result<SceneRow, SceneError> {
        let spec = self.spec(index);
        let at = place(&spec);
        let grid = ImageGrid::new(at, ZOOM, VIGOR_PIXELS, VIGOR_PIXELS)?;
        let metres = f64::from(VIGOR_PIXELS) * grid.ground_sample_distance();
        let scene = self.scene(index, metres)?;
        let factor = f64::from(VIGOR_PIXELS) / f64::from(size);
        let pixels = PixelPositions::of_window(&[0..size, 0..size], &scene.frame, 0, |p| {
            grid.lonlat(PixelPoint { x: p.x * factor, y: p.y * factor })
        })?;
        let stem = stem(at);
        let path = to.satellite.join(format!("{stem}.png"));
        let rgb = scene.render(&pixels, key(&[scene.spec.seed, purpose::SENSOR]));
        write(&path, &picture::encode(&rgb, size, ImageColours::Rgb, &path)?)?;
        if size != VIGOR_PIXELS {
            write(
                &to.satellite.join(format!("{stem}.png.aux.xml")),
                side_file(&grid, factor).as_bytes(),
            )?;
        }
        write(&to.truth.join(format!("{stem}_dsm.npz")), &truth(&scene, &pixels))?;
        let panorama = self.write_panorama(index, &scene, &grid, metres, to)?;
        Ok(SceneRow {
            index,
            kind: self.kind(index),
            split: if index % TEST_EVERY == TEST_EVERY - 1 { "test" } else { "train" },
            seed: scene.spec.seed,
            satellite: format!("{stem}.png"),
            centre_degrees: [at.lat_deg, at.lon_deg],
            season: scene.spec.images.season,
            sun: scene.spec.sun,
            view: scene.spec.view,
            panorama,
        })
    }

    fn write_panorama(
        &self,
        index: u64,
        scene: &Scene,
        grid: &ImageGrid,
        metres: f64,
        to: &Folders,
    ) -> Result<Option<PanoramaRow>, SceneError> {
        // The frame's origin lies on the lidar's lattice, not on the image's centre.
        let [east, north] = scene.frame.to_ground(scene.frame.to_local(place(&scene.spec))?);
        let crop = Crop { east, north, metres };
        let draw = &mut Draw::new(&[self.seed, index, purpose::STREET]);
        let id: String = (0..22).map(|_| LETTERS[draw.index(64)] as char).collect();
        let Some(street) = Street::drawn(scene, &crop, draw, PANORAMA_WIDTH) else {
            return Ok(None);
        };
        let half = f64::from(VIGOR_PIXELS) / 2.0;
        let [down, right] = street.position;
        let at = grid.lonlat(PixelPoint { x: half + half * right, y: half + half * down });
        let name = format!("{id},{:.6},{:.6},", at.lat_deg, at.lon_deg);
        let panorama = &street.panorama;
        let (width, height) = (PANORAMA_WIDTH as u32, PANORAMA_WIDTH as u32 / 2);
        let path = to.panorama.join(format!("{name}.jpg"));
        let fail =
            |path: &Path, reason: String| SceneError::Write { path: path.to_owned(), reason };
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY)
            .encode(&panorama.rgb, width, height, image::ExtendedColorType::Rgb8)
            .map_err(|e| fail(&path, e.to_string()))?;
        write(&path, &bytes)?;
        let path = to.sky.join(format!("{name}.png"));
        write(&path, &picture::encode_grey(&panorama.sky, width, height, &path)?)?;
        let name = format!("{name}.jpg");
        Ok(Some(PanoramaRow { name, position: street.position, on_street: street.on_street }))
    }

    fn write_lists(
        &self,
        rows: &[SceneRow],
        size: u32,
        to: &Folders,
        out: &Path,
    ) -> Result<(), SceneError> {
        let half = f64::from(VIGOR_PIXELS) / 2.0;
        for split in ["train", "test"] {
            let mut text = String::new();
            for row in rows.iter().filter(|row| row.split == split) {
                let Some(panorama) = &row.panorama else { continue };
                let [h, w] = panorama.position.map(|p| p * half);
                let mask = panorama.name.trim_end_matches(".jpg");
                text.push_str(&format!(
                    "Seattle/satellite/{} Seattle/panorama/{} Seattle/pano_sky_mask/{mask}.png {h} {w}\n",
                    row.satellite, panorama.name
                ));
            }
            // Few scenes have no test split; an empty file would be no split file.
            if !text.is_empty() {
                write(&to.vigor.join(format!("Seattle_{split}.txt")), text.as_bytes())?;
            }
        }
        let list: String = rows.iter().map(|row| format!("{}\n", row.satellite)).collect();
        let path = to.vigor.join("splits").join("Seattle").join("satellite_list.txt");
        write(&path, list.as_bytes())?;
        let metres = rows.first().map_or(0.0, |row| {
            let [lat_deg, lon_deg] = row.centre_degrees;
            ImageGrid::new(LonLat { lon_deg, lat_deg }, ZOOM, VIGOR_PIXELS, VIGOR_PIXELS)
                .map_or(0.0, |grid| f64::from(VIGOR_PIXELS) * grid.ground_sample_distance())
        });
        let file = ScenesFile {
            sat3d: env!("CARGO_PKG_VERSION"),
            seed: self.seed,
            size_pixels: size,
            metres_per_side: metres,
            scenes: rows,
        };
        let path = out.join("scenes.json");
        let mut text = serde_json::to_vec_pretty(&file)
            .map_err(|e| SceneError::Write { path: path.clone(), reason: e.to_string() })?;
        text.push(b'\n');
        write(&path, &text)
    }

    /// What the first `count` scenes are like: how many there are of each kind, and the ranges of what was
    /// drawn.
    #[must_use]
    pub fn survey(&self, count: u64) -> RandomSurvey {
        let specs: Vec<SceneSpec> = (0..count).map(|i| self.spec(i)).collect();
        let mut kinds = BTreeMap::new();
        for index in 0..count {
            *kinds.entry(self.kind(index)).or_insert(0) += 1;
        }
        let mut seasons = BTreeMap::new();
        for spec in &specs {
            *seasons.entry(format!("{:?}", spec.images.season).to_lowercase()).or_insert(0) += 1;
        }
        let mut drawn = Vec::new();
        let mut add =
            |what: &'static str, cause: &'static str, of: &dyn Fn(&SceneSpec) -> Option<f64>| {
                let values: Vec<f64> = specs.iter().filter_map(of).collect();
                let least = values.iter().copied().fold(f64::INFINITY, f64::min);
                let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let scenes = values.len();
                let range = (scenes > 0).then_some([least, most]);
                drawn.push(Drawn { what, cause, scenes, range });
            };
        let above = |v: f64| (v > 0.0).then_some(v);
        add("sun, degrees over the horizon", "shadows", &|s| s.sun.map(|s| s.elevation_degrees));
        add("satellite, degrees off nadir", "relief", &|s| {
            s.view.and_then(|v| above(v.off_nadir_degrees))
        });
        add("sensor noise, grey levels", "sensor-noise", &|s| above(s.images.sensor_noise_levels));
        add("bare broad-leaved trees", "season", &|s| {
            (s.images.season == Season::Winter).then_some(1.0)
        });
        add("hills, metres", "terrain", &|s| above(s.terrain.relief_metres));
        add("slope, per cent", "terrain", &|s| above(s.terrain.slope_percent));
        add("water, share of the side", "water", &|s| s.water.map(|w| w.share));
        add("light of the sky in shadows", "camera", &|s| s.camera.map(|c| c.sky_light));
        add("haze, share", "camera", &|s| s.camera.and_then(|c| above(c.haze)));
        add("blur, pixels", "camera", &|s| s.camera.and_then(|c| above(c.blur_pixels)));
        add("sharpening", "camera", &|s| s.camera.and_then(|c| above(c.sharpening)));
        add("railways, weight", "detail", &|s| s.detail.and_then(|d| above(d.railway)));
        add("flats, share of lots", "detail", &|s| s.detail.and_then(|d| above(d.flats_share)));
        add("wires, share of streets", "detail", &|s| s.detail.and_then(|d| above(d.wires_share)));
        add("closed canopy, share", "detail", &|s| s.detail.and_then(|d| above(d.closed_canopy)));
        RandomSurvey { seed: self.seed, scenes: count, kinds, seasons, drawn }
    }
}

/// What random scenes are like, before any is made.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RandomSurvey {
    /// Seed of the scenes.
    pub seed: u64,
    /// Number of scenes.
    pub scenes: u64,
    /// Scenes of each kind.
    pub kinds: BTreeMap<Kind, usize>,
    /// Scenes in each season.
    pub seasons: BTreeMap<String, usize>,
    /// What was drawn.
    pub drawn: Vec<Drawn>,
}

/// One quantity that is drawn.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Drawn {
    /// The quantity with its unit.
    pub what: &'static str,
    /// The effect or the table of the scene file that it belongs to.
    pub cause: &'static str,
    /// Scenes that have it.
    pub scenes: usize,
    /// Least and greatest value among them.
    pub range: Option<[f64; 2]>,
}

fn place(spec: &SceneSpec) -> LonLat {
    LonLat { lon_deg: spec.place.longitude_degrees, lat_deg: spec.place.latitude_degrees }
}

/// The surface that a lidar survey would find (`dsm`), the bare earth (`dtm`) and what is on top (`class`).
fn truth(scene: &Scene, pixels: &PixelPositions) -> Vec<u8> {
    let [width, height] = pixels.size();
    let (mut dsm, mut dtm, mut class) = (Vec::new(), Vec::new(), Vec::new());
    for row in 0..height {
        for p in pixels.row(row) {
            let surface = scene.surface(Epoch::Lidar, p[0], p[1]);
            dsm.push(surface.height as f32);
            dtm.push(surface.ground.z as f32);
            class.push(scene.class(Epoch::Lidar, p[0], p[1]) as u8);
        }
    }
    let shape = [height, width];
    let array = |name, data| NpyArray { name, shape: &shape, data };
    let arrays = [
        array("dsm", NpyData::F32(&dsm)),
        array("dtm", NpyData::F32(&dtm)),
        array("class", NpyData::U8(&class)),
    ];
    npz::encode(&arrays, Compression::Fast)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), SceneError> {
    write_atomic(path, bytes).map_err(|source| SceneError::Io { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(threads: usize) -> (tempfile::TempDir, RandomSummary) {
        let folder = tempfile::tempdir().expect("a folder");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let scenes = RandomScenes { seed: 3 };
        let summary = pool
            .install(|| scenes.write(9, 48, folder.path(), true, &Interrupt::default()))
            .expect("writes");
        (folder, summary)
    }

    fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
        let mut found = BTreeMap::new();
        let mut next = vec![folder.to_owned()];
        while let Some(place) = next.pop() {
            for item in std::fs::read_dir(&place).expect("a folder") {
                let path = item.expect("an item").path();
                if path.is_dir() {
                    next.push(path);
                } else {
                    let name = path.strip_prefix(folder).expect("below").to_owned();
                    found.insert(name, std::fs::read(&path).expect("reads"));
                }
            }
        }
        found
    }

    #[test]
    fn the_same_files_for_any_number_of_threads_and_all_that_belongs_to_a_scene() {
        let ((one, summary), (three, _)) = (written(1), written(3));
        let (a, b) = (files(one.path()), files(three.path()));
        assert!(a == b);
        assert_eq!(summary.scenes, 9);
        assert!(summary.panoramas >= 7, "{summary:?}");
        assert_eq!(summary.kinds.values().sum::<usize>(), 9);
        let count = |folder: &str| a.keys().filter(|p| p.starts_with(folder)).count();
        // A picture and where it lies, since its pixels are not VIGOR's.
        assert_eq!(count("vigor/Seattle/satellite"), 2 * 9);
        assert_eq!(count("truth"), 9);
        assert_eq!(count("vigor/Seattle/panorama"), summary.panoramas);
        assert_eq!(count("vigor/Seattle/pano_sky_mask"), summary.panoramas);
        let text = |name: &str| String::from_utf8(a[Path::new(name)].clone()).expect("text");
        let (train, test) = (text("vigor/Seattle_train.txt"), text("vigor/Seattle_test.txt"));
        assert_eq!(train.lines().count() + test.lines().count(), summary.panoramas);
        for line in train.lines().chain(test.lines()) {
            let fields: Vec<&str> = line.split(' ').collect();
            assert_eq!(fields.len(), 5);
            for name in &fields[..3] {
                assert!(a.contains_key(&Path::new("vigor").join(name)), "{name}");
            }
            assert!(fields[3..].iter().all(|f| f.parse::<f64>().expect("a number").abs() <= 320.0));
        }
    }

    #[test]
    fn truth_and_picture_are_of_the_named_place() {
        let (folder, _) = written(2);
        let scenes = RandomScenes { seed: 3 };
        for index in [0, 5] {
            let spec = scenes.spec(index);
            let path = folder.path().join("truth").join(format!("{}_dsm.npz", stem(place(&spec))));
            let bytes = std::fs::read(&path).expect("the truth");
            let arrays = npz::parse(&bytes, &path).expect("reads");
            let names: Vec<&str> = arrays.iter().map(|a| a.0.as_str()).collect();
            assert_eq!(names, ["dsm", "dtm", "class"]);
            let npz::NpyValues::F32(dsm) = &arrays[0].1.values else { panic!("32-bit floats") };
            let grid = ImageGrid::new(place(&spec), 20, 640, 640).expect("a grid");
            let metres = 640.0 * grid.ground_sample_distance();
            let scene = scenes.scene(index, metres).expect("a scene");
            let picture = folder.path().join("vigor/Seattle/satellite");
            let picture = picture.join(format!("{}.png", stem(place(&spec))));
            let picture = crate::picture::open(&picture).expect("a picture");
            let footprint = picture.footprint(None).expect("a place");
            for side in footprint.gsd_m {
                assert!((side * 48.0 / metres - 1.0).abs() < 1e-9, "{side}");
            }
            assert!(picture.warnings().is_empty(), "{:?}", picture.warnings());
            let middle = footprint.georeference().expect("one").expect("one");
            let middle = middle.center().expect("a place");
            assert!((middle.lat_deg - place(&spec).lat_deg).abs() < 1e-9);
            assert!((middle.lon_deg - place(&spec).lon_deg).abs() < 1e-9);
            for (row, column) in [(0, 0), (47, 3), (20, 31)] {
                let p = PixelPoint {
                    x: (f64::from(column) + 0.5) * 640.0 / 48.0,
                    y: (f64::from(row) + 0.5) * 640.0 / 48.0,
                };
                let [x, y] = scene.frame.to_local(grid.lonlat(p)).expect("projects");
                let expected = scene.surface(Epoch::Lidar, x, y).height as f32;
                assert_eq!(dsm[(row * 48 + column) as usize], expected);
            }
        }
    }
}
