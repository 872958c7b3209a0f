use super::*;
use proptest::prelude::*;

/// A smooth, curved, rotated "projection" with a known shape, in metres.
#[derive(Debug)]
struct Curved;

impl Projection for Curved {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        let (x, y) = ((at.lon_deg + 2.3) * 75_000.0, (at.lat_deg - 47.6) * 111_000.0);
        Ok(Projected { x: x - 0.02 * y + 1e-7 * x * x, y: y + 0.02 * x + 2e-7 * x * y })
    }
    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        Err(CrsError::Domain { projection: "test".into(), what: format!("{at:?}") })
    }
}

fn map(form: TransformForm, zoom: u8) -> PixelMap {
    let grid =
        ImageGrid::new(LonLat { lon_deg: -2.3, lat_deg: 47.6 }, zoom, 640, 640).expect("grid");
    let (lattice, _, _) =
        Lattice::of(&GeoTransform::north_up(-1_000.3, 5_000.7, 0.457, 0.458), 24).expect("lattice");
    PixelMap::fit(PixelToCrs::WebMercator { grid, projection: Arc::new(Curved) }, lattice, form)
        .expect("fits")
}

fn worst_miss(a: &PixelMap, b: &PixelMap) -> f64 {
    let (mut ac, mut ar, mut bc, mut br) = (vec![], vec![], vec![], vec![]);
    let mut worst: f64 = 0.0;
    for y in (0..640).step_by(13).chain([639]) {
        [&mut ac, &mut ar, &mut bc, &mut br].into_iter().for_each(Vec::clear);
        a.fill_row(y, 0..640, 0.5, &mut ac, &mut ar).expect("row");
        b.fill_row(y, 0..640, 0.5, &mut bc, &mut br).expect("row");
        for k in 0..640 {
            worst = worst.max(libm::hypot((ac[k] - bc[k]) * 0.457, (ar[k] - br[k]) * 0.458));
        }
    }
    worst
}

#[test]
fn each_form_keeps_its_bound_and_the_bounds_are_not_idle() {
    for zoom in [20, 16, 13] {
        let exact = map(TransformForm::Exact, zoom);
        for form in [TransformForm::Chebyshev, TransformForm::Separable, TransformForm::Affine] {
            let miss = worst_miss(&exact, &map(form, zoom));
            let bound = exact.errors().of(form) + 1e-9;
            assert!(miss <= bound, "{form:?} at zoom {zoom}: {miss} > {bound}");
            assert!(
                miss > bound / 20.0 || miss < 5e-9,
                "{form:?} at zoom {zoom}: {miss} << {bound}"
            );
        }
    }
}

#[test]
fn bounds_are_metres_whatever_the_shape_of_the_cells() {
    let grid = ImageGrid::new(LonLat { lon_deg: -2.3, lat_deg: 47.6 }, 13, 640, 640).expect("grid");
    let exact = PixelToCrs::WebMercator { grid, projection: Arc::new(Curved) };
    let errors = [(1.0, 1.0), (0.25, 8.0), (30.0, 0.5)].map(|(width, height)| {
        let cells = GeoTransform::north_up(-1_000.3, 5_000.7, width, height);
        let (lattice, ..) = Lattice::of(&cells, 30).expect("lattice");
        let map = PixelMap::fit(exact.clone(), lattice, TransformForm::Chebyshev);
        map.expect("fits").errors()
    });
    for other in &errors[1..] {
        for (a, b) in [
            (errors[0].chebyshev, other.chebyshev),
            (errors[0].separable, other.separable),
            (errors[0].affine, other.affine),
        ] {
            assert!((a / b - 1.0).abs() < 1e-3, "{a} {b}");
        }
    }
    assert!(errors[0].chebyshev > 1e-7, "more than rounding: {:?}", errors[0]);
}

#[test]
fn rows_and_single_points_agree() {
    for form in [TransformForm::Chebyshev, TransformForm::Exact, TransformForm::Affine] {
        let map = map(form, 18);
        let (mut cols, mut rows) = (vec![], vec![]);
        map.fill_row(17, 3..9, 0.5, &mut cols, &mut rows).expect("row");
        let p = map.coordinate(PixelPoint { x: 5.5, y: 17.5 }).expect("point");
        assert!((cols[2] - p.x).abs() < 1e-8 && (rows[2] - p.y).abs() < 1e-8);
        assert_eq!(cols.len(), 6);
    }
}

#[test]
fn cells_per_pixel_is_the_ratio_of_sizes() {
    let (cx, cy) = map(TransformForm::Chebyshev, 20).cells_per_pixel().expect("scale");
    // 0.1007 m of image pixel (in the test's crude metres) over 0.457 m of source pixel.
    assert!((cx - 0.22).abs() < 0.03 && (cy - 0.22).abs() < 0.03, "{cx} {cy}");
}

/// Degrees times a factor along each axis.
#[derive(Debug)]
struct Scaled(f64, f64);

impl Projection for Scaled {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        Ok(Projected { x: at.lon_deg * self.0, y: at.lat_deg * self.1 })
    }
    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        Ok(LonLat { lon_deg: at.x / self.0, lat_deg: at.y / self.1 })
    }
}

#[test]
fn the_reference_box_has_the_size_that_the_reference_computes() {
    let grid = ImageGrid::new(LonLat { lon_deg: 10.0, lat_deg: 60.0 }, 18, 640, 320).expect("grid");
    let reference = PixelToCrs::reference_box(&grid, &Scaled(10.0, 100.0)).expect("a box");
    assert_eq!(reference.size(), (640, 320));
    // Degrees of a pixel: 156543.03 m / 2^18, of 111.32 km; along the meridian half of it (60 degrees north).
    let degrees = 156_543.03 / 262_144.0 / 111_320.0;
    for (x, y) in [(0.0, 0.0), (640.0, 320.0), (0.0, 320.0), (480.0, 40.0)] {
        let at = reference.position(PixelPoint { x, y }).expect("a position");
        let (lon, lat) = (10.0 + (x - 320.0) * degrees, 60.0 - (y - 160.0) * degrees * 0.5);
        assert!((at.x - 10.0 * lon).abs() < 1e-12 * at.x, "{at:?} {lon}");
        assert!((at.y - 100.0 * lat).abs() < 1e-12 * at.y, "{at:?} {lat}");
    }
}

#[test]
fn cells_per_pixel_of_a_turned_raster_are_lengths_along_each_axis_of_the_lattice() {
    let (lattice, ..) =
        Lattice::of(&GeoTransform::north_up(0.0, 0.0, 0.5, 4.0), 24).expect("lattice");
    let exact = PixelToCrs::Raster {
        geotransform: GeoTransform([70.0, 3.0, 4.0, 90.0, 6.0, -8.0]),
        width: 30,
        height: 20,
        from: Arc::new(Scaled(1_000.0, 500.0)),
        to: Arc::new(Scaled(2_000.0, 500.0)),
    };
    assert_eq!(exact.size(), (30, 20));
    let at = exact.position(PixelPoint { x: 2.0, y: 1.0 }).expect("a position");
    assert!((at.x - 160.0).abs() < 1e-12 && (at.y - 94.0).abs() < 1e-12, "{at:?}");
    for form in [TransformForm::Exact, TransformForm::Affine] {
        let map = PixelMap::fit(exact.clone(), lattice, form).expect("fits");
        let (x, y) = map.cells_per_pixel().expect("scale");
        assert!((x - 10.0 / 0.5).abs() < 1e-9 && (y - 10.0 / 4.0).abs() < 1e-9, "{x} {y}");
        // What is linear is met by every form, in pictures of any shape.
        let (mut cols, mut rows) = (vec![], vec![]);
        map.fill_row(19, 28..30, 0.0, &mut cols, &mut rows).expect("row");
        let exact =
            lattice.coordinate(exact.position(PixelPoint { x: 29.0, y: 19.0 }).expect("valid"));
        assert!((cols[1] - exact.x).abs() < 1e-9 && (rows[1] - exact.y).abs() < 1e-9);
        // The rounding of positions far from the origin, and nothing else.
        assert!(map.errors().affine < 2e-8, "{:?}", map.errors());
    }
}

#[test]
fn the_worse_of_two_bounds_is_taken_form_by_form() {
    let (a, b) = ([1.0, 5.0, 6.0], [2.0, 3.0, 7.0]);
    let errors =
        |[chebyshev, separable, affine]: [f64; 3]| FitErrors { chebyshev, separable, affine };
    let worst = errors(a).worst(errors(b));
    assert_eq!(worst, errors([2.0, 5.0, 7.0]));
    assert_eq!(worst.of(TransformForm::Exact), 0.0);
    assert_eq!(worst.of(TransformForm::Separable), 5.0);
}

proptest! {
    #[test]
    fn coefficients_of_a_polynomial_are_found(c in proptest::array::uniform9(-5.0..5.0_f64)) {
        let truth: [[f64; 3]; 3] = std::array::from_fn(|j| std::array::from_fn(|i| c[3 * j + i]));
        let samples = NODES.map(|v| NODES.map(|u| {
            let (tu, tv) = (chebyshev(u), chebyshev(v));
            (0..3).map(|j| (0..3).map(|i| truth[j][i] * tu[i] * tv[j]).sum::<f64>()).sum::<f64>()
        }));
        let found = coefficients(&samples);
        for j in 0..3 {
            for i in 0..3 {
                prop_assert!((found[j][i] - truth[j][i]).abs() < 1e-13);
            }
        }
    }
}
