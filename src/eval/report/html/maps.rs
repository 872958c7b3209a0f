//! Where the errors are: on the ground, and within the images.

use super::charts::{dots, quantile};
use super::svg::{Scale, WIDTH, figure, nice_step, open, px};
use crate::eval::report::number::{fixed, plural};
use crate::eval::summary::{Evaluation, PositionMap};

/// Steps of the colour scales, as many as the style sheet has.
const STEPS: usize = 16;
/// Metres in a degree of latitude (mean radius of WGS 84).
const DEGREE_M: f64 = 111_194.9;

/// The least and the greatest of the finite values.
fn ends(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
}

/// The step of a value on a colour scale.
fn step(value: f64, low: f64, high: f64) -> usize {
    if high > low {
        (((value - low) / (high - low) * STEPS as f64) as usize).min(STEPS - 1)
    } else {
        STEPS / 2
    }
}

/// A bar of the colours with round values; `prefix` is the class of the colours.
fn colour_bar(prefix: char, low: f64, high: f64, name: &str, open_ends: bool, y: f64) -> String {
    let (left, right) = (90.0, WIDTH - 90.0);
    let width = (right - left) / STEPS as f64;
    let mut svg = String::new();
    for i in 0..STEPS {
        svg += &format!(
            "<rect class={prefix}{i} x={} y={} width={} height=10 shape-rendering=crispEdges />",
            px(left + width * i as f64),
            px(y),
            px(width + 0.4)
        );
    }
    let scale = Scale { low, high, from: left, to: right };
    if high > low {
        for (value, label) in scale.ticks(4) {
            let (at, sign) = (scale.at(value), if prefix == 'd' && value > 0.0 { "+" } else { "" });
            svg += &format!(
                "<path class=axis d=\"M{} {}v4\"/><text class=tick x={} y={} text-anchor=middle>{sign}{label}</text>",
                px(at),
                px(y + 10.0),
                px(at),
                px(y + 26.0)
            );
        }
    } else {
        svg += &format!(
            "<text class=tick x={} y={} text-anchor=middle>{}</text>",
            px(WIDTH / 2.0),
            px(y + 26.0),
            fixed(low, 2)
        );
    }
    let (less, more) = if open_ends { ("\u{2264}", "\u{2265}") } else { ("", "") };
    svg += &format!(
        "<text class=tick x={} y={} text-anchor=end>{less} {}</text>\
         <text class=tick x={} y={}>{more} {}</text>\
         <text class=label x={} y={} text-anchor=middle>{name}</text>",
        px(left - 6.0),
        px(y + 9.0),
        fixed(low, 2),
        px(right + 6.0),
        px(y + 9.0),
        fixed(high, 2),
        px(WIDTH / 2.0),
        px(y + 44.0)
    );
    svg
}

/// The images at their places on the ground, coloured by their mean absolute error.
pub(super) fn geographic(evaluation: &Evaluation) -> String {
    let places: Vec<(f64, f64, f64, &str)> = evaluation
        .per_image
        .iter()
        .filter_map(|i| {
            let mae = i.scores.as_ref()?.mae_m;
            let (lat, lon) = (i.lat_deg?, i.lon_deg?);
            (mae.is_finite() && lat.is_finite() && lon.is_finite()).then_some((
                lat,
                lon,
                mae,
                i.name.as_str(),
            ))
        })
        .collect();
    let Some(first) = places.first() else { return String::new() };
    // Longitudes near the first, so that the date line does not tear a town apart.
    let near = |lon: f64| {
        let apart = lon - first.1;
        first.1 + apart - 360.0 * (apart / 360.0).round()
    };
    let (south, north) = ends(places.iter().map(|p| p.0));
    let (west, east) = ends(places.iter().map(|p| near(p.1)));
    let shrink = libm::cos(((south + north) / 2.0).to_radians()).max(1e-3);
    let (across, up) = ((east - west) * DEGREE_M * shrink, (north - south) * DEGREE_M);
    let margin = 16.0;
    let room = WIDTH - 2.0 * margin;
    // Pixels per metre; a single image stands in the middle of 500 m.
    let scale = (room / across.max(500.0)).min(330.0 / up.max(100.0));
    let tall = up * scale;
    let left = margin + (room - across * scale) / 2.0;
    let maes: Vec<f64> = places.iter().map(|p| p.2).collect();
    let (low, high) = (quantile(maes.clone(), 0.02), quantile(maes, 0.98));
    let bottom = margin + tall + 14.0;
    let bar = nice_step(room / 6.0 / scale);
    let said =
        if bar >= 1000.0 { format!("{} km", px(bar / 1000.0)) } else { format!("{} m", px(bar)) };
    let mut svg = open(
        "Mean absolute error of each image at its place",
        &format!(
            "{} over {} by {} kilometres; mean absolute errors from {} to {} metres (2nd to 98th percentile).",
            plural(places.len() as u64, "image", "images"),
            fixed(across / 1000.0, 1),
            fixed(up / 1000.0, 1),
            fixed(low, 2),
            fixed(high, 2)
        ),
        bottom + 82.0,
    );
    svg += &dots(
        places.iter().map(|(lat, lon, mae, name)| {
            (
                left + (near(*lon) - west) * DEGREE_M * shrink * scale,
                margin + (north - lat) * DEGREE_M * scale,
                format!("q{}", step(*mae, low, high)),
                format!("{name}: MAE {} m", fixed(*mae, 2)),
            )
        }),
        places.len(),
    );
    svg += &format!(
        "<path class=axis d=\"M{margin} {}v5h{}v-5\"/><text class=tick x={} y={}>{said}</text>\
         <path class=axis d=\"M{} {}v-16l-4 7m4-7l4 7\"/><text class=tick x={} y={} text-anchor=end>N</text>",
        px(bottom),
        px(bar * scale),
        px(margin + bar * scale + 6.0),
        px(bottom + 6.0),
        px(WIDTH - margin - 4.0),
        px(bottom + 8.0),
        px(WIDTH - margin - 12.0),
        px(bottom + 6.0),
    );
    svg += &colour_bar('q', low, high, "MAE of the image, m", true, bottom + 30.0);
    svg += "</svg>";
    figure(
        &svg,
        "Where the errors are on the ground: every image at its centre, north up. Colours end at the 2nd \
         and the 98th percentile.",
    )
}

/// Mean absolute and mean error by place within the images.
pub(super) fn by_position(map: &PositionMap) -> String {
    let known = |values: &[f64]| values.iter().any(|v| v.is_finite());
    let cells = map.cells as usize;
    if cells == 0 || map.mae_m.len() != cells * cells || map.bias_m.len() != cells * cells {
        return String::new();
    }
    let mut out = String::new();
    if known(&map.mae_m) {
        let (low, high) = ends(map.mae_m.iter().copied());
        let described =
            format!("Mean absolute errors from {} to {} metres.", fixed(low, 2), fixed(high, 2));
        let mut svg = open("Mean absolute error by place in the image", &described, 370.0);
        svg += &heat(&map.mae_m, cells, 'q', low, high);
        svg += &colour_bar('q', low, high, "MAE, m", false, 318.0);
        out += &figure(
            &(svg + "</svg>"),
            "Where in the image the errors are, over all images, north up: mean |error| per cell.",
        );
    }
    if known(&map.bias_m) {
        let (low, high) = ends(map.bias_m.iter().copied());
        let end = low.abs().max(high.abs());
        let described = format!("Mean errors from {} to {} metres.", fixed(low, 2), fixed(high, 2));
        let mut svg = open("Mean error by place in the image", &described, 370.0);
        svg += &heat(&map.bias_m, cells, 'd', -end, end);
        svg += &colour_bar('d', -end, end, "mean error, m", false, 318.0);
        out += &figure(
            &(svg + "</svg>"),
            "The same for the signed error: a slope tells of a tilt or a shift, a ring of lean.",
        );
    }
    out
}

/// The cells as one path per colour.
fn heat(values: &[f64], cells: usize, prefix: char, low: f64, high: f64) -> String {
    let side = 296.0;
    let (left, cell) = ((WIDTH - side) / 2.0, side / cells as f64);
    let mut paths = vec![String::new(); STEPS];
    for (i, value) in values.iter().enumerate().filter(|(_, v)| v.is_finite()) {
        let (x, y) = (left + cell * (i % cells) as f64, 10.0 + cell * (i / cells) as f64);
        let [x, y, w] = [x, y, cell + 0.25].map(|v| fixed(v, 2));
        paths[step(*value, low, high)] += &format!("M{x} {y}h{w}v{w}h-{w}z");
    }
    let mut svg = String::new();
    for (i, path) in paths.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
        svg += &format!("<path class={prefix}{i} shape-rendering=crispEdges d=\"{path}\"/>");
    }
    svg += &format!("<rect class=frame x={} y=10 width={side} height={side} />", px(left));
    svg
}

#[cfg(test)]
mod tests {
    use super::super::super::sample;
    use super::*;
    use crate::eval::Protocol;

    #[test]
    fn steps_of_the_scale_cover_it() {
        assert_eq!([step(0.0, 0.0, 1.0), step(0.99, 0.0, 1.0), step(1.0, 0.0, 1.0)], [0, 15, 15]);
        assert_eq!([step(-5.0, 0.0, 1.0), step(9.0, 0.0, 1.0), step(2.0, 2.0, 2.0)], [0, 15, 8]);
    }

    #[test]
    fn a_town_at_the_date_line_stays_together() {
        let mut e = sample::evaluation("m", Protocol::Paper, 50, 1.0);
        for (i, image) in e.per_image.iter_mut().enumerate() {
            image.lon_deg = Some(if i % 2 == 0 { 179.999 } else { -179.999 });
        }
        let svg = geographic(&e);
        assert!(svg.contains("over 0.1 by 0.5 kilometres"), "{}", &svg[..400]);
    }

    #[test]
    fn maps_without_places_or_cells_are_left_out() {
        let set = sample::nothing();
        assert_eq!(geographic(&set.evaluations[0]), "");
        assert_eq!(by_position(&set.evaluations[0].by_position), "");
        let odd = PositionMap { cells: 3, mae_m: vec![1.0], bias_m: vec![1.0] };
        assert_eq!(by_position(&odd), "");
        let mut one = sample::evaluation("m", Protocol::Paper, 1, 1.0);
        one.by_position = PositionMap { cells: 1, mae_m: vec![1.0], bias_m: vec![0.0] };
        for svg in [geographic(&one), by_position(&one.by_position)] {
            assert!(
                svg.contains("</svg>") && !svg.contains("NaN") && !svg.contains("inf"),
                "{svg}"
            );
        }
    }
}
