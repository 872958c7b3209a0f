//! Test files in the form of PROJ's `gie`, run twice: by a runner of our own against the closed
//! forms (in both builds), and by `gie` itself, so that PROJ vouches for what they say.

use sat3d::crs::{
    CrsError, CrsSpec, Ellipsoid, LambertConic, ResolveOptions, ResolvedCrs, TransverseMercator,
    closed_form_codes, resolve,
};
use sat3d::grid::{LonLat, Projected};
use std::collections::HashMap;
use std::path::PathBuf;
use std::process::Command;

/// What an `operation` line stands for.
enum Operation {
    Conic(LambertConic),
    TransverseMercator(TransverseMercator),
    /// A CRS whose closed form says of itself that it is this pipeline.
    Crs(Box<ResolvedCrs>),
}

impl Operation {
    fn parse(text: &str, by_definition: &HashMap<String, u32>) -> Self {
        if text.starts_with("+proj=pipeline") {
            let code = by_definition
                .get(text)
                .unwrap_or_else(|| panic!("no closed form defines itself as {text}"));
            let crs = resolve(&CrsSpec::from_epsg(*code), &ResolveOptions::default());
            return Self::Crs(Box::new(crs.expect("in the table")));
        }
        let parameters: HashMap<&str, &str> = text
            .split_whitespace()
            .map(|word| word.trim_start_matches('+').split_once('=').expect("key=value"))
            .collect();
        let number = |key: &str| -> f64 {
            parameters.get(key).unwrap_or_else(|| panic!("{key}")).parse().expect("a number")
        };
        let ellipsoid = match parameters["ellps"] {
            "GRS80" => Ellipsoid::GRS80,
            "WGS84" => Ellipsoid::WGS84,
            "clrk66" => Ellipsoid { a: 6_378_206.4, f: (6_378_206.4 - 6_356_583.8) / 6_378_206.4 },
            "airy" => Ellipsoid { a: 6_377_563.396, f: 1.0 / 299.324_964_6 },
            other => panic!("ellipsoid {other}"),
        };
        let origin = (number("lat_0"), number("lon_0"));
        let false_origin = (number("x_0"), number("y_0"));
        match parameters["proj"] {
            "tmerc" => Self::TransverseMercator(
                TransverseMercator::new(ellipsoid, origin, number("k"), false_origin)
                    .expect("valid"),
            ),
            "lcc" if parameters.contains_key("lat_2") => {
                let parallels = (number("lat_1"), number("lat_2"));
                Self::Conic(
                    LambertConic::two_parallels(ellipsoid, origin, parallels, false_origin)
                        .expect("valid"),
                )
            }
            "lcc" => Self::Conic(
                LambertConic::one_parallel(ellipsoid, origin, number("k_0"), false_origin)
                    .expect("valid"),
            ),
            other => panic!("projection {other}"),
        }
    }

    fn forward(&self, at: (f64, f64)) -> Result<(f64, f64), CrsError> {
        let at = LonLat { lon_deg: at.0, lat_deg: at.1 };
        let found = match self {
            Self::Conic(conic) => conic.forward(at)?,
            Self::TransverseMercator(mercator) => mercator.forward(at)?,
            Self::Crs(crs) => crs.projection.forward(at)?,
        };
        Ok((found.x, found.y))
    }

    fn inverse(&self, at: (f64, f64)) -> Result<(f64, f64), CrsError> {
        let at = Projected { x: at.0, y: at.1 };
        let found = match self {
            Self::Conic(conic) => conic.inverse(at)?,
            Self::TransverseMercator(mercator) => mercator.inverse(at)?,
            Self::Crs(crs) => crs.projection.inverse(at)?,
        };
        Ok((found.lon_deg, found.lat_deg))
    }

    fn run(&self, at: (f64, f64), forward: bool) -> Result<(f64, f64), CrsError> {
        if forward { self.forward(at) } else { self.inverse(at) }
    }
}

/// Distance of two results: as numbers for map coordinates, in metres for degrees.
fn apart(a: (f64, f64), b: (f64, f64), degrees: bool) -> f64 {
    if !degrees {
        return libm::hypot(a.0 - b.0, a.1 - b.1);
    }
    let wgs84 = Ellipsoid::WGS84;
    libm::hypot(
        (a.0 - b.0).to_radians() * wgs84.parallel_radius(a.1),
        (a.1 - b.1).to_radians() * wgs84.meridian_radius(a.1),
    )
}

fn pair(words: &[&str]) -> (f64, f64) {
    let number = |i: usize| words[i].parse().expect("a number");
    (number(0), number(1))
}

fn tolerance(words: &[&str]) -> f64 {
    let factor = match words[1] {
        "m" => 1.0,
        "mm" => 1e-3,
        "um" => 1e-6,
        other => panic!("unit {other}"),
    };
    words[0].parse::<f64>().expect("a number") * factor
}

/// Runs a file; returns the number of checks in it.
fn run(name: &str, text: &str, by_definition: &HashMap<String, u32>) -> usize {
    let (_, body) = text.split_once("<gie>").expect("<gie>");
    let (body, _) = body.split_once("</gie>").expect("</gie>");
    let mut operation: Option<Operation> = None;
    let (mut limit, mut forward, mut accepted, mut checks) = (5e-4, true, (0.0, 0.0), 0);
    for line in body.lines().filter(|line| !line.starts_with('#')) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let Some((statement, rest)) = words.split_first() else { continue };
        let current = || operation.as_ref().expect("an operation first");
        match *statement {
            "operation" => {
                operation = Some(Operation::parse(&rest.join(" "), by_definition));
                (limit, forward) = (5e-4, true);
            }
            "tolerance" => limit = tolerance(rest),
            "direction" => forward = rest == ["forward"],
            "accept" => accepted = pair(rest),
            "expect" => {
                let found = current().run(accepted, forward);
                if rest == ["failure"] {
                    assert!(found.is_err(), "{name}: {line}: {found:?} for {accepted:?}");
                } else {
                    let found = found.unwrap_or_else(|e| panic!("{name}: {line}: {e}"));
                    let error = apart(found, pair(rest), !forward);
                    assert!(error <= limit, "{name}: {line}: got {found:?}, {error:e} off");
                }
                checks += 1;
            }
            "roundtrip" => {
                let there = current().run(accepted, forward).expect("runs");
                let back = current().run(there, !forward).expect("runs");
                let error = apart(back, accepted, forward);
                assert!(error <= tolerance(&rest[1..]), "{name}: {line}: {error:e} off");
                checks += 1;
            }
            other => panic!("{name}: unknown statement {other}"),
        }
    }
    checks
}

fn files() -> Vec<PathBuf> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fixtures/crs");
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .expect("fixtures/crs")
        .map(|entry| entry.expect("readable").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "gie"))
        .collect();
    files.sort();
    assert!(files.len() >= 3);
    files
}

#[test]
fn closed_forms_pass_the_gie_files() {
    let by_definition: HashMap<String, u32> = closed_form_codes()
        .map(|code| {
            let crs = resolve(&CrsSpec::from_epsg(code), &ResolveOptions::default());
            (crs.expect("in the table").operation.definition, code)
        })
        .collect();
    let mut checks = 0;
    for path in files() {
        let text = std::fs::read_to_string(&path).expect("readable");
        checks += run(&path.display().to_string(), &text, &by_definition);
    }
    assert!(checks >= 20, "only {checks} checks");
}

#[test]
fn proj_passes_the_gie_files() {
    for path in files() {
        let output = match Command::new("gie").arg(&path).output() {
            Ok(output) => output,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                eprintln!("skipped: `gie` (PROJ's tools) is not installed");
                return;
            }
            Err(error) => panic!("gie: {error}"),
        };
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{}: {said}", path.display());
    }
}
