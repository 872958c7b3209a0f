//! Positions of `dsm-bench build`: the steps `transform`, `lattice`, `projection` and `datum`, in
//! every CRS of the table.

use super::{Share, draw};
use sat3d::crs::{
    CrsError, CrsSpec, Projection, ResolveOptions, ResolvedCrs, area_of_use, closed_form_codes,
    resolve,
};
use sat3d::grid::{GeoTransform, ImageGrid, LonLat, PixelPoint, Projected};
use sat3d::lidar::{Lattice, LatticeWindow, PHASE_BITS, PixelMap, PixelToCrs, TransformForm};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

const FORMS: [TransformForm; 3] =
    [TransformForm::Chebyshev, TransformForm::Separable, TransformForm::Affine];

fn resolved(code: u32, options: &ResolveOptions) -> ResolvedCrs {
    resolve(&CrsSpec::from_epsg(code), options).expect("in the table")
}

/// A place in the area of use of a CRS, `u` and `v` of the way from its south-west corner, within
/// 85 degrees of the equator.
fn place(code: u32, u: f64, v: f64) -> LonLat {
    let [west, south, east, north] = area_of_use(code).expect("in the table");
    let (south, north) = (south.max(-85.0), north.min(85.0));
    let lon = west + u * (east - west).rem_euclid(360.0);
    LonLat {
        lon_deg: if lon > 180.0 { lon - 360.0 } else { lon },
        lat_deg: south + v * (north - south),
    }
}

/// The lattice of a raster with such pixels that begins at a position, and its part about there.
fn lattice_at(at: Projected, pixel: f64, bits: u32) -> (GeoTransform, Lattice, LatticeWindow) {
    let grid = GeoTransform::north_up(at.x, at.y, pixel, 1.001 * pixel);
    let (lattice, col, row) = Lattice::of(&grid, bits).expect("north-up");
    (grid, lattice, LatticeWindow { col, row, width: 1000, height: 1000 })
}

/// Distance of two lattice coordinates, CRS units.
fn apart(lattice: &Lattice, a: PixelPoint, b: PixelPoint) -> f64 {
    libm::hypot((a.x - b.x) * lattice.pixel_width, (a.y - b.y) * lattice.pixel_height)
}

/// Corners, border and inside of an image.
fn pixels_of(side: u32, seed: u64) -> Vec<PixelPoint> {
    let side = f64::from(side);
    let mut draw = draw(seed);
    let mut all: Vec<PixelPoint> = [0.0, 0.5, 1.0]
        .into_iter()
        .flat_map(|v| [0.0, 0.5, 1.0].map(|u| PixelPoint { x: u * side, y: v * side }))
        .collect();
    all.extend((0..9).map(|_| PixelPoint { x: draw.range(0.0, side), y: draw.range(0.0, side) }));
    all
}

/// Holds each form of one image to its bound.
fn hold(grid: ImageGrid, crs: &ResolvedCrs, pixel_m: f64, seed: u64, shares: &mut [Share; 3]) {
    let at = crs.projection.forward(grid.center()).expect("in the domain");
    let (_, lattice, _) = lattice_at(at, pixel_m / crs.metres_per_unit, PHASE_BITS);
    let exact = PixelToCrs::WebMercator { grid, projection: crs.projection.clone() };
    let fit = |form| PixelMap::fit(exact.clone(), lattice, form).expect("in the domain");
    let truth = fit(TransformForm::Exact);
    for (form, share) in FORMS.into_iter().zip(shares) {
        let map = fit(form);
        let bound = map.errors().of(form);
        for p in pixels_of(grid.width(), seed) {
            let (a, b) = (truth.coordinate(p).expect("in"), map.coordinate(p).expect("in"));
            let miss = apart(&lattice, a, b);
            let what = || format!("{form:?} of {grid:?} in {} at {p:?}", crs.spec.label());
            share.add(miss * crs.metres_per_unit, bound * crs.metres_per_unit, what);
        }
    }
}

#[test]
pub fn each_form_of_the_transform_keeps_its_bound_in_every_crs() {
    let mut shares = FORMS.map(|form| Share::new(&format!("transform, {}", form.name())));
    for (k, code) in closed_form_codes().enumerate() {
        let mut draw = draw(k as u64);
        let crs = resolved(code, &ResolveOptions::default());
        let pixel_m = draw.pick([0.25, 0.4572, 1.0, 5.0]);
        for (u, v) in [(0.5, 0.5), (draw.range(0.0, 1.0), 0.3)] {
            let Ok(grid) = ImageGrid::new(place(code, u, v), 20, 640, 640) else { continue };
            hold(grid, &crs, pixel_m, k as u64, &mut shares);
        }
    }
    // Larger images, smaller zooms: up to 300 km.
    for (k, code) in [2927, 2285, 32_610, 32_733, 32_660, 25_832, 26_905].into_iter().enumerate() {
        let crs = resolved(code, &ResolveOptions::default());
        for (zoom, side) in
            [(10, 64), (12, 640), (14, 2048), (16, 256), (18, 640), (20, 8192), (23, 64)]
        {
            for v in [0.05, 0.5, 0.95] {
                let Ok(grid) = ImageGrid::new(place(code, 0.4, v), zoom, side, side) else {
                    continue;
                };
                hold(grid, &crs, 0.5, (100 * k) as u64 + u64::from(zoom), &mut shares);
            }
        }
    }
    shares.iter().for_each(Share::check);
}

#[test]
pub fn from_85_north_to_85_south_the_transform_keeps_its_bound() {
    let mut shares =
        FORMS.map(|form| Share::new(&format!("transform to 85 N and S, {}", form.name())));
    for zone in (1..=60).step_by(7) {
        for (hemisphere, sign) in [(32_600, 1.0), (32_700, -1.0)] {
            let crs = resolved(hemisphere + zone, &ResolveOptions::default());
            let meridian = f64::from(zone) * 6.0 - 183.0;
            for lat in [0.0, 17.0, 45.0, 60.0, 72.0, 80.0, 84.0, 84.99] {
                let center = LonLat { lon_deg: meridian + 2.9, lat_deg: sign * lat };
                for zoom in [14, 17, 20] {
                    let Ok(grid) = ImageGrid::new(center, zoom, 640, 640) else { continue };
                    hold(grid, &crs, 0.5, u64::from(zone) + u64::from(zoom), &mut shares);
                }
            }
        }
    }
    shares.iter().for_each(Share::check);
}

#[test]
pub fn the_lattice_keeps_its_bound_at_either_phase() {
    let mut share = Share::new("lattice");
    for k in 0..4000_u64 {
        let mut draw = draw(k);
        let (wide, high) = (draw.pick([0.0, 1e3, 1e6]), draw.pick([1e3, 1e7]));
        let corner = Projected { x: draw.range(-wide, wide), y: draw.range(-high, high) };
        let pixel = draw.pick([0.05, 0.25, 1.499_114_573_022, 1.5, 10.0]);
        let (grid, lattice, window) = lattice_at(corner, pixel, draw.pick([PHASE_BITS, 34]));
        let bound = lattice.bound(window);
        // A cell's corner by the file's own numbers, added up without a large origin.
        for (c, r) in [(0.0, 0.0), (1000.0, 1000.0), (draw.range(0.0, 1e3).floor(), 3.0)] {
            let at = grid.to_projected(PixelPoint { x: c, y: r });
            let found = lattice.coordinate(at);
            let cell = PixelPoint { x: window.col as f64 + c, y: window.row as f64 + r };
            // What the file's own position is rounded by belongs to the file.
            let rounded = 0.5 * f64::EPSILON * (at.x.abs() + at.y.abs());
            let miss = (apart(&lattice, found, cell) - rounded).max(0.0);
            share.add(miss, bound, || format!("{grid:?}, {} bits", lattice.phase_bits()));
        }
    }
    share.check();
}

/// A projection that counts what it is asked for.
#[derive(Debug)]
struct Counted {
    projection: Arc<dyn Projection>,
    calls: AtomicU64,
}

impl Projection for Counted {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        self.calls.fetch_add(1, Ordering::Relaxed);
        self.projection.forward(at)
    }

    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        self.projection.inverse(at)
    }
}

#[test]
pub fn a_polynomial_saves_one_projection_per_pixel() {
    let crs = resolved(2927, &ResolveOptions::default());
    let grid = ImageGrid::new(place(2927, 0.2, 0.5), 20, 64, 64).expect("a grid");
    let at = crs.projection.forward(grid.center()).expect("in the domain");
    let (_, lattice, _) = lattice_at(at, 1.5, PHASE_BITS);
    let projections = |form| {
        let counted = Arc::new(Counted { projection: crs.projection.clone(), calls: 0.into() });
        let exact = PixelToCrs::WebMercator { grid, projection: counted.clone() };
        let map = PixelMap::fit(exact, lattice, form).expect("in the domain");
        let (mut cols, mut rows) = (Vec::new(), Vec::new());
        for y in 0..64 {
            map.fill_row(y, 0..64, 0.5, &mut cols, &mut rows).expect("in the domain");
        }
        counted.calls.load(Ordering::Relaxed)
    };
    // The middle, nine nodes, four corners.
    for form in FORMS {
        assert_eq!(projections(form), 14, "{form:?}");
    }
    assert_eq!(projections(TransformForm::Exact), 14 + 64 * 64);
}

/// Metres between two positions of one CRS.
fn metres(crs: &ResolvedCrs, a: Projected, b: Projected) -> f64 {
    libm::hypot(a.x - b.x, a.y - b.y) * crs.metres_per_unit
}

#[test]
pub fn a_datum_step_left_out_moves_nothing_beyond_its_bound() {
    let mut share = Share::new("datum, left out");
    let mut stepped = 0;
    for (k, code) in closed_form_codes().enumerate() {
        let with = resolved(code, &ResolveOptions::default());
        let options = ResolveOptions { without_datum_step: true, ..ResolveOptions::default() };
        let without = resolved(code, &options);
        let helmert = |crs: &ResolvedCrs| crs.operation.definition.contains("+proj=helmert");
        assert!(!helmert(&without), "EPSG:{code}: the step is no part of the work");
        stepped += usize::from(helmert(&with));
        if !helmert(&with) {
            assert_eq!(with.operation.datum_shift_m, 0.0, "EPSG:{code}");
        }
        // As a run does: the shift at a tile of some km, images around it.
        let mut draw = draw(k as u64);
        let tile = place(code, draw.range(0.1, 0.9), draw.range(0.1, 0.9));
        let area = Some([tile.lon_deg, tile.lat_deg, tile.lon_deg + 0.02, tile.lat_deg + 0.02]);
        let measured = resolved(code, &ResolveOptions { area, ..ResolveOptions::default() });
        let bound = 1.05 * measured.operation.datum_shift_m;
        for (east, north) in
            [(0.0, 0.0), (0.05, 0.05), (-0.03, 0.05), (0.05, -0.03), (-0.03, -0.03)]
        {
            let at = LonLat { lon_deg: tile.lon_deg + east, lat_deg: tile.lat_deg + north };
            if at.lat_deg.abs() > 85.0 {
                continue;
            }
            let (a, b) = (with.projection.forward(at), without.projection.forward(at));
            let (Ok(a), Ok(b)) = (a, b) else { continue };
            let factor = sat3d::crs::scale_factor(&with, at).map_or(1.0, |s| s.north.max(1.0));
            share.add(metres(&with, a, b) / factor, bound, || format!("EPSG:{code} at {at:?}"));
        }
    }
    assert!(stepped > 20, "{stepped} of the CRSs have a datum step");
    share.check();
}

/// The bound that the plan states for the projection.
const PROJECTION_BOUND_M: f64 = 5e-8;

#[test]
pub fn there_and_back_stays_within_the_projections_bound() {
    let mut share = Share::new("projection, there and back");
    for (k, code) in closed_form_codes().enumerate() {
        // A datum step drops the height that it makes, as PROJ's does, and has no exact way back.
        let options = ResolveOptions { without_datum_step: true, ..ResolveOptions::default() };
        let crs = resolved(code, &options);
        let mut draw = draw(k as u64);
        let at = place(code, draw.range(0.0, 1.0), draw.range(0.0, 1.0));
        let there = crs.projection.forward(at).expect("in the area of use");
        let back = crs.projection.inverse(there).expect("an inverse");
        let again = crs.projection.forward(back).expect("in the area of use");
        share.add(metres(&crs, there, again), PROJECTION_BOUND_M, || {
            format!("EPSG:{code} at {at:?}")
        });
    }
    share.check();
}

#[cfg(feature = "proj")]
#[test]
pub fn proj_agrees_within_the_projections_bound() {
    let mut share = Share::new("projection, beside PROJ");
    // One in sixteen: PROJ takes milliseconds to find a definition.
    for (k, code) in closed_form_codes().enumerate().filter(|(k, _)| k % 16 == 3) {
        let crs = resolved(code, &ResolveOptions::default());
        let mut draw = draw(k as u64);
        let places: Vec<LonLat> =
            (0..8).map(|_| place(code, draw.range(0.0, 1.0), draw.range(0.0, 1.0))).collect();
        let report = sat3d::crs::check_against_proj(&crs, &places).expect("PROJ has it");
        share.add(report.same_operation_m, PROJECTION_BOUND_M, || format!("EPSG:{code}"));
    }
    share.check();
}
