//! The closed-form projections against GeographicLib, an independent implementation: `ConicProj`
//! (Karney's divided differences) and `TransverseMercatorProj` (exact, by elliptic functions).

use sat3d::crs::{Ellipsoid, LambertConic, TransverseMercator};
use sat3d::grid::{LonLat, Projected};
use std::io::Write;
use std::process::{Command, Stdio};

/// 1e-8 m, the agreement that the project promises.
const TOLERANCE_M: f64 = 1e-8;
const POINTS: usize = 10_000;

/// Runs a GeographicLib tool over lines of two numbers; `None` where the tool is not installed.
fn tool(program: &str, arguments: &[String], input: &[(f64, f64)]) -> Option<Vec<(f64, f64)>> {
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
    let parse = |line: &str| {
        let mut fields = line.split_whitespace().map(|f| f.parse().expect("a number"));
        (fields.next().expect("two fields"), fields.next().expect("two fields"))
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

#[test]
fn probe() {
    let e = Ellipsoid::GRS80;
    for hw in [5.0, 20.0, 30.0, 35.0, 40.0, 45.0, 50.0, 60.0, 70.0] {
        let lon_0 = 9.0;
        let tm = TransverseMercator::new(e, (0.0, lon_0), 0.9996, (0.0, 0.0)).expect("valid");
        let pts = positions((-90.0, 90.0), (lon_0 - hw, lon_0 + hw));
        let input: Vec<_> = pts.iter().map(|p| (p.lat_deg, p.lon_deg)).collect();
        let args: Vec<String> = format!("-l {lon_0} -k 0.9996 -e {} 1/298.257222101 -p 10", e.a)
            .split(' ')
            .map(str::to_owned)
            .collect();
        let Some(out) = tool("TransverseMercatorProj", &args, &input) else { return };
        let mut args_r = args.clone();
        args_r.push("-r".into());
        let back = tool("TransverseMercatorProj", &args_r, &out).expect("x");
        let (mut f, mut r, mut eta, mut fails) = (0.0_f64, 0.0_f64, 0.0_f64, 0);
        for ((p, o), b) in pts.iter().zip(&out).zip(&back) {
            let Ok(q) = tm.forward(*p) else {
                fails += 1;
                continue;
            };
            f = f.max((q.x - o.0).abs()).max((q.y - o.1).abs());
            eta = eta.max((q.x / 6.367e6).abs());
            let i = tm.inverse(Projected { x: o.0, y: o.1 }).expect("inv");
            r = r.max(ground_distance(i, LonLat { lon_deg: b.1, lat_deg: b.0 }));
        }
        println!("tm hw {hw} eta {eta:.3} fwd {f:.2e} inv {r:.2e} fails {fails}");
    }
    for (l1, l2, l0, lo) in [
        (47.3333333333333, 45.8333333333333, 45.3333333333333, -120.5),
        (30.0, 30.0, 30.0, 0.0),
        (30.0, 30.0000001, 31.0, 0.0),
        (0.5, 1.0, 0.0, 10.0),
        (89.0, 80.0, 75.0, 170.0),
        (-40.0, -30.0, -35.0, 150.0),
        (-20.0, 60.0, 10.0, 0.0),
    ] {
        for (s, n) in [(l0 - 5.0, l0 + 5.0), (-60.0, 90.0), (-89.9, 89.9)] {
            let (s, n): (f64, f64) = (f64::max(s, -90.0), f64::min(n, 90.0));
            let c = LambertConic::two_parallels(e, (l0, lo), (l1, l2), (0.0, 0.0)).expect("valid");
            let pts = positions((s, n), (lo - 180.0, lo + 180.0));
            let mut input: Vec<_> = pts.iter().map(|p| (p.lat_deg, p.lon_deg)).collect();
            input.push((l0, lo));
            let args: Vec<String> =
                format!("-c {l1} {l2} -l {lo} -e {} 1/298.257222101 -p 10", e.a)
                    .split(' ')
                    .map(str::to_owned)
                    .collect();
            let Some(out) = tool("ConicProj", &args, &input) else { return };
            let y0 = out.last().expect("origin").1;
            let mut args_r = args.clone();
            args_r.push("-r".into());
            let back = tool("ConicProj", &args_r, &out).expect("x");
            let (mut f, mut fr, mut r, mut fails) = (0.0_f64, 0.0_f64, 0.0_f64, 0);
            for ((p, o), b) in pts.iter().zip(&out).zip(&back) {
                let Ok(q) = c.forward(*p) else {
                    fails += 1;
                    continue;
                };
                let d = (q.x - o.0).abs().max((q.y - (o.1 - y0)).abs());
                f = f.max(d);
                fr = fr.max(d / (1.0 + q.x.hypot(q.y)));
                match c.inverse(Projected { x: o.0, y: o.1 - y0 }) {
                    Ok(i) => {
                        r = r.max(ground_distance(i, LonLat { lon_deg: b.1, lat_deg: b.0 }));
                    }
                    Err(e) => panic!("{e}"),
                }
            }
            println!(
                "lcc {l1} {l2} lat {s}..{n}: fwd {f:.2e} rel {fr:.2e} inv {r:.2e} fails {fails}"
            );
        }
    }
}
