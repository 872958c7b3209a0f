//! Single images: prediction, truth and error side by side.

use super::Panel;
use super::charts::quantile;
use super::svg::{Scale, nice_step, px};
use crate::eval::Surface;
use crate::eval::report::number::fixed;
use crate::eval::report::picture;
use crate::html::escape;
use crate::raster::colour;

/// Best, median and worst image, or whichever are given. Prediction and truth of an image have the
/// same scale; the errors of all images have one.
pub(super) fn panels(panels: &[Panel]) -> String {
    let errors: Vec<Surface> = panels.iter().map(error).collect();
    let sizes = errors.iter().flat_map(|e| &e.values).map(|v| f64::from(v.abs()));
    let most = quantile(sizes.filter(|v| v.is_finite()).collect(), 0.98);
    let step = nice_step(most / 5.0);
    let most = if most > 0.0 { (most / step).ceil() * step } else { 1.0 };
    let mut out = String::new();
    for (panel, error) in panels.iter().zip(&errors) {
        let heights = [&panel.prediction, &panel.truth];
        let both = || -> Vec<f64> {
            let values = heights.iter().flat_map(|s| &s.values).map(|v| f64::from(*v));
            values.filter(|v| v.is_finite()).collect()
        };
        let range = [quantile(both(), 0.01), quantile(both(), 0.99)];
        out += &format!(
            "<article class=panel><h3>{} <span class=sub>MAE {} m</span></h3><p class=name>{}</p><div class=trio>",
            escape(&panel.caption),
            fixed(panel.mae_m, 2),
            escape(&panel.name)
        );
        out += &image(&panel.prediction, range, &colour::HEIGHT, "Prediction", &panel.name);
        out += &image(&panel.truth, range, &colour::HEIGHT, "Truth, aligned", &panel.name);
        out += &image(error, [-most, most], &colour::DIVERGING, "Error", &panel.name);
        out += "</div><div class=bars>";
        out += &bar(range, &colour::HEIGHT, "height, m (prediction and truth)");
        out += &bar([-most, most], &colour::DIVERGING, "error, m (all images)");
        out += "</div></article>\n";
    }
    out
}

/// Prediction minus truth; empty when their sizes differ.
fn error(panel: &Panel) -> Surface {
    let (p, t) = (&panel.prediction, &panel.truth);
    if p.size() != t.size() {
        return Surface::empty(p.width, p.height);
    }
    let values = p.values.iter().zip(&t.values);
    // In f64 and back, so that large heights of both signs do not overflow.
    let values = values.map(|(p, t)| (f64::from(*p) - f64::from(*t)) as f32).collect();
    Surface::new(p.width, p.height, values)
}

fn image(surface: &Surface, range: [f64; 2], map: &[[u8; 3]], what: &str, name: &str) -> String {
    let picture = if surface.width == 0 || surface.height == 0 {
        Err("it has no pixels".to_owned())
    } else {
        picture::data_uri(surface, range, map).map_err(|error| error.to_string())
    };
    match picture {
        Ok(uri) => format!(
            "<figure><img src=\"{uri}\" width={} height={} alt=\"{what} of {}, {} by {} pixels\"><figcaption>{what}</figcaption></figure>",
            surface.width,
            surface.height,
            escape(name),
            surface.width,
            surface.height
        ),
        Err(error) => format!("<p class=note>{what} cannot be drawn: {}.</p>", escape(&error)),
    }
}

/// A bar of a colour map with round values under it.
fn bar([low, high]: [f64; 2], map: &[[u8; 3]], name: &str) -> String {
    let name_of = escape(name);
    if low.is_nan() || high.is_nan() {
        return String::new();
    }
    let mut svg =
        format!("<svg viewBox=\"0 0 300 46\" role=img><title>Colours of {name_of}</title>");
    for (i, [r, g, b]) in colour::table::<64>(map).into_iter().enumerate() {
        svg += &format!(
            "<rect x={} y=2 width=4.4 height=11 shape-rendering=crispEdges fill=\"#{r:02x}{g:02x}{b:02x}\"/>",
            px(22.0 + 256.0 / 64.0 * i as f64)
        );
    }
    if high > low {
        let scale = Scale { low, high, from: 22.0, to: 278.0 };
        for (value, label) in scale.ticks(5) {
            let sign = if low < 0.0 && low == -high && value > 0.0 { "+" } else { "" };
            svg += &format!(
                "<path class=axis d=\"M{0} 13v4\"/><text class=tick x={0} y=28 text-anchor=middle>{sign}{label}</text>",
                px(scale.at(value))
            );
        }
    } else {
        svg += &format!("<text class=tick x=150 y=28 text-anchor=middle>{}</text>", fixed(low, 2));
    }
    svg + &format!("<text class=label x=150 y=43 text-anchor=middle>{name_of}</text></svg>")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surfaces_that_cannot_be_compared_or_are_empty_are_told() {
        let panel = |prediction: Surface, truth: Surface| Panel {
            caption: "<b>".to_owned(),
            name: "\"x\"".to_owned(),
            prediction,
            truth,
            mae_m: f64::NAN,
        };
        let flat = |n: usize| Surface::new(n, n, vec![1.0; n * n]);
        let all = panels(&[
            panel(flat(2), flat(3)),
            panel(Surface::empty(2, 2), Surface::empty(2, 2)),
            panel(Surface::new(0, 0, vec![]), Surface::new(0, 0, vec![])),
            panel(flat(1), Surface::new(1, 1, vec![f32::INFINITY])),
            panel(Surface::new(1, 1, vec![f32::MAX]), Surface::new(1, 1, vec![f32::MIN])),
        ]);
        assert!(all.contains("&lt;b&gt;") && all.contains("&quot;x&quot;"));
        assert!(all.contains("cannot be drawn: it has no pixels"));
        assert!(!all.contains("NaN"), "{all}");
        assert_eq!(panels(&[]), "");
    }
}
