//! `dsm-bench build` as a whole: the tolerance asked for and the bounds recorded beside what a run
//! did, on lidar tiles that sample a surface in closed form.

use super::ledger::Ledger;
use super::{Share, build_heights as heights, build_positions as positions, draw};
use crate::common::{npz, row};
use sat3d::batch::Interrupt;
use sat3d::crs::{CrsSpec, ResolveOptions, ResolvedCrs, resolve};
use sat3d::dsm_bench::{
    BuildOptions, GridKind, ImageSource, Prepared, Quantisation, TransformChoice, prepare,
};
use sat3d::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint};
use sat3d::lidar::{PixelMap, PixelToCrs, Resampling, TransformForm};
use sat3d::plan::Plan;
use sat3d::raster::geotiff::{GeoTiffSpec, GeoTiffWriter};
use sat3d::units::LinearUnit;
use std::collections::HashMap;
use std::path::PathBuf;

/// The test of each step of the plan.
pub const LEDGER: Ledger = &[
    ("operation-accuracy", &[the_stated_accuracy_is_shown_and_not_summed]),
    ("datum", &[positions::a_datum_step_left_out_moves_nothing_beyond_its_bound, the_tolerance]),
    ("projection", &[positions::there_and_back_stays_within_the_projections_bound]),
    ("lattice", &[positions::the_lattice_keeps_its_bound_at_either_phase]),
    (
        "transform",
        &[
            positions::each_form_of_the_transform_keeps_its_bound_in_every_crs,
            positions::from_85_north_to_85_south_the_transform_keeps_its_bound,
            positions::a_polynomial_saves_one_projection_per_pixel,
            each_form_that_is_forced_keeps_the_bound_that_is_recorded,
        ],
    ),
    ("horizontal-unit", &[units_change_no_height_beyond_its_rounding]),
    (
        "kernel",
        &[
            heights::kernels_are_their_definition_but_for_the_rounding_to_32_bits,
            heights::a_plane_is_a_plane_whatever_the_kernel,
            heights::a_displacement_moves_no_height_beyond_the_bound_times_the_gradient,
            heights::a_smaller_kernel_reads_fewer_cells,
        ],
    ),
    ("vertical-unit", &[units_change_no_height_beyond_its_rounding]),
    ("quantise", &[quantising_and_storing_keep_their_bounds_at_any_height]),
    ("storage", &[quantising_and_storing_keep_their_bounds_at_any_height]),
    ("coverage", &[crate::dsm_bench_build::tiles_cut_from_a_raster_give_the_bytes_of_the_raster]),
    ("bare-earth", &[what_is_written_beside_changes_no_height]),
    ("source-tile", &[what_is_written_beside_changes_no_height]),
    ("geotiff", &[what_is_written_beside_changes_no_height]),
    ("preview", &[what_is_written_beside_changes_no_height]),
    ("stac", &[what_is_written_beside_changes_no_height]),
];

fn the_tolerance() {
    no_error_exceeds_the_tolerance_or_the_bound_that_is_recorded();
}

/// Pixels across and down of the images.
const SIDE: u32 = 64;
const NODATA: f32 = -9999.0;

/// A place, the CRS of its tile, the tile's pixel in CRS units, and the unit of its heights.
struct Site {
    code: u32,
    at: LonLat,
    pixel: f64,
    unit: LinearUnit,
}

const fn site(code: u32, lat_deg: f64, lon_deg: f64, pixel: f64, unit: LinearUnit) -> Site {
    Site { code, at: LonLat { lon_deg, lat_deg }, pixel, unit }
}

/// Both projections, all units, datums with and without a step, from 85 N to 85 S.
const SITES: [Site; 7] = [
    site(2927, 47.5903, -122.3129, 1.5, LinearUnit::UsSurveyFoot),
    site(3740, 47.2, -121.1, 0.5, LinearUnit::Metre),
    site(2195, -14.3, -169.5, 1.0, LinearUnit::Foot),
    site(25_833, 59.9, 10.7, 0.25, LinearUnit::Metre),
    site(32_633, 84.9, 15.4, 0.1, LinearUnit::Metre),
    site(32_733, -84.9, 14.1, 0.1, LinearUnit::UsSurveyFoot),
    site(32_760, -0.1, 174.2, 0.5, LinearUnit::Metre),
];

/// A surface in metres of the tile's CRS from its middle.
type Surface = fn(f64, f64) -> f64;

/// A plane, walls on a wave, hills, and hills with a hole of 1.8 m.
const SURFACES: [Surface; 4] = [
    |x, y| 120.0 + 0.7 * x - 0.4 * y,
    |x, y| {
        let wall = (x / 4.0).floor() as i64 % 2 == 0 && (y / 5.0).floor() as i64 % 2 == 0;
        80.0 + libm::sin(x / 3.0) * libm::cos(y / 2.0) + if wall { 30.0 } else { 0.0 }
    },
    |x, y| 900.0 + 40.0 * libm::exp(-(x * x + y * y) / 50.0),
    |x, y| {
        let hole = libm::hypot(x - 1.0, y + 1.0) < 0.9;
        if hole { f64::NAN } else { 30.0 + 12.0 * libm::exp(-(x * x + y * y) / 18.0) + 0.3 * x }
    },
];

/// A tile of a surface at a site, one image in its middle, and what is true of them.
struct Area {
    folder: tempfile::TempDir,
    grid: ImageGrid,
    crs: ResolvedCrs,
    geotransform: GeoTransform,
    /// Heights as stored, NaN where the tile has none.
    cells: Vec<f32>,
    side: usize,
    unit: LinearUnit,
    stem: String,
}

impl Area {
    fn new(site: &Site, surface: Surface) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let stem = format!("satellite_{}_{}", site.at.lat_deg, site.at.lon_deg);
        std::fs::write(folder.path().join("names.txt"), format!("{stem}.png")).unwrap();
        let grid = ImageGrid::new(site.at, 20, SIDE, SIDE).unwrap();
        let crs = resolve(&CrsSpec::from_epsg(site.code), &ResolveOptions::default()).unwrap();
        let middle = crs.projection.forward(site.at).unwrap();
        // The image, and what a datum step of 2 m can bring in.
        let ground = f64::from(SIDE) * grid.ground_sample_distance() * 1.1 + 6.0;
        let side = (ground / crs.metres_per_unit / site.pixel).ceil() as usize;
        let half = side as f64 / 2.0 * site.pixel;
        let geotransform =
            GeoTransform::north_up(middle.x - half, middle.y + half, site.pixel, site.pixel);
        let cells: Vec<f32> = (0..side * side)
            .map(|k| {
                let at = |i: usize| (i as f64 + 0.5) * site.pixel - half;
                let (x, y) = (at(k % side), -at(k / side));
                let metres = surface(x * crs.metres_per_unit, y * crs.metres_per_unit);
                (metres / site.unit.metres_per_unit()) as f32
            })
            .collect();
        let spec = GeoTiffSpec {
            width: side as u32,
            height: side as u32,
            geotransform,
            epsg: site.code,
            nodata: Some(f64::from(NODATA)),
            unit: Some(site.unit),
            ..GeoTiffSpec::default()
        };
        let stored: Vec<f32> = cells.iter().map(|z| if z.is_nan() { NODATA } else { *z }).collect();
        let mut writer = GeoTiffWriter::create(&folder.path().join("tile.tif"), &spec).unwrap();
        writer.write_rows(&stored).unwrap();
        writer.finish().unwrap();
        Self { folder, grid, crs, geotransform, cells, side, unit: site.unit, stem }
    }

    fn options(&self) -> BuildOptions {
        let path = |name: &str| self.folder.path().join(name);
        let images = ImageSource::List(path("names.txt"));
        let mut options = BuildOptions::new(vec![path("tile.tif")], images, path("dsm"));
        options.size = SIDE;
        options.max_nan_pct = 100.0;
        options.threads = 1;
        options.quiet = true;
        options.overwrite = true;
        options
    }

    fn run(&self, options: BuildOptions) -> Built<'_> {
        let out: PathBuf = options.out.clone();
        let prepared = prepare(options).unwrap();
        let summary = prepared.run(&Interrupt::default()).unwrap();
        assert_eq!(summary.done, 1, "{summary:?}");
        let record = row(&out, &self.stem);
        let dsm = npz(&out.join(format!("{}_dsm.npz", self.stem)), "dsm");
        Built { area: self, prepared, record, dsm }
    }

    /// Cells east and south of the tile's corner at a pixel coordinate: the operation of the CRS as
    /// it is, and no lattice.
    fn truth(&self, p: PixelPoint) -> (f64, f64) {
        let at = self.crs.projection.forward(self.grid.lonlat(p)).unwrap();
        let [x, dx, _, y, _, dy] = self.geotransform.0;
        ((at.x - x) / dx, (at.y - y) / dy)
    }

    /// The height in metres at a pixel by bilinear interpolation; NaN where the pixel's own cell
    /// has no data.
    fn height(&self, p: PixelPoint) -> f64 {
        let (x, y) = self.truth(p);
        let cell = |col: f64, row: f64| {
            let inside = |v: f64| (0.0..self.side as f64).contains(&v);
            if !inside(col) || !inside(row) {
                return f64::NAN;
            }
            f64::from(self.cells[row as usize * self.side + col as usize])
        };
        if cell(x.floor(), y.floor()).is_nan() {
            return f64::NAN;
        }
        let (left, top) = ((x - 0.5).floor(), (y - 0.5).floor());
        let (mut sum, mut total) = (0.0, 0.0);
        for (col, row) in
            [(left, top), (left + 1.0, top), (left, top + 1.0), (left + 1.0, top + 1.0)]
        {
            let weight = (1.0 - (x - 0.5 - col).abs()) * (1.0 - (y - 0.5 - row).abs());
            if !cell(col, row).is_nan() {
                sum += weight * cell(col, row);
                total += weight;
            }
        }
        sum / total * self.unit.metres_per_unit()
    }
}

/// A run and what it recorded.
struct Built<'a> {
    area: &'a Area,
    prepared: Prepared,
    record: HashMap<String, String>,
    dsm: Vec<f32>,
}

impl Built<'_> {
    fn number(&self, column: &str) -> f64 {
        self.record[column].parse().unwrap()
    }

    fn plan(&self) -> &Plan {
        &self.prepared.plan
    }

    fn form(&self) -> TransformForm {
        serde_json::from_value(self.record["transform"].clone().into()).unwrap()
    }

    /// All horizontal bounds, with what the image's own transform errs.
    fn horizontal_m(&self) -> f64 {
        let planned = self.plan().step("transform").unwrap().bound.horizontal_m;
        self.plan().horizontal_m() - planned + self.number("transform_bound_m")
    }

    /// The largest displacement of a pixel, metres: by the map that the run took.
    fn displacement_m(&self) -> f64 {
        let (area, tiles) = (self.area, self.prepared.tiles());
        let tile = &tiles.tiles()[0];
        let projection = tiles.crs_of(0).projection.clone();
        let exact = PixelToCrs::WebMercator { grid: area.grid, projection };
        let map = PixelMap::fit(exact, tile.lattice, self.form()).unwrap();
        let side = f64::from(SIDE);
        let mut worst: f64 = 0.0;
        for k in 0..81 {
            let p =
                PixelPoint { x: f64::from(k % 9) / 8.0 * side, y: f64::from(k / 9) / 8.0 * side };
            let (found, (col, row)) = (map.coordinate(p).unwrap(), area.truth(p));
            let x = (found.x - tile.window.col as f64 - col) * tile.lattice.pixel_width;
            let y = (found.y - tile.window.row as f64 - row) * tile.lattice.pixel_height;
            worst = worst.max(libm::hypot(x, y));
        }
        worst * area.crs.metres_per_unit
    }

    /// Holds heights to the bound that is recorded, but for pixels counted as uncertain; the worst
    /// error.
    fn hold_heights(&self, share: &mut Share, what: &str) {
        let bound = self.number("height_bound_m");
        let (mut beyond, mut worst, mut compared) = (0, 0.0_f64, 0);
        for (k, z) in (0..).zip(&self.dsm) {
            let centre = PixelPoint { x: f64::from(k % SIDE) + 0.5, y: f64::from(k / SIDE) + 0.5 };
            let truth = self.area.height(centre);
            let error = (f64::from(*z) - truth).abs();
            compared += usize::from(!error.is_nan());
            if truth.is_nan() != z.is_nan() || error > bound {
                beyond += 1;
            } else if !error.is_nan() {
                worst = worst.max(error);
            }
        }
        let uncertain = self.number("uncertain_px");
        assert!(f64::from(beyond) <= uncertain, "{what}: {beyond} pixels, {uncertain} counted");
        assert!(compared > 1000, "{what}: {compared} pixels");
        share.add(worst, bound, || what.to_owned());
    }
}

#[test]
pub fn no_error_exceeds_the_tolerance_or_the_bound_that_is_recorded() {
    let mut asked = Share::new("build, displacement of the tolerance");
    let mut stated = Share::new("build, displacement of the horizontal bounds");
    let mut height = Share::new("build, height of height_bound_m");
    let mut left_out = 0;
    for (k, site) in SITES.iter().enumerate() {
        for (j, surface) in SURFACES.into_iter().enumerate() {
            let area = Area::new(site, surface);
            for i in (-9..=2_i32).filter(|i| (i + 9) as usize % 4 == j || *i > 0) {
                let mut options = area.options();
                options.tolerance_m = 10.0_f64.powi(i) * draw(k as u64).range(1.0, 3.0);
                let tolerance = options.tolerance_m;
                let built = area.run(options);
                let what = format!("EPSG:{}, surface {j}, tolerance {tolerance:e}", site.code);
                let (found, bound) = (built.displacement_m(), built.horizontal_m());
                // What no form can help is said before the run.
                if built.plan().horizontal_m() > tolerance * (1.0 + 1e-9) {
                    let warned = built.prepared.warnings.iter().any(|w| w.contains("tolerance"));
                    assert!(warned, "{what}: {:?}", built.prepared.warnings);
                } else {
                    asked.add(found, tolerance, || what.clone());
                    assert!(bound <= tolerance * (1.0 + 1e-9), "{what}: {bound}");
                }
                stated.add(found, bound, || what.clone());
                built.hold_heights(&mut height, &what);
                let datum = built.plan().step("datum").unwrap();
                left_out += usize::from(!datum.on && datum.bound.horizontal_m > 0.0);
            }
        }
    }
    assert!(left_out > 3, "the datum step was left out {left_out} times");
    [asked, stated, height].iter().for_each(Share::check);
}

#[test]
pub fn each_form_that_is_forced_keeps_the_bound_that_is_recorded() {
    let mut horizontal = Share::new("build, --transform, displacement");
    let mut height = Share::new("build, --transform, height");
    for site in &SITES {
        let area = Area::new(site, SURFACES[3]);
        for form in ["affine", "separable", "chebyshev", "exact"] {
            let mut options = area.options();
            let form: TransformForm = serde_json::from_value(form.into()).unwrap();
            options.transform = TransformChoice::Forced(form);
            let built = area.run(options);
            let what = format!("EPSG:{}, {}", site.code, form.name());
            horizontal.add(built.displacement_m(), built.horizontal_m(), || what.clone());
            built.hold_heights(&mut height, &what);
        }
    }
    [horizontal, height].iter().for_each(Share::check);
}

#[test]
pub fn the_stated_accuracy_is_shown_and_not_summed() {
    for site in &SITES {
        let area = Area::new(site, SURFACES[0]);
        let prepared = prepare(area.options()).unwrap();
        let step = prepared.plan.step(Plan::OPERATION).unwrap();
        let stated = area.crs.operation.accuracy_m.unwrap_or(0.0);
        assert_eq!(step.bound.horizontal_m, stated, "EPSG:{}", site.code);
        let others = prepared.plan.steps.iter().filter(|s| s.id != Plan::OPERATION);
        let sum: f64 = others.map(|s| s.bound.horizontal_m).sum();
        assert_eq!(prepared.plan.horizontal_m(), sum);
    }
}

#[test]
pub fn units_change_no_height_beyond_its_rounding() {
    let mut share = Share::new("build, units");
    // One surface in one CRS, its heights in three units; and in metres and feet on the ground.
    for unit in [LinearUnit::Metre, LinearUnit::Foot, LinearUnit::UsSurveyFoot] {
        for code in [2927, 3740] {
            let area = Area::new(&Site { code, unit, ..SITES[0] }, SURFACES[1]);
            let built = area.run(area.options());
            let step = |id: &str| built.plan().step(id).unwrap();
            assert_eq!(step("vertical-unit").on, unit != LinearUnit::Metre);
            assert_eq!(step("horizontal-unit").on, code == 2927);
            built.hold_heights(&mut share, &format!("EPSG:{code}, {unit}"));
        }
    }
    share.check();
}

#[test]
pub fn quantising_and_storing_keep_their_bounds_at_any_height() {
    let mut share = Share::new("build, quantise and storage");
    let mut sizes = Vec::new();
    let high: [Surface; 3] = [
        |x, y| 4.0 + 0.001 * x + 0.002 * y,
        |x, y| 1023.0 + 0.001 * x + 0.002 * y,
        |x, y| 8848.0 + 0.001 * x - 0.001 * y,
    ];
    for surface in high {
        let area = Area::new(&SITES[0], surface);
        for step_m in [None, Some(1e-3), Some(0.01), Some(0.5)] {
            let mut options = area.options();
            options.quantise = step_m.map(|step_m| Quantisation { step_m });
            let built = area.run(options);
            let bound = built.plan().step("quantise").unwrap().bound.vertical_m;
            assert_eq!(bound, step_m.unwrap_or(0.0) / 2.0);
            assert!(built.number("height_bound_m") >= built.plan().vertical_m());
            built.hold_heights(&mut share, &format!("{step_m:?}, {}", built.dsm[0]));
            let out = area.folder.path().join("dsm");
            let file = out.join(format!("{}_dsm.npz", area.stem));
            sizes.push(std::fs::metadata(file).unwrap().len());
        }
    }
    // Coarser steps, smaller files.
    for sizes in sizes.chunks(4) {
        assert!(sizes[3] < sizes[2] && sizes[2] < sizes[0], "{sizes:?}");
    }
    share.check();
}

#[test]
pub fn what_is_written_beside_changes_no_height() {
    let area = Area::new(&SITES[0], SURFACES[3]);
    let plain = area.run(area.options());
    let mut all = area.options();
    all.out = area.folder.path().join("all");
    all.dtm.clone_from(&all.lidar);
    (all.source_tile, all.geotiff, all.preview, all.stac) = (true, true, true, true);
    let beside = area.run(all);
    let bits = |dsm: &[f32]| dsm.iter().map(|z| z.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&plain.dsm), bits(&beside.dsm));
    for id in ["bare-earth", "source-tile", "geotiff", "preview", "stac"] {
        let on = |built: &Built<'_>| built.plan().step(id).is_some_and(|step| step.on);
        assert!(!on(&plain) && on(&beside), "{id}");
    }
}

/// Plans over all options that have a step of their own.
pub fn plans() -> Vec<Plan> {
    let mut plans = Vec::new();
    for site in &SITES {
        let area = Area::new(site, SURFACES[0]);
        let mut all = vec![area.options(); 6];
        all[1].grid = GridKind::Reference;
        all[2].transform = TransformChoice::Forced(TransformForm::Exact);
        all[3].quantise = Some(Quantisation { step_m: 0.01 });
        all[3].resampling = Resampling::Average;
        all[4].tolerance_m = 100.0;
        all[5].tolerance_m = 1e-9;
        plans.extend(all.into_iter().map(|options| prepare(options).unwrap().plan));
    }
    plans
}
