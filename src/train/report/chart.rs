//! Curves as SVG.

use crate::html::escape;
use std::fmt::Write as _;

/// Width and height of a chart, in its own units.
const SIZE: [f64; 2] = [460.0, 250.0];
/// Room for axes: left, right, above, below.
const ROOM: [f64; 4] = [56.0, 14.0, 12.0, 34.0];
/// Most points of a curve; longer ones are averaged over equal parts.
const POINTS: usize = 400;
/// Largest ratio of values that a linear axis shows.
const LINEAR: f64 = 30.0;

/// A curve: its name and its points, step and value.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Curve {
    /// Name in the legend; none for a single curve.
    pub name: String,
    /// Points in the order of steps; those that are not finite are left out.
    pub points: Vec<(f64, f64)>,
}

/// A number with about three digits.
#[must_use]
pub fn short(value: f64) -> String {
    let size = value.abs();
    match size {
        _ if !value.is_finite() => "\u{2013}".to_owned(),
        0.0 => "0".to_owned(),
        0.001..0.1 => format!("{value:.4}"),
        0.1..10.0 => format!("{value:.3}"),
        10.0..1000.0 => format!("{value:.1}"),
        1000.0..1e7 => format!("{value:.0}"),
        _ => format!("{value:.1e}"),
    }
}

/// How values become heights in the chart.
#[derive(Clone, Copy, Debug)]
struct Axis {
    low: f64,
    high: f64,
    logarithmic: bool,
}

impl Axis {
    /// Of values that are finite, at least one.
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
        if low > 0.0 && high / low > LINEAR {
            let (low, high) = (libm::log10(low), libm::log10(high));
            return Self { low: low.floor(), high: high.ceil(), logarithmic: true };
        }
        // Zero is on the axis where it is not far.
        let low = if low > 0.0 && low < 0.6 * high { 0.0 } else { low };
        let room = if high > low { 0.06 * (high - low) } else { high.abs().max(1.0) * 0.1 };
        let below = if low == 0.0 { 0.0 } else { room };
        Self { low: low - below, high: high + room, logarithmic: false }
    }

    fn share(&self, value: f64) -> f64 {
        let value = if self.logarithmic { libm::log10(value) } else { value };
        ((value - self.low) / (self.high - self.low)).clamp(0.0, 1.0)
    }

    fn ticks(&self, number: usize) -> Vec<f64> {
        if self.logarithmic {
            let step = ((self.high - self.low) / number as f64).ceil().max(1.0) as usize;
            return (self.low as i32..=self.high as i32)
                .step_by(step)
                .map(|power| libm::pow(10.0, f64::from(power)))
                .collect();
        }
        let step = nice_step((self.high - self.low) / number as f64);
        let (first, last) = ((self.low / step).ceil() as i64, (self.high / step).floor() as i64);
        (first..=last.min(first + 20)).map(|i| i as f64 * step).collect()
    }
}

/// The least of 1, 2, 5 times a power of ten that is not below `rough`.
fn nice_step(rough: f64) -> f64 {
    if !(rough.is_finite() && rough > 0.0) {
        return 1.0;
    }
    let power = libm::pow(10.0, libm::floor(libm::log10(rough)));
    let factor = [1.0, 2.0, 5.0, 10.0].into_iter().find(|f| f * power >= rough * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

/// A tick's label: as short as it can be.
fn label(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    if value.abs() >= 1e6 && value % 1e6 == 0.0 {
        return format!("{}M", value / 1e6);
    }
    if value.abs() >= 1e4 && value % 1e3 == 0.0 {
        return format!("{}k", value / 1e3);
    }
    if !(1e-4..1e7).contains(&value.abs()) {
        return format!("{value:e}");
    }
    // Steps are round, so that rounding only takes off what the product added.
    format!("{}", (value * 1e6).round() / 1e6)
}

/// A chart of curves over steps, from 0 to `steps`; empty where no curve has a point.
#[must_use]
pub fn chart(title: &str, curves: &[Curve], steps: u64) -> String {
    let curves: Vec<Curve> = curves.iter().map(thinned).collect();
    let points = || curves.iter().flat_map(|curve| &curve.points);
    if points().next().is_none() {
        return String::new();
    }
    let y = Axis::of(points().map(|(_, value)| *value));
    let x = Axis { low: 0.0, high: (steps as f64).max(1.0), logarithmic: false };
    let [width, height] = SIZE;
    let [left, right, above, below] = ROOM;
    let at_x = |value: f64| left + x.share(value) * (width - left - right);
    let at_y = |value: f64| height - below - y.share(value) * (height - above - below);
    let mut svg =
        format!("<svg viewBox=\"0 0 {width} {height}\" role=img><title>{0}</title>", escape(title));
    for tick in y.ticks(4) {
        let at = at_y(tick);
        let _ = write!(
            svg,
            "<path class=grid d=\"M{left} {at:.1}H{}\"/><text x={} y={:.1} text-anchor=end>{}</text>",
            width - right,
            left - 6.0,
            at + 4.0,
            label(tick)
        );
    }
    for tick in x.ticks(5) {
        let _ = write!(
            svg,
            "<text x={:.1} y={} text-anchor=middle>{}</text>",
            at_x(tick),
            height - below + 18.0,
            label(tick)
        );
    }
    let _ = write!(svg, "<path class=axis d=\"M{left} {:.1}H{}\"/>", height - below, width - right);
    for (series, curve) in curves.iter().enumerate() {
        let mut path = String::new();
        for (i, (step, value)) in curve.points.iter().enumerate() {
            let pen = if i == 0 { 'M' } else { 'L' };
            let _ = write!(path, "{pen}{:.1} {:.1}", at_x(*step), at_y(*value));
        }
        let _ = write!(svg, "<path class=\"line s{series}\" d=\"{path}\"/>");
        if let [(step, value)] = curve.points[..] {
            let _ = write!(
                svg,
                "<circle class=\"dot s{series}\" cx={:.1} cy={:.1} r=3 />",
                at_x(step),
                at_y(value)
            );
        }
    }
    svg += "</svg>";
    let mut figure = format!("<figure><figcaption><b>{}</b>", escape(title));
    match &curves[..] {
        [one] => {
            let last = one.points.last().map_or(f64::NAN, |(_, value)| *value);
            let _ = write!(figure, " <span>{}</span>", short(last));
        }
        several => {
            for (series, curve) in several.iter().enumerate() {
                let last = curve.points.last().map_or(f64::NAN, |(_, value)| *value);
                let _ = write!(
                    figure,
                    " <span><i class=\"key s{series}\"></i>{} {}</span>",
                    escape(&curve.name),
                    short(last)
                );
            }
        }
    }
    if y.logarithmic {
        figure += " <span>logarithmic</span>";
    }
    figure + "</figcaption>" + &svg + "</figure>\n"
}

/// Means over equal parts, so that a page does not grow with the training.
fn thinned(curve: &Curve) -> Curve {
    let finite: Vec<(f64, f64)> =
        curve.points.iter().copied().filter(|(_, value)| value.is_finite()).collect();
    let part = finite.len().div_ceil(POINTS).max(1);
    let mean = |points: &[(f64, f64)]| {
        let count = points.len() as f64;
        let sum = points.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        (sum.0 / count, sum.1 / count)
    };
    Curve { name: curve.name.clone(), points: finite.chunks(part).map(mean).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let all = [0.0, 0.012_345, 1.234_56, 123.456, 12_345.6, 2e9, f64::NAN].map(short);
        assert_eq!(all, ["0", "0.0123", "1.235", "123.5", "12346", "2.0e9", "\u{2013}"]);
        let ticks = [0.0, 0.05, 250.0, 20_000.0, 3e6, 1e-5].map(label);
        assert_eq!(ticks, ["0", "0.05", "250", "20k", "3M", "1e-5"]);
    }

    #[test]
    fn axes_hold_their_values_and_turn_logarithmic_where_they_must() {
        let axis = Axis::of([0.5, 2.0].into_iter());
        assert!(!axis.logarithmic && axis.low == 0.0 && axis.high > 2.0);
        let wide = Axis::of([0.02, 70.0].into_iter());
        assert!(wide.logarithmic);
        assert_eq!(wide.ticks(4), [0.01, 0.1, 1.0, 10.0, 100.0]);
        let flat = Axis::of([3.0, 3.0].into_iter());
        assert!(flat.low < 3.0 && flat.high > 3.0);
        let below = Axis::of([-4.0, -1.0].into_iter());
        assert!(!below.logarithmic && below.low < -4.0 && !below.ticks(4).is_empty());
    }

    #[test]
    fn long_curves_are_thinned_and_gaps_closed() {
        let points = (0..10_000).map(|i| (f64::from(i), if i % 2 == 0 { 1.0 } else { f64::NAN }));
        let curve = Curve { name: "a".into(), points: points.collect() };
        let thin = thinned(&curve);
        assert!(thin.points.len() <= POINTS && thin.points.iter().all(|p| p.1 == 1.0));
        assert!(chart("x", &[Curve::default()], 10).is_empty());
        let svg = chart("<x>", &[curve], 10_000);
        assert!(svg.contains("&lt;x&gt;") && !svg.contains("NaN"));
    }
}
