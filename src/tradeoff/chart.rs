//! A switch as an SVG chart: error over time, both logarithmic, the Pareto front drawn, the default marked.

use super::table::{headed, short, time};
use super::{Quantity, Setting, Switch};
use crate::html::escape;
use std::fmt::Write as _;

const WIDTH: f64 = 560.0;
const HEIGHT: f64 = 360.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 22.0;
const TOP: f64 = 20.0;
const BOTTOM: f64 = 48.0;
/// Height of the strip for errors of exactly 0, which a logarithm does not have.
const ZERO: f64 = 26.0;
/// Widths and height of a label's letters.
const LETTER: f64 = 6.3;
const LINE: f64 = 13.0;

/// A logarithmic scale from values to pixels.
#[derive(Clone, Copy)]
struct Scale {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Scale {
    /// Over all of some positive values, with a little room.
    fn over(values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values.filter(|v| v.is_finite() && *v > 0.0).map(libm::log10) {
            (low, high) = (low.min(value), high.max(value));
        }
        if low > high {
            (low, high) = (-1.0, 0.0);
        }
        // At least a third of a decade, so that noise does not fill the chart.
        let missing = (1.0 / 3.0 - (high - low)).max(0.0) / 2.0;
        let room = 0.08 * (high - low) + missing;
        Self { low: low - room, high: high + room, from, to }
    }

    fn at(&self, value: f64) -> f64 {
        let share = (libm::log10(value) - self.low) / (self.high - self.low);
        self.from + share.clamp(0.0, 1.0) * (self.to - self.from)
    }

    /// Powers of ten; the shorter the scale, the more values between them.
    fn ticks(&self) -> Vec<f64> {
        let decades = (self.low.floor() as i32)..=(self.high.ceil() as i32);
        let parts: &[f64] = match self.high - self.low {
            span if span > 2.5 => &[1.0],
            span if span > 0.8 => &[1.0, 2.0, 5.0],
            _ => &[1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0],
        };
        let step = (((self.high - self.low) / 6.0).ceil() as i32).max(1);
        decades
            .filter(|decade| decade % step == 0)
            .flat_map(|decade| parts.iter().map(move |part| part * libm::pow(10.0, decade.into())))
            .filter(|value| (self.low..=self.high).contains(&libm::log10(*value)))
            .collect()
    }
}

fn px(value: f64) -> String {
    let text = format!("{value:.1}");
    text.strip_suffix(".0").map_or_else(|| text.clone(), str::to_owned)
}

/// Axis text of a value: a power of ten where it is one and far from 1.
fn tick(value: f64) -> String {
    if (1e-2..1e4).contains(&value) { trimmed(&short(value)) } else { format!("{value:.0e}") }
}

/// Without zeros that say nothing.
fn trimmed(text: &str) -> String {
    if text.contains('.') && !text.contains('e') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text.to_owned()
    }
}

/// Where a setting lies.
struct Point<'a> {
    setting: &'a Setting,
    x: f64,
    y: f64,
}

/// The chart.
pub(super) fn chart(switch: &Switch) -> String {
    let zeros = switch.settings.iter().any(|s| s.error == 0.0);
    let floor = HEIGHT - BOTTOM - if zeros { ZERO } else { 0.0 };
    let times =
        switch.settings.iter().flat_map(|s| [s.seconds.lower_quartile, s.seconds.upper_quartile]);
    let x = Scale::over(times, LEFT, WIDTH - RIGHT);
    let y = Scale::over(switch.settings.iter().map(|s| s.error), floor, TOP);
    let points: Vec<Point<'_>> = switch
        .settings
        .iter()
        .filter(|s| !s.error.is_nan())
        .map(|setting| Point {
            setting,
            x: x.at(setting.seconds.median),
            y: if setting.error == 0.0 {
                HEIGHT - BOTTOM - ZERO / 2.0
            } else {
                y.at(setting.error)
            },
        })
        .collect();
    let title = format!("{}/{}", switch.stage.name(), switch.switch);
    let mut svg = format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=img xmlns=\"http://www.w3.org/2000/svg\"><title>{}: {} over \
         time of {}</title>",
        escape(&title),
        escape(&switch.error.name),
        escape(&switch.work)
    );
    axes(&mut svg, switch, (&x, &y), floor, zeros);
    front(&mut svg, &points);
    for point in &points {
        mark(&mut svg, point, &x);
    }
    labels(&mut svg, &points);
    svg += "</svg>";
    svg
}

fn axes(svg: &mut String, switch: &Switch, (x, y): (&Scale, &Scale), floor: f64, zeros: bool) {
    let (bottom, end) = (HEIGHT - BOTTOM, WIDTH - RIGHT);
    for value in x.ticks() {
        let at = px(x.at(value));
        let _ = write!(
            svg,
            "<path class=grid d=\"M{at} {TOP}V{bottom}\"/><text x={at} y={} text-anchor=middle>{}</text>",
            bottom + 16.0,
            time_tick(value)
        );
    }
    for value in y.ticks() {
        let at = y.at(value);
        let _ = write!(
            svg,
            "<path class=grid d=\"M{LEFT} {}H{end}\"/><text x={} y={} text-anchor=end>{}</text>",
            px(at),
            LEFT - 6.0,
            px(at + 4.0),
            tick(value)
        );
    }
    if zeros {
        let at = bottom - ZERO / 2.0;
        let _ = write!(
            svg,
            "<path class=cut d=\"M{LEFT} {}H{end}\"/><text x={} y={} text-anchor=end>0</text>",
            px(floor),
            LEFT - 6.0,
            px(at + 4.0)
        );
    }
    let middle = (TOP + bottom) / 2.0;
    let _ = write!(
        svg,
        "<path class=axis d=\"M{LEFT} {TOP}V{bottom}H{end}\"/>\
         <text class=label x={} y={} text-anchor=middle>time (median)</text>\
         <text class=label transform=\"translate(15 {})rotate(-90)\" text-anchor=middle>{}</text>",
        px((LEFT + end) / 2.0),
        HEIGHT - 10.0,
        px(middle),
        escape(&headed(&Quantity { ..switch.error.clone() }))
    );
}

fn time_tick(seconds: f64) -> String {
    let text = time(seconds * (1.0 + 1e-12));
    match text.split_once(' ') {
        Some((number, unit)) => format!("{} {unit}", trimmed(number)),
        None => text,
    }
}

/// The front as steps: nothing measured lies to the left of it and below it.
fn front(svg: &mut String, points: &[Point<'_>]) {
    let mut on: Vec<&Point<'_>> = points.iter().filter(|p| p.setting.pareto).collect();
    on.sort_by(|a, b| a.x.total_cmp(&b.x));
    let Some(first) = on.first() else { return };
    let mut path = format!("M{} {}", px(first.x), px(first.y));
    for point in &on[1..] {
        let _ = write!(path, "H{}V{}", px(point.x), px(point.y));
    }
    let _ = write!(svg, "<path class=front d=\"{path}\"/>");
}

fn mark(svg: &mut String, point: &Point<'_>, x: &Scale) {
    let Point { setting, x: cx, y } = point;
    let seconds = &setting.seconds;
    let (from, to) = (x.at(seconds.lower_quartile), x.at(seconds.upper_quartile));
    let (cx, cy) = (px(*cx), px(*y));
    let _ = write!(svg, "<path class=spread d=\"M{} {cy}H{}\"/>", px(from), px(to));
    if setting.default {
        let _ = write!(svg, "<circle class=default cx={cx} cy={cy} r=9 />");
    }
    let class = if setting.pareto { "on" } else { "off" };
    let _ = write!(
        svg,
        "<circle class={class} cx={cx} cy={cy} r=4.5><title>{}: {} in {}</title></circle>",
        escape(&setting.name),
        short(setting.error),
        time(seconds.median)
    );
}

/// Names beside their points, where they cover neither each other nor another point; a name that finds no room
/// is left to the table.
fn labels(svg: &mut String, points: &[Point<'_>]) {
    type Room = [f64; 4];
    let apart = |a: &Room, b: &Room| a[2] <= b[0] || b[2] <= a[0] || a[3] <= b[1] || b[3] <= a[1];
    let mut taken: Vec<Room> =
        points.iter().map(|p| [p.x - 6.0, p.y - 6.0, p.x + 6.0, p.y + 6.0]).collect();
    // The default and the front first: they are what a reader looks for.
    let mut order: Vec<&Point<'_>> = points.iter().collect();
    order.sort_by_key(|p| (!p.setting.default, !p.setting.pareto));
    for point in order {
        let Point { setting, x, y } = point;
        let wide = setting.name.chars().count() as f64 * LETTER;
        let places = [
            (x + 11.0, y + 4.0, "start"),
            (x - 11.0, y + 4.0, "end"),
            (x - wide / 2.0, y - 12.0, "start"),
            (x - wide / 2.0, y + 20.0, "start"),
            (x + 8.0, y - 10.0, "start"),
            (x + 8.0, y + 18.0, "start"),
            (x - 8.0, y - 10.0, "end"),
            (x - 8.0, y + 18.0, "end"),
        ];
        let free = places.into_iter().find_map(|(at, base, anchor)| {
            let left = if anchor == "end" { at - wide } else { at };
            let room = [left, base - LINE + 2.0, left + wide, base + 2.0];
            let inside = left >= LEFT && left + wide <= WIDTH - 2.0;
            let inside = inside && base > TOP && base <= HEIGHT - BOTTOM;
            (inside && taken.iter().all(|other| apart(&room, other)))
                .then_some((at, base, anchor, room))
        });
        if let Some((at, base, anchor, room)) = free {
            taken.push(room);
            let class = if setting.default { "label chosen" } else { "label" };
            let _ = write!(
                svg,
                "<text class=\"{class}\" x={} y={} text-anchor={anchor}>{}</text>",
                px(at),
                px(base),
                escape(&setting.name)
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_lie_on_the_scale_and_are_few() {
        for (low, high) in [(1e-9, 3.0), (0.4, 0.5), (2.0, 2.0), (1e-3, 2e-2)] {
            let scale = Scale::over([low, high].into_iter(), 0.0, 100.0);
            let ticks = scale.ticks();
            assert!((1..=9).contains(&ticks.len()), "{low} to {high}: {ticks:?}");
            assert!(ticks.iter().all(|t| (0.0..=100.0).contains(&scale.at(*t))));
            assert!(scale.at(low) < scale.at(high) || low == high);
        }
    }

    #[test]
    fn a_scale_of_no_positive_values_is_one_all_the_same() {
        let scale = Scale::over([0.0, f64::NAN].into_iter(), 0.0, 10.0);
        assert!(!scale.ticks().is_empty() && scale.at(0.5).is_finite());
    }

    #[test]
    fn texts_of_ticks_are_short() {
        assert_eq!([1e-9, 0.01, 0.5, 20.0].map(tick), ["1e-9", "0.01", "0.5", "20"]);
        assert_eq!([1e-3, 0.02, 5.0, 600.0].map(time_tick), ["1 ms", "20 ms", "5 s", "10 min"]);
    }
}
