//! Correlations under a large height, normal equations that determine next to nothing, a city at
//! 4,000 m, each naive form beside ours; `docs/numerics.md`.

use super::fit::{Moments, UNKNOWNS, solve};
use super::tests::{City, PIXEL_M, VIEW, View};
use super::*;
use crate::oracle::{Real, nearest, off, real};
use crate::random::{key, normal};

#[test]
fn a_correlation_keeps_its_digits_at_4_000_m() {
    // Two surfaces of which the second follows the first, with centimetres of relief.
    let pair = |k: u64| {
        let a = 4000.0 + 0.01 * normal(key(&[1, k]));
        let b = 0.6 * a + 0.008 * normal(key(&[2, k]));
        (f64::from(a as f32), f64::from(b as f32))
    };
    let pairs: Vec<(f64, f64)> = (0..2000).map(pair).collect();
    // The definition in 48 digits.
    let count = real(pairs.len() as f64);
    let sum = |f: &dyn Fn(&(Real, Real)) -> Real, of: &[(Real, Real)]| {
        of.iter().fold(real(0.0), |sum, pair| sum + f(pair))
    };
    let exact: Vec<(Real, Real)> = pairs.iter().map(|(a, b)| (real(*a), real(*b))).collect();
    let (a, b) = (sum(&|p| p.0.clone(), &exact) / &count, sum(&|p| p.1.clone(), &exact) / &count);
    let centred: Vec<(Real, Real)> = exact.iter().map(|p| (&p.0 - &a, &p.1 - &b)).collect();
    let [aa, bb, ab] = [
        sum(&|p| &p.0 * &p.0, &centred),
        sum(&|p| &p.1 * &p.1, &centred),
        sum(&|p| &p.0 * &p.1, &centred),
    ];
    let truth = ab / (aa * bb).sqrt();

    let (origin_a, origin_b) = pairs[0];
    let (mut ours, mut naive) = (Moments::default(), Moments::default());
    let mut narrow = [0.0_f32; 5];
    for (a, b) in &pairs {
        ours.add(a - origin_a, b - origin_b);
        naive.add(*a, *b);
        let (a, b) = (*a as f32, *b as f32);
        for (sum, value) in narrow.iter_mut().zip([a, b, a * a, b * b, a * b]) {
            *sum += value;
        }
    }
    let [a, b, aa, bb, ab] = narrow.map(|sum| sum / 2000.0);
    let narrow = (ab - a * b) / ((aa - a * a) * (bb - b * b)).sqrt();
    let (ours, naive) = (off(ours.correlation(), &truth), off(naive.correlation(), &truth));
    println!(
        "truth {}, ours {ours:e}, sums of squares {naive:e}, in f32 {narrow}",
        nearest(&truth)
    );
    assert!(ours < 1e-14, "{ours:e}");
    assert!(naive > 1e-7, "{naive:e}");
    let usable = (f64::from(narrow) - nearest(&truth)).abs() < 0.1;
    assert!(!usable, "{narrow}");
}

/// Gauss's elimination with row exchanges, which takes every pivot but 0.
fn naive_solve(normal: &[[f64; UNKNOWNS + 1]; UNKNOWNS], n: usize) -> Option<Vec<f64>> {
    let mut rows: Vec<Vec<f64>> = (0..n)
        .map(|i| (0..n).map(|j| normal[i.max(j)][i.min(j)]).chain([normal[i][UNKNOWNS]]).collect())
        .collect();
    for i in 0..n {
        let pivot = (i..n).max_by(|a, b| rows[*a][i].abs().total_cmp(&rows[*b][i].abs()))?;
        rows.swap(i, pivot);
        if rows[i][i] == 0.0 {
            return None;
        }
        let above = rows[i].clone();
        for row in rows.iter_mut().skip(i + 1) {
            let factor = row[i] / above[i];
            for (value, above) in row.iter_mut().zip(&above) {
                *value -= factor * above;
            }
        }
    }
    let mut solution = vec![0.0; n];
    for i in (0..n).rev() {
        let rest: f64 = (i + 1..n).map(|j| rows[i][j] * solution[j]).sum();
        solution[i] = (rows[i][n] - rest) / rows[i][i];
    }
    Some(solution)
}

/// The same in 48 digits.
fn exact_solve(normal: &[[f64; UNKNOWNS + 1]; UNKNOWNS], n: usize) -> Vec<Real> {
    let mut rows: Vec<Vec<Real>> = (0..n)
        .map(|i| {
            let own = (0..n).map(|j| real(normal[i.max(j)][i.min(j)]));
            own.chain([real(normal[i][UNKNOWNS])]).collect()
        })
        .collect();
    for i in 0..n {
        let above = rows[i].clone();
        for row in rows.iter_mut().skip(i + 1) {
            let factor = &row[i] / &above[i];
            for (value, above) in row.iter_mut().zip(&above) {
                *value = &*value - &factor * above;
            }
        }
    }
    let mut solution = vec![real(0.0); n];
    for i in (0..n).rev() {
        let rest = (i + 1..n).fold(real(0.0), |sum, j| sum + &rows[i][j] * &solution[j]);
        solution[i] = (&rows[i][n] - rest) / &rows[i][i];
    }
    solution
}

/// Normal equations of three columns in very different units, of which the third is the sum of the
/// others plus a part of its own.
fn normal_equations(own: f64) -> [[f64; UNKNOWNS + 1]; UNKNOWNS] {
    let truth = [0.3, -2.0, 5.0];
    let mut equations = [[0.0; UNKNOWNS + 1]; UNKNOWNS];
    for k in 0..400 {
        let draw = |stream: u64| normal(key(&[stream, k]));
        let (a, b) = (draw(1), draw(2));
        // Gradients of a hundredth, heights of a hundred metres.
        let row = [0.01 * a, 100.0 * b, 3.0 * (a + b + own * draw(3))];
        let right: f64 = row.iter().zip(truth).map(|(r, t)| r * t).sum();
        for i in 0..3 {
            for j in 0..=i {
                equations[i][j] += row[i] * row[j];
            }
            equations[i][UNKNOWNS] += row[i] * right;
        }
    }
    equations
}

#[test]
fn normal_equations_are_solved_to_what_they_determine_or_refused() {
    for own in [1.0, 0.1, 5e-3] {
        let equations = normal_equations(own);
        let truth = exact_solve(&equations, 3);
        let (found, _) = solve(&equations, 3).expect("regular");
        // By what each unknown does to the heights.
        let effect = |i: usize| equations[i][i].sqrt();
        let largest = (0..3).map(|i| nearest(&truth[i]).abs() * effect(i)).fold(0.0, f64::max);
        for i in 0..3 {
            let relative = off(found[i], &truth[i]) * effect(i) / largest;
            // The condition after scaling is about 1 / own^2.
            println!("{own:e}: {relative:.1e}");
            assert!(relative < 1e-14 / (own * own), "{own:e}: {relative:e}");
        }
    }
    // A column that is the others' sum but for rounding: elimination makes numbers of it.
    let mut invented = 0.0_f64;
    for own in [1e-4, 1e-8, 1e-9, 1e-12, 0.0] {
        let equations = normal_equations(own);
        assert!(solve(&equations, 3).is_none(), "{own:e}");
        if let Some(naive) = naive_solve(&equations, 3) {
            println!("{own:e}: {naive:?}");
            invented = invented.max((naive[0] - 0.3).abs());
        }
    }
    assert!(invented > 1.0, "{invented}");
    // Nothing and no number are refused as well.
    assert!(solve(&[[0.0; UNKNOWNS + 1]; UNKNOWNS], 3).is_none());
    assert!(solve(&[[f64::NAN; UNKNOWNS + 1]; UNKNOWNS], 3).is_none());
}

#[test]
fn a_city_at_4_000_m_is_registered_as_at_sea_level() {
    let city = City::new(3, (4.0, 24.0));
    let view = View { shift: (1.3, -0.7), ..VIEW };
    let (prediction, truth, ground) = (city.prediction(3, view), city.truth(), city.bare());
    let lifted = |surface: &Surface, by: f32| {
        let values = surface.values.iter().map(|h| h + by).collect();
        Surface::new(surface.width, surface.height, values)
    };
    let at = |by: f32| {
        let [p, t, g] = [&prediction, &truth, &ground].map(|surface| lifted(surface, by));
        of_image(&p, &t, Some(&g), (PIXEL_M, PIXEL_M)).expect("an estimate")
    };
    let (low, high) = (at(0.0), at(4000.0));
    println!("{low:?}\n{high:?}");
    assert!((low.east_m - 1.3).abs() < 0.3 && (low.north_m - 0.7).abs() < 0.3, "{low:?}");
    // f32 has steps of 0.24 mm there.
    for (low, high) in [
        (low.east_m, high.east_m),
        (low.north_m, high.north_m),
        (low.vertical_m, high.vertical_m),
        (low.correlation, high.correlation),
    ] {
        assert!((low - high).abs() < 2e-3, "{low} {high}");
    }
}
