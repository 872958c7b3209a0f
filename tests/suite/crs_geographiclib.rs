//! The closed-form projections against GeographicLib, an independent implementation: `ConicProj`
//! (Karney's divided differences) and `TransverseMercatorProj` (exact, by elliptic functions).

use sat3d::crs::{Ellipsoid, LambertConic, TransverseMercator};
use sat3d::grid::{LonLat, Projected};
use std::io::Write;
use std::process::{Command, Stdio};

/// 1e-8 m, the agreement that the project promises.
const TOLERANCE_M: f64 = 1e-8;
const POINTS: usize = 10_000;

/// One line of a tool's output: two coordinates and the scale there.
#[derive(Clone, Copy)]
struct Answer {
    at: (f64, f64),
    scale: f64,
}

/// Runs a GeographicLib tool over lines of two numbers; `None` where the tool is not installed.
fn tool(program: &str, arguments: &[String], input: &[(f64, f64)]) -> Option<Vec<Answer>> {
    let mut child = match Command::new(program)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
    {
        Ok(child) => child,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            eprintln!("skipped: {program} (GeographicLib's tools) is not installed");
            return None;
        }
        Err(error) => panic!("{program}: {error}"),
    };
    let text: String = input.iter().map(|(a, b)| format!("{a} {b}\n")).collect();
    let mut stdin = child.stdin.take().expect("piped");
    let writer = std::thread::spawn(move || stdin.write_all(text.as_bytes()));
    let output = child.wait_with_output().expect("the tool ends");
    writer.join().expect("no panic").expect("the tool reads");
    assert!(output.status.success(), "{program} failed");
    // Coordinates, convergence, scale.
    let parse = |line: &str| {
        let fields: Vec<f64> =
            line.split_whitespace().map(|field| field.parse().expect("a number")).collect();
        Answer { at: (fields[0], fields[1]), scale: fields[3] }
    };
    let found: Vec<_> =
        String::from_utf8(output.stdout).expect("ASCII").lines().map(parse).collect();
    assert_eq!(found.len(), input.len());
    Some(found)
}

/// Low-discrepancy positions (the R2 sequence) in a box of latitudes and longitudes.
fn positions(lat: (f64, f64), lon: (f64, f64)) -> Vec<LonLat> {
    (0..POINTS)
        .map(|i| {
            let u = (0.5 + 0.754_877_666_246_692_7 * i as f64).fract();
            let v = (0.5 + 0.569_840_290_998_053_3 * i as f64).fract();
            LonLat { lon_deg: lon.0 + u * (lon.1 - lon.0), lat_deg: lat.0 + v * (lat.1 - lat.0) }
        })
        .collect()
}

/// Metres on the ground between two positions.
fn ground_distance(a: LonLat, b: LonLat) -> f64 {
    let turn = (a.lon_deg - b.lon_deg + 540.0).rem_euclid(360.0) - 180.0;
    let east = turn.to_radians() * Ellipsoid::GRS80.parallel_radius(a.lat_deg);
    let north = (a.lat_deg - b.lat_deg).to_radians() * Ellipsoid::GRS80.meridian_radius(a.lat_deg);
    libm::hypot(east, north)
}

/// The flattening of GRS 1980, as GeographicLib reads it.
const FLATTENING: &str = "1/298.257222101";

/// Largest differences between two projections of one kind, metres.
#[derive(Debug, Default)]
struct Largest {
    /// Forward, on the map.
    forward: f64,
    /// Forward, on the ground: over the scale, which has no bound towards the far pole of a conic.
    ground: f64,
    /// Inverse, on the ground.
    inverse: f64,
}

impl Largest {
    fn add(&mut self, ours: Projected, theirs: Projected, scale: f64) {
        let apart = libm::hypot(ours.x - theirs.x, ours.y - theirs.y);
        self.forward = self.forward.max(apart);
        self.ground = self.ground.max(apart / scale.max(1.0));
    }

    fn add_inverse(&mut self, ours: LonLat, (lat_deg, lon_deg): (f64, f64)) {
        self.inverse = self.inverse.max(ground_distance(ours, LonLat { lon_deg, lat_deg }));
    }
}

/// Compares a conic over a box of latitudes and of longitudes from its central meridian.
fn conic(
    (lat_1, lat_2): (f64, f64),
    (lat_0, lon_0): (f64, f64),
    latitudes: (f64, f64),
    reach: f64,
) -> Option<Largest> {
    let ellipsoid = Ellipsoid::GRS80;
    let ours = LambertConic::two_parallels(ellipsoid, (lat_0, lon_0), (lat_1, lat_2), (0.0, 0.0))
        .expect("valid parameters");
    let points = positions(latitudes, (lon_0 - reach, lon_0 + reach));
    let mut input: Vec<_> = points.iter().map(|p| (p.lat_deg, p.lon_deg)).collect();
    // GeographicLib counts northings from the parallel of least scale.
    input.push((lat_0, lon_0));
    let a = ellipsoid.a;
    let arguments: Vec<_> = format!("-c {lat_1} {lat_2} -l {lon_0} -e {a} {FLATTENING} -p 10")
        .split(' ')
        .map(str::to_owned)
        .collect();
    let mut there = tool("ConicProj", &arguments, &input)?;
    let reverse = [arguments, vec!["-r".to_owned()]].concat();
    let map: Vec<_> = there.iter().map(|answer| answer.at).collect();
    let back = tool("ConicProj", &reverse, &map)?;
    let (_, origin) = there.pop().expect("the origin").at;
    let mut largest = Largest::default();
    for ((point, Answer { at: (x, y), scale }), back) in points.into_iter().zip(there).zip(back) {
        let theirs = Projected { x, y: y - origin };
        largest.add(ours.forward(point).expect("in the domain"), theirs, scale);
        largest.add_inverse(ours.inverse(theirs).expect("in the domain"), back.at);
    }
    println!("conic {lat_1} {lat_2}, latitudes {latitudes:?}, +-{reach}: {largest:?}");
    Some(largest)
}

/// Compares a transverse Mercator within some degrees of its central meridian, pole to pole.
fn transverse_mercator(lon_0: f64, k_0: f64, reach: f64) -> Option<Largest> {
    let ellipsoid = Ellipsoid::GRS80;
    let ours = TransverseMercator::new(ellipsoid, (0.0, lon_0), k_0, (0.0, 0.0)).expect("valid");
    let points = positions((-90.0, 90.0), (lon_0 - reach, lon_0 + reach));
    let input: Vec<_> = points.iter().map(|p| (p.lat_deg, p.lon_deg)).collect();
    let a = ellipsoid.a;
    let arguments: Vec<_> = format!("-l {lon_0} -k {k_0} -e {a} {FLATTENING} -p 10")
        .split(' ')
        .map(str::to_owned)
        .collect();
    let there = tool("TransverseMercatorProj", &arguments, &input)?;
    let reverse = [arguments, vec!["-r".to_owned()]].concat();
    let map: Vec<_> = there.iter().map(|answer| answer.at).collect();
    let back = tool("TransverseMercatorProj", &reverse, &map)?;
    let mut largest = Largest::default();
    for ((point, Answer { at: (x, y), scale }), back) in points.into_iter().zip(there).zip(back) {
        let theirs = Projected { x, y };
        largest.add(ours.forward(point).expect("in the domain"), theirs, scale);
        largest.add_inverse(ours.inverse(theirs).expect("in the domain"), back.at);
    }
    println!("transverse Mercator {lon_0}, +-{reach}: {largest:?}");
    Some(largest)
}

#[test]
fn conic_agrees_over_and_beyond_every_kind_of_zone() {
    // Washington South; Alaska zone 10; a tangent cone; a southern one; Texas; near the equator.
    for (parallels, origin) in [
        ((47.333_333_333_333_3, 45.833_333_333_333_3), (45.333_333_333_333_3, -120.5)),
        ((53.833_333_333_333_3, 51.833_333_333_333_3), (51.0, -176.0)),
        ((39.0, 39.0), (39.0, -78.0)),
        ((-40.0, -30.0), (-35.0, 150.0)),
        ((27.5, 35.0), (18.0, -100.0)),
        ((10.0, 12.0), (9.0, 100.0)),
    ] {
        let latitudes = (origin.0 - 15.0, origin.0 + 15.0);
        let Some(zone) = conic(parallels, origin, latitudes, 30.0) else { return };
        assert!(zone.forward < TOLERANCE_M && zone.inverse < TOLERANCE_M, "{zone:?}");
    }
    // The whole world but the far pole: coordinates are larger than the Earth there, and both
    // sides round.
    for (parallels, origin) in [((46.0, 47.0), (45.0, -120.5)), ((10.0, 12.0), (9.0, 100.0))] {
        let Some(world) = conic(parallels, origin, (-60.0, 90.0), 180.0) else { return };
        assert!(world.ground < 2e-8 && world.inverse < 2e-8, "{world:?}");
    }
}

#[test]
fn conic_is_stable_where_the_textbook_is_not() {
    // Parallels that are equal but for rounding: PROJ 9.1.1 is 6 mm off here.
    for apart in [1e-13, 1e-7] {
        let Some(near) = conic((30.0, 30.0 + apart), (31.0, 0.0), (20.0, 40.0), 30.0) else {
            return;
        };
        assert!(near.forward < TOLERANCE_M && near.inverse < TOLERANCE_M, "{near:?}");
    }
    // Around the pole, and a cone that is nearly a plane.
    for (parallels, origin) in [((70.0, 75.0), (72.0, 0.0)), ((80.0, 89.0), (75.0, 170.0))] {
        let pole = conic(parallels, origin, (60.0, 90.0), 180.0).expect("installed");
        assert!(pole.forward < TOLERANCE_M && pole.inverse < TOLERANCE_M, "{pole:?}");
    }
    // A cone that is nearly a cylinder: its apex is 300,000 km away.
    let wide = conic((0.5, 1.5), (0.0, 10.0), (-10.0, 10.0), 30.0).expect("installed");
    assert!(wide.forward < TOLERANCE_M && wide.inverse < TOLERANCE_M, "{wide:?}");
}

#[test]
fn transverse_mercator_agrees_over_its_whole_domain() {
    for (lon_0, k_0, reach) in
        [(-123.0, 0.9996, 3.0), (177.0, 0.9999, 25.0), (-85.666_666_666_666_7, 0.999_966_667, 49.0)]
    {
        let Some(found) = transverse_mercator(lon_0, k_0, reach) else { return };
        assert!(found.forward < TOLERANCE_M && found.inverse < TOLERANCE_M, "{found:?}");
    }
}
