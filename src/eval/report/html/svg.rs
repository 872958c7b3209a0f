//! Drawing charts: scales, ticks.

use crate::eval::report::number::fixed;
use crate::html::escape;

/// A pixel position with one decimal, as short as it can be.
pub(super) fn px(value: f64) -> String {
    let text = fixed(value, 1);
    text.strip_suffix(".0").map_or_else(|| text.clone(), str::to_owned)
}

/// A linear scale from values to pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scale {
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) from: f64,
    pub(super) to: f64,
}

impl Scale {
    /// Where a value lies; values beyond the ends lie at the ends.
    pub(super) fn at(&self, value: f64) -> f64 {
        let share = (value - self.low) / (self.high - self.low);
        self.from + share.clamp(0.0, 1.0) * (self.to - self.from)
    }

    /// Round values on the scale, about `number` of them, with as many decimals as they need.
    pub(super) fn ticks(&self, number: usize) -> Vec<(f64, String)> {
        let step = nice_step((self.high - self.low) / number.max(1) as f64);
        let whole = |digits: &usize| {
            let scaled = step * libm::pow(10.0, *digits as f64);
            (scaled - scaled.round()).abs() < 1e-6 * scaled
        };
        let digits = (0..6).find(whole).unwrap_or(6);
        let first = (self.low / step - 1e-6).ceil() as i64;
        let last = (self.high / step + 1e-6).floor() as i64;
        (first..=last.min(first + 50))
            .map(|i| (i as f64 * step, fixed(i as f64 * step, digits)))
            .collect()
    }
}

/// The least of 1, 2, 2.5, 5 times a power of ten that is not below `rough` (1 when that is not a
/// positive number).
pub(super) fn nice_step(rough: f64) -> f64 {
    if !(rough.is_finite() && rough > 0.0) {
        return 1.0;
    }
    let power = libm::pow(10.0, libm::floor(libm::log10(rough)));
    let factor = [1.0, 2.0, 2.5, 5.0, 10.0].into_iter().find(|f| f * power >= rough * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

/// A figure: the plot's frame with its axes; the caller adds marks and ends it.
pub(super) struct Plot {
    /// The SVG so far.
    pub(super) svg: String,
    /// Values across.
    pub(super) x: Scale,
    /// Values up.
    pub(super) y: Scale,
}

/// Width of every chart, in its own units.
pub(super) const WIDTH: f64 = 460.0;
/// Height of most charts.
pub(super) const HEIGHT: f64 = 300.0;
/// Room for axes, left of the plot, right of it, above and below.
const LEFT: f64 = 52.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 18.0;
const BOTTOM: f64 = 44.0;

impl Plot {
    /// A plot of these ranges with grid lines, ticks and axis titles.
    pub(super) fn new(
        title: &str,
        description: &str,
        x: ([f64; 2], &str),
        y: ([f64; 2], &str),
    ) -> Self {
        let [[left, right], [low, high]] = [x.0, y.0];
        let x_scale = Scale { low: left, high: right, from: LEFT, to: WIDTH - RIGHT };
        let y_scale = Scale { low, high, from: HEIGHT - BOTTOM, to: TOP };
        let mut svg = open(title, description, HEIGHT);
        let (bottom, end) = (px(HEIGHT - BOTTOM), px(WIDTH - RIGHT));
        for (value, label) in x_scale.ticks(8) {
            let at = px(x_scale.at(value));
            svg += &format!(
                "<path class=grid d=\"M{at} {}V{bottom}\"/><text class=tick x={at} y={} \
                 text-anchor=middle>{label}</text>",
                px(TOP),
                px(HEIGHT - BOTTOM + 16.0),
            );
        }
        for (value, label) in y_scale.ticks(5) {
            let at = y_scale.at(value);
            svg += &format!(
                "<path class=grid d=\"M{} {}H{end}\"/><text class=tick x={} y={} \
                 text-anchor=end>{label}</text>",
                px(LEFT),
                px(at),
                px(LEFT - 6.0),
                px(at + 4.0),
            );
        }
        let middle = (TOP + HEIGHT - BOTTOM) / 2.0;
        svg += &format!(
            "<path class=axis d=\"M{} {bottom}H{end}\"/>\
             <text class=label x={} y={} text-anchor=middle>{}</text>\
             <text class=label transform=\"translate(13 {})rotate(-90)\" text-anchor=middle>{}</text>",
            px(LEFT),
            px((LEFT + WIDTH - RIGHT) / 2.0),
            px(HEIGHT - 8.0),
            escape(x.1),
            px(middle),
            escape(y.1),
        );
        Self { svg, x: x_scale, y: y_scale }
    }

    /// A vertical line from top to bottom with a name at its upper end.
    pub(super) fn mark_x(&mut self, value: f64, name: &str, class: &str) {
        if !(value >= self.x.low && value <= self.x.high) {
            return;
        }
        let at = px(self.x.at(value));
        self.svg += &format!(
            "<path class=\"mark {class}\" d=\"M{at} {}V{}\"/><text class=\"tick {class}\" x={at} y={} \
             text-anchor=middle>{}</text>",
            px(self.y.to),
            px(self.y.from),
            px(self.y.to - 5.0),
            escape(name),
        );
    }

    /// A path through points; a point with NaN breaks it.
    pub(super) fn path(&self, points: impl Iterator<Item = (f64, f64)>) -> String {
        let mut path = String::new();
        let mut pen = 'M';
        for (x, y) in points {
            if x.is_nan() || y.is_nan() {
                pen = 'M';
                continue;
            }
            path += &format!("{pen}{} {}", px(self.x.at(x)), px(self.y.at(y)));
            pen = 'L';
        }
        path
    }

    /// The finished figure.
    pub(super) fn end(mut self) -> String {
        self.svg += "</svg>";
        self.svg
    }
}

/// The start of an SVG with its name and description for those who do not see it.
pub(super) fn open(title: &str, description: &str, height: f64) -> String {
    format!(
        "<svg viewBox=\"0 0 {} {}\" role=img><title>{}</title><desc>{}</desc>",
        px(WIDTH),
        px(height),
        escape(title),
        escape(description),
    )
}

/// A chart with its caption.
pub(super) fn figure(svg: &str, caption: &str) -> String {
    format!("<figure>{svg}<figcaption>{caption}</figcaption></figure>\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round() {
        for (rough, step) in [(0.3, 0.5), (1.0, 1.0), (2.1, 2.5), (26.0, 50.0), (9.9e-4, 1e-3)] {
            assert!((nice_step(rough) / step - 1.0).abs() < 1e-9, "{rough}");
        }
        for odd in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(nice_step(odd), 1.0);
        }
    }

    #[test]
    fn ticks_lie_on_the_scale_and_say_their_value() {
        let scale = Scale { low: -1.0, high: 1.0, from: 0.0, to: 100.0 };
        let ticks = scale.ticks(4);
        let labels: Vec<&str> = ticks.iter().map(|t| t.1.as_str()).collect();
        assert_eq!(labels, ["-1.0", "-0.5", "0.0", "0.5", "1.0"]);
        let halves = Scale { low: 0.0, high: 7.5, ..scale }.ticks(3);
        let labels: Vec<&str> = halves.iter().map(|t| t.1.as_str()).collect();
        assert_eq!(labels, ["0.0", "2.5", "5.0", "7.5"]);
        assert_eq!((scale.at(0.0), scale.at(7.0), scale.at(-7.0)), (50.0, 100.0, 0.0));
    }
}
