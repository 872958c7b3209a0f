//! The nearest triangle by cells, beside all triangles tried.

use super::distance::distance_m;
use super::near::{Found, Near, squared_distance};
use super::tests::Draws;

/// Vertices and triangles of many kinds: small, long, flat along an axis, a line, a point.
fn random_surface(draws: &mut Draws, count: usize) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let mut vertices: Vec<[f64; 3]> = Vec::new();
    let mut triangles = Vec::new();
    for _ in 0..count {
        let mut draw = |size: f64| [0; 3].map(|_| (draws.next() - 0.5) * size);
        let middle = draw(40.0);
        let size = [0.3, 2.0, 15.0][triangles.len() % 3];
        let mut corners = [draw(size), draw(size), draw(size)];
        match triangles.len() % 7 {
            1 => corners[2] = corners[1],
            2 => corners = [corners[0]; 3],
            3 => corners[2] = [0, 1, 2].map(|k| (corners[0][k] + corners[1][k]) / 2.0),
            4 => corners.iter_mut().for_each(|corner| corner[2] = 0.0),
            5 => corners.iter_mut().for_each(|corner| corner[0] = corner[0].round()),
            _ => {}
        }
        let first = vertices.len() as u32;
        vertices.extend(corners.map(|corner| [0, 1, 2].map(|k| middle[k] + corner[k])));
        triangles.push([first, first + 1, first + 2]);
    }
    (vertices, triangles)
}

fn tried(vertices: &[[f64; 3]], triangles: &[[u32; 3]], point: [f64; 3]) -> f64 {
    triangles.iter().fold(f64::INFINITY, |least, corners| {
        least.min(squared_distance(point, corners.map(|corner| vertices[corner as usize])))
    })
}

#[test]
fn the_nearest_of_all_is_found() {
    let mut draws = Draws(5);
    for (count, side, cells) in
        [(1, 1.0, 1000), (2, 0.5, 10), (60, 0.4, 1 << 20), (300, 3.0, 1 << 20), (300, 1.0, 50)]
    {
        let (vertices, triangles) = random_surface(&mut draws, count);
        let near = Near::new(&vertices, &triangles, side, cells);
        for number in 0..400 {
            let size = [45.0, 60.0, 1e4][number % 3];
            let point = match number % 5 {
                // A vertex, a place on a wall between cells, any.
                0 => vertices[(draws.next() * vertices.len() as f64) as usize],
                1 => [0, 1, 2].map(|k| near.corner()[k] + side * (draws.next() * 30.0).floor()),
                _ => [0; 3].map(|_| (draws.next() - 0.5) * size),
            };
            let least = tried(&vertices, &triangles, point);
            let found = near.nearest(point, 0.0, f64::INFINITY).expect("something is nearest");
            assert_eq!(found.squared, least, "{count} triangles, {point:?}");
            let corners = triangles[found.triangle as usize].map(|c| vertices[c as usize]);
            assert_eq!(squared_distance(point, corners), least);
            // Within a limit: exactly what is nearer than it.
            for (limit, is_within) in [
                (least * 0.9, false),
                (least, false),
                (least.next_up(), true),
                (least * 2.0 + 1e-9, true),
            ] {
                let within = near.nearest(point, 0.0, limit);
                assert_eq!(within.map(|found| found.squared), is_within.then_some(least));
            }
            let enough = least * 3.0;
            let any = near.nearest(point, enough, f64::INFINITY).map(|found| found.squared);
            assert!(any.is_some_and(|squared| squared >= least && squared <= enough));
        }
    }
}

#[test]
fn what_is_nowhere() {
    let point = [1.0, 2.0, 3.0];
    let vertices = [point];
    let near = Near::new(&vertices, &[], 1.0, 10);
    assert_eq!(near.nearest(point, 0.0, f64::INFINITY), None);
    for side in [0.0, 1.0, f64::NAN] {
        let near = Near::new(&vertices, &[[0; 3]], side, 10);
        let found = Found { triangle: 0, squared: 4.0 };
        assert_eq!(near.nearest([1.0, 2.0, 5.0], 0.0, f64::INFINITY), Some(found), "{side}");
        assert_eq!(near.nearest([f64::NAN; 3], 0.0, f64::INFINITY), None);
    }
    let nowhere = [[f64::NAN; 3], [f64::INFINITY; 3], [f64::NEG_INFINITY; 3], point];
    for triangle in [[0; 3], [1; 3], [0, 1, 2], [1, 2, 3]] {
        Near::new(&nowhere, &[triangle, [3; 3]], 1.0, 10).nearest(point, 0.0, f64::INFINITY);
    }
    // A surface of which nothing is left is not near it.
    assert_eq!(distance_m(&[point], &[[0; 3]], &[]), f64::INFINITY);
    assert_eq!(distance_m(&[point], &[], &[[0; 3]]), 0.0);
}

#[test]
fn the_distance_is_that_of_all_pairs() {
    let mut draws = Draws(9);
    for _ in 0..20 {
        // Triangles so small that no points lie between their corners.
        let (vertices, mut triangles) = random_surface(&mut draws, 90);
        triangles = triangles.into_iter().step_by(3).collect();
        let some: Vec<[u32; 3]> = triangles.iter().step_by(4).copied().collect();
        let far =
            triangles.iter().flatten().map(|c| tried(&vertices, &some, vertices[*c as usize]));
        let most = far.fold(0.0, f64::max).sqrt();
        let found = distance_m(&vertices, &triangles, &some);
        assert!(found >= most && found < most + 0.3, "{found} {most}");
    }
}
