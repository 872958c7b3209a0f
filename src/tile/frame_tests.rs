use super::*;
use crate::crs::CrsSpec;
use crate::footprint::Place;
use crate::grid::{GeoTransform, ImageGrid};
use crate::tile::city::{Along, Levels};

const BASE_M: f64 = 31.25;
const VERTICAL_M: f64 = 32.24;

fn city_of(size: [u32; 2], footprint: Footprint) -> City {
    City {
        size,
        footprint,
        assumed: false,
        levels: Levels { z: vec![-1.0, 1.0], ends: [-1.0, 1.0] },
        vertical_m: VERTICAL_M,
        along: Along::X,
    }
}

fn place_of(epsg: u32, [west, north, width, height]: [f64; 4]) -> Place {
    let mut crs = CrsSpec::from_epsg(epsg);
    crs.geographic = epsg == 4326;
    Place::Raster { geotransform: GeoTransform::north_up(west, north, width, height), crs }
}

/// Earth-centred coordinates of a point in grid coordinates.
fn ecef(frame: &LocalFrame, point: [f64; 3]) -> [f64; 3] {
    let m = frame.to_ecef().expect("a place");
    let [e, n, u] = frame.place(point);
    [0, 1, 2].map(|axis| m[axis] * e + m[4 + axis] * n + m[8 + axis] * u + m[12 + axis])
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    [0, 1, 2].map(|axis| (a[axis] - b[axis]) * (a[axis] - b[axis])).iter().sum::<f64>().sqrt()
}

/// A picture of 3000 x 2500 pixels as 1500 x 1100 model pixels.
struct Known {
    name: &'static str,
    epsg: u32,
    /// West, north, width and height of a pixel of the picture as it was given, units of the CRS.
    grid: [f64; 4],
    /// Where [`POINTS`] are, by PROJ 9.5.1 (pyproj 3.7.2).
    ecef: [[f64; 3]; 3],
}

const POINTS: [[f64; 3]; 3] = [[0.0, 0.0, -1.0], [1500.0, 1100.0, 1.0], [333.25, 777.5, -0.35]];

/// From pixels to the CRS by the grid, to longitude and latitude by PROJ's inverse projection (of the
/// zone's definition, without a datum step), with height `BASE_M + (z + 1) * VERTICAL_M` from EPSG:4979 to
/// EPSG:4978.
const KNOWN: &[Known] = &[
    Known {
        name: "web mercator, Seattle",
        epsg: 3857,
        grid: [-13_617_700.0, 6_041_400.0, 0.35, 0.308],
        ecef: [
            [-2_304_033.357_724_2, -3_640_415.629_460_1, 4_687_404.047_401_5],
            [-2_303_662.011_344_2, -3_641_155.237_570_2, 4_687_102.022_108_1],
            [-2_304_052.511_521_7, -3_640_740.552_182_5, 4_687_172.396_584_4],
        ],
    },
    Known {
        name: "web mercator, 84.9 north",
        epsg: 3857,
        grid: [1_113_194.9, 19_960_000.0, 1.5, 1.32],
        ecef: [
            [550_295.437_350_5, 97_031.932_260_0, 6_332_341.372_918_9],
            [550_516.041_644_2, 97_471.365_160_7, 6_332_380.350_234_1],
            [550_482.519_921_4, 97_153.891_316_8, 6_332_344.400_010_4],
        ],
    },
    Known {
        name: "web mercator, 84.9 south",
        epsg: 3857,
        grid: [-8_905_559.3, -19_960_000.0, 1.5, 1.32],
        ecef: [
            [97_031.929_791_9, -550_295.437_785_7, -6_332_341.372_918_9],
            [97_370.942_960_3, -549_948.873_720_4, -6_332_430.837_026_0],
            [97_083.130_850_6, -550_081.599_291_0, -6_332_380.084_747_0],
        ],
    },
    Known {
        name: "web mercator over the antimeridian",
        epsg: 3857,
        grid: [20_037_000.0, -1_890_000.0, 0.4, 0.352],
        ecef: [
            [-6_109_727.848_421_4, 486.950_359_1, -1_824_777.916_212_0],
            [-6_109_548.292_447_7, -662.530_947_1, -1_825_598.765_557_7],
            [-6_109_577.395_950_4, 231.563_900_5, -1_825_351.020_989_2],
        ],
    },
    Known {
        name: "UTM 10 north, WGS 84",
        epsg: 32610,
        grid: [548_000.0, 5_272_000.0, 0.15, 0.132],
        ecef: [
            [-2_306_277.477_080_3, -3_639_521.685_565_7, 4_686_997.350_733_9],
            [-2_306_054.739_024_7, -3_640_006.119_845_7, 4_686_819.850_010_5],
            [-2_306_294.736_191_3, -3_639_732.177_902_7, 4_686_854.930_394_7],
        ],
    },
    Known {
        name: "UTM 60 south, WGS 84",
        epsg: 32760,
        grid: [820_000.0, 8_010_000.0, 0.25, 0.22],
        ecef: [
            [-6_068_800.029_967_4, -2_247.048_899_5, -1_955_738.609_159_1],
            [-6_068_695.222_502_6, -3_005.221_289_5, -1_956_269.517_021_5],
            [-6_068_700.873_831_3, -2_419.798_356_4, -1_956_111.902_459_3],
        ],
    },
    Known {
        name: "New York Long Island, US survey feet",
        epsg: 2263,
        grid: [980_000.0, 200_000.0, 0.5, 0.44],
        ecef: [
            [1_333_190.577_336_1, -4_654_087.772_507_3, 4_138_558.784_937_6],
            [1_333_703.831_920_8, -4_654_219.017_805_2, 4_138_346.757_220_1],
            [1_333_335.205_522_0, -4_654_223.653_254_0, 4_138_392.840_437_0],
        ],
    },
    Known {
        name: "degrees",
        epsg: 4326,
        grid: [11.5, 48.2, 2e-06, 1.1879999999999999e-06],
        ecef: [
            [4_173_681.880_381_1, 849_145.175_626_6, 4_731_751.181_745_4],
            [4_173_876.291_083_3, 849_639.918_217_7, 4_731_579.120_185_5],
            [4_173_846.327_808_4, 849_279.758_318_1, 4_731_611.214_531_8],
        ],
    },
];

#[test]
fn points_lie_where_proj_has_them() {
    for known in KNOWN {
        let footprint = Footprint::of_place([3000, 2500], place_of(known.epsg, known.grid));
        let city = city_of([1500, 1100], footprint.expect("a place"));
        let frame = LocalFrame::new(&city, BASE_M).expect("a frame");
        for (point, expected) in POINTS.into_iter().zip(known.ecef) {
            let off = distance(ecef(&frame, point), expected);
            assert!(off < 1e-6, "{}: {point:?} is {off:e} m off", known.name);
        }
        assert!(frame.error_m() < 1e-8, "{}: {:e} m", known.name, frame.error_m());
    }
}

#[test]
fn names_of_vigor_have_their_place() {
    // The centre of the picture is the position in its name.
    let center = LonLat { lon_deg: -122.330_123, lat_deg: 47.601_234 };
    let grid = ImageGrid::new(center, 20, 640, 640).expect("a grid");
    let frame = LocalFrame::new(&city_of([256, 256], Footprint::of_grid(grid)), 12.0);
    let frame = frame.expect("a frame");
    let expected = Ellipsoid::WGS84.geocentric(center, 12.0 + VERTICAL_M);
    assert!(distance(ecef(&frame, [128.0, 128.0, 0.0]), expected) < 1e-8);
    assert_eq!(frame.origin(), Some(center));
    let [east, north, up] = frame.place([128.0, 128.0, -1.0]);
    assert!(east.abs() < 1e-8 && north.abs() < 1e-8 && up.abs() < 1e-8, "{east} {north} {up}");
}

#[test]
fn the_frame_is_right_handed_and_orthonormal() {
    let frame = LocalFrame::new(
        &city_of(
            [700, 500],
            Footprint::of_place([700, 500], place_of(32610, [548_000.0, 5_272_000.0, 0.3, 0.3]))
                .expect("a place"),
        ),
        0.0,
    );
    let m = frame.expect("a frame").to_ecef().expect("a place");
    let column = |k: usize| [m[4 * k], m[4 * k + 1], m[4 * k + 2]];
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let [east, north, up, at] = [0, 1, 2, 3].map(column);
    for (a, b, expected) in [
        (east, east, 1.0),
        (north, north, 1.0),
        (up, up, 1.0),
        (east, north, 0.0),
        (north, up, 0.0),
        (up, east, 0.0),
    ] {
        assert!((dot(a, b) - expected).abs() < 1e-15);
    }
    let cross = [
        east[1] * north[2] - east[2] * north[1],
        east[2] * north[0] - east[0] * north[2],
        east[0] * north[1] - east[1] * north[0],
    ];
    assert!(distance(cross, up) < 1e-15);
    // Up leads away from the Earth; the last row is that of an affine map.
    assert!(dot(up, at) > 6.3e6);
    assert_eq!([m[3], m[7], m[11], m[15]], [0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn the_earth_curves_away_under_a_large_city() {
    // 40 x 40 km at 46 degrees north: a tangent plane, 20 km from where it touches.
    let grid = [500_000.0 - 20_000.0, 5_120_000.0, 2.0, 2.0];
    let footprint = Footprint::of_place([20_000, 20_000], place_of(32610, grid)).expect("a place");
    let frame = LocalFrame::new(&city_of([20_000, 20_000], footprint), 0.0).expect("a frame");
    let [_, north, up] = frame.place([10_000.0, 0.0, -1.0]);
    let radius = Ellipsoid::WGS84.meridian_radius(46.1);
    assert!((north - 20_000.0).abs() < 15.0, "{north}");
    assert!((up + north * north / (2.0 * radius)).abs() < 0.01, "{up}");
    assert!(frame.error_m() < 1e-7, "{:e}", frame.error_m());
}

#[test]
fn a_lattice_that_is_not_exact_enough_is_refined() {
    // Pixels of 300 m at 82 degrees north, where parallels are tight: 64 of them are no quadratic.
    let footprint =
        Footprint::of_place([640, 320], place_of(3857, [0.0, 17_500_000.0, 2_100.0, 2_100.0]))
            .expect("a place");
    let frame = LocalFrame::new(&city_of([640, 320], footprint), 0.0).expect("a frame");
    let placed = frame.placed.as_ref().expect("a place");
    assert!(frame.error_m() < 1e-4, "{:e}", frame.error_m());
    assert!(placed.lattice.blocks[0] > 160, "{:?}", placed.lattice.blocks);
}

#[test]
fn blocks_meet_without_a_step() {
    let footprint =
        Footprint::of_place([1000, 900], place_of(32610, [548_000.0, 5_272_000.0, 0.3, 0.3]))
            .expect("a place");
    let frame = LocalFrame::new(&city_of([1000, 900], footprint), 0.0).expect("a frame");
    let placed = frame.placed.as_ref().expect("a place");
    let step = 1000.0 / placed.lattice.blocks[0] as f64;
    for k in 1..placed.lattice.blocks[0] {
        let x = step * k as f64;
        let [west, east] = [x - 1e-9, x + 1e-9].map(|x| frame.place([x, 333.3, 0.5]));
        assert!(distance(west, east) < 2e-9, "{k}");
    }
}

#[test]
fn a_city_without_a_place_has_the_axes_of_its_picture() {
    let city = city_of([200, 100], Footprint::of_gsd([400, 400], [0.25, 0.125]));
    let frame = LocalFrame::new(&city, 500.0).expect("a frame");
    assert_eq!(frame.place([0.0, 0.0, -1.0]), [-50.0, 25.0, 0.0]);
    assert_eq!(frame.place([200.0, 100.0, 1.0]), [50.0, -25.0, 2.0 * VERTICAL_M]);
    assert_eq!((frame.origin(), frame.to_ecef(), frame.error_m()), (None, None, 0.0));
}

#[test]
fn places_that_cannot_be_used_are_refused() {
    let rotated = Footprint {
        size_px: [100, 100],
        gsd_m: [1.0, 1.0],
        place: Some(Place::Raster {
            geotransform: GeoTransform([0.0, 1.0, 0.1, 0.0, 0.1, -1.0]),
            crs: CrsSpec::from_epsg(3857),
        }),
    };
    let error = LocalFrame::new(&city_of([50, 50], rotated), 0.0).expect_err("rotated");
    assert!(matches!(error, FootprintError::Grid { .. }), "{error}");
    let off = Footprint {
        size_px: [100, 100],
        gsd_m: [1.0, 1.0],
        place: Some(place_of(4326, [0.0, 100.0, 0.1, 0.1])),
    };
    let error = LocalFrame::new(&city_of([50, 50], off), 0.0).expect_err("off the Earth");
    assert!(matches!(error, FootprintError::OffEarth { .. }), "{error}");
}
