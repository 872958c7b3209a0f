//! The mesher beside scikit-image (Lewiner's marching cubes) and PyMCubes on the same grids.
//!
//! Set `SAT3D_TEST_PYTHON` (or `SAT3D_PYTHON`) to an interpreter with scikit-image, PyMCubes and scipy.
#![allow(clippy::unwrap_used, reason = "a test may fail")]

use crate::mesh_support;

use mesh_support::golden;
use sat3d_model::mesh::{Axis, mesh_grid};
use std::io::Write;
use std::process::Command;

/// Reads grid and mesh, all in steps of the grid; prints, for each of the two libraries: its vertices and
/// triangles, the mean, root mean square and largest of the symmetric distances (in steps), and
/// area and volume of ours relative to its own.
const SCRIPT: &str = r#"
import sys, numpy
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes
import mcubes

folder, shape = sys.argv[1], [int(v) for v in sys.argv[2:5]]
grid = numpy.fromfile(folder + "/grid", "<f4").reshape(shape)
ours = (numpy.fromfile(folder + "/vertices", "<f8").reshape(-1, 3),
        numpy.fromfile(folder + "/triangles", "<u4").reshape(-1, 3).astype(int))

def to_triangles(p, a, b, c):
    # Ericson, Real-Time Collision Detection, section 5.1.5, for whole arrays.
    dot = lambda u, v: (u * v).sum(-1)
    ab, ac = b - a, c - a
    d1, d2 = dot(ab, p - a), dot(ac, p - a)
    d3, d4 = dot(ab, p - b), dot(ac, p - b)
    d5, d6 = dot(ab, p - c), dot(ac, p - c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    with numpy.errstate(all="ignore"):
        total = va + vb + vc
        q = a + ab * (vb / total)[..., None] + ac * (vc / total)[..., None]
        pick = lambda mask, value: numpy.where(mask[..., None], value, q)
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        q = pick((va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0), b + t[..., None] * (c - b))
        q = pick((vb <= 0) & (d2 >= 0) & (d6 <= 0), a + (d2 / (d2 - d6))[..., None] * ac)
        q = pick((d6 >= 0) & (d5 <= d6), c)
        q = pick((vc <= 0) & (d1 >= 0) & (d3 <= 0), a + (d1 / (d1 - d3))[..., None] * ab)
        q = pick((d3 >= 0) & (d4 <= d3), b)
        q = pick((d1 <= 0) & (d2 <= 0), a)
    return numpy.sqrt(dot(p - q, p - q))

def one_way(points, mesh):
    corners = mesh[0][mesh[1]]
    _, near = cKDTree(corners.mean(1)).query(points, k=min(24, len(corners)))
    best = numpy.full(len(points), numpy.inf)
    for k in range(near.shape[1]):
        best = numpy.fmin(best, to_triangles(points, *corners[near[:, k]].transpose(1, 0, 2)))
    return best

def samples(mesh):
    corners = mesh[0][mesh[1]]
    weights = numpy.random.default_rng(1).dirichlet([1, 1, 1], (2, len(corners)))
    return numpy.concatenate([mesh[0]] + [(corners * w[..., None]).sum(1) for w in weights])

def measure(mesh):
    a, b, c = mesh[0][mesh[1]].transpose(1, 0, 2)
    n = numpy.cross(b - a, c - a)
    return numpy.linalg.norm(n, axis=1).sum() / 2, abs((n * a).sum()) / 6

lewiner = marching_cubes(grid, 5.0, allow_degenerate=True)[:2]
classic = mcubes.marching_cubes(grid.astype(numpy.float64), 5.0)
for theirs in (lewiner, classic):
    theirs = (numpy.asarray(theirs[0], float), numpy.asarray(theirs[1]).astype(int))
    d = numpy.concatenate([one_way(samples(ours), theirs), one_way(samples(theirs), ours)])
    (area, volume), (their_area, their_volume) = measure(ours), measure(theirs)
    print(len(theirs[0]), len(theirs[1]), d.mean(), numpy.sqrt((d * d).mean()), d.max(),
          area / their_area - 1, volume / their_volume - 1)
"#;

fn compare(name: &str, shape: [usize; 3], values: &[f32]) {
    let given = ["SAT3D_TEST_PYTHON", "SAT3D_PYTHON"].iter().find_map(std::env::var_os);
    let python = given.unwrap_or_else(|| "python3".into());
    let probe = Command::new(&python).args(["-c", "import skimage, mcubes, scipy"]).output();
    if !probe.is_ok_and(|output| output.status.success()) {
        // The test harness hides what `eprintln!` says; this reaches the terminal.
        let what = "no python with skimage, mcubes and scipy (set SAT3D_TEST_PYTHON)";
        let _ = writeln!(std::io::stderr(), "SKIPPED {name}: {what}");
        return;
    }
    // Both libraries leave a mesh open at the border: the grids here are 0 there.
    let axis = |n: usize| Axis::new(-0.5, (0..n).map(|k| k as f64), n as f64 - 0.5).unwrap();
    let surface = mesh_grid(&shape.map(axis), values, 5.0).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let save =
        |name: &str, bytes: Vec<u8>| std::fs::write(folder.path().join(name), bytes).unwrap();
    save("grid", values.iter().flat_map(|v| v.to_le_bytes()).collect());
    save("vertices", surface.vertices.iter().flatten().flat_map(|v| v.to_le_bytes()).collect());
    save("triangles", surface.triangles.iter().flatten().flat_map(|v| v.to_le_bytes()).collect());
    let ran = Command::new(python)
        .args(["-c", SCRIPT])
        .arg(folder.path())
        .args(shape.map(|n| n.to_string()))
        .output()
        .unwrap();
    assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
    let text = String::from_utf8_lossy(&ran.stdout);
    let ours = [surface.vertices.len(), surface.triangles.len()];
    eprintln!("{name}: {ours:?} vertices and triangles");
    for (library, line) in ["scikit-image", "PyMCubes"].into_iter().zip(text.lines()) {
        let numbers: Vec<f64> = line.split(' ').map(|v| v.parse().unwrap()).collect();
        let [vertices, triangles, mean, rms, largest, area, volume] = numbers[..] else {
            panic!("{line}")
        };
        eprintln!(
            "  {library}: {vertices} and {triangles}; distance mean {mean:.1e}, rms {rms:.1e}, largest \
             {largest:.2} steps; area {area:+.1e}, volume {volume:+.1e}"
        );
        assert!((vertices / ours[0] as f64 - 1.0).abs() < 0.01, "{library}: {line}");
        assert!(mean < 0.02 && rms < 0.05 && largest < 1.0, "{library}: {line}");
        assert!(area.abs() < 0.02 && volume.abs() < 0.02, "{library}: {line}");
    }
}

#[test]
fn smooth_bodies() {
    let n = 48;
    let values: Vec<f32> = (0..n * n * n)
        .map(|k| {
            let [x, y, z] = [k / n / n, k / n % n, k % n].map(|v| v as f64 / (n - 1) as f64 - 0.5);
            let waves = libm::cos(23.0 * x) + libm::cos(19.0 * y) + libm::cos(29.0 * z);
            let fade = (1.0 - 4.4 * (x * x + y * y + z * z)).max(0.0);
            (fade * (5.0 + 2.0 * waves) * 1.7) as f32
        })
        .collect();
    compare("waves", [n, n, n], &values);
}

#[test]
fn the_references_grids() {
    for config in ["tiny", "full"] {
        let Some(grid) = golden(config, "08_grid") else { continue };
        let (mut values, n) = (grid.f32("grid64_raw"), 64);
        for (index, value) in values.iter_mut().enumerate() {
            let point = [index / n / n, index / n % n, index % n];
            if point.iter().any(|k| !(6..n - 6).contains(k)) {
                *value = 0.0;
            }
        }
        compare(config, [n, n, n], &values);
    }
}
