//! What programs read: JSON, and the table behind CSV and Parquet.

use crate::eval::summary::{Evaluation, EvaluationSet, ImageScore, ImageScores};
use crate::table::{Column, Table, TableError, wkb};
use serde::Serialize;
use serde_json::{Map, Value};

/// Version of the document that holds several evaluations.
const SET_SCHEMA: &str = "sat3d-eval-set-1";

/// An evaluation as one JSON document (`docs/eval-output.md` states its schema).
///
/// One evaluation has its fields at the top level, and `published` beside them if there are
/// published rows. Several are `{"schema", "evaluations", "differences", "published"}`. Numbers that
/// cannot be computed are `null`.
#[must_use]
pub fn json(set: &EvaluationSet) -> Value {
    let mut document = Map::new();
    if let [evaluation] = &set.evaluations[..] {
        if let Value::Object(fields) = value(evaluation) {
            document = fields;
        }
        if !set.published.is_empty() {
            document.insert("published".to_owned(), value(&set.published));
        }
    } else {
        document.insert("schema".to_owned(), SET_SCHEMA.into());
        document.insert("evaluations".to_owned(), value(&set.evaluations));
        document.insert("differences".to_owned(), value(&set.differences));
        document.insert("published".to_owned(), value(&set.published));
    }
    Value::Object(document)
}

fn value<T: Serialize>(of: &T) -> Value {
    serde_json::to_value(of)
        .unwrap_or_else(|error| unreachable!("numbers, text and lists have a JSON form: {error}"))
}

/// One row per image and evaluation, for CSV and GeoParquet. Scores of images that were not scored
/// are missing; `geometry` is the image's centre where its name says it.
///
/// # Errors
/// None in practice: the columns have equal lengths and distinct names.
pub fn per_image_table(set: &EvaluationSet) -> Result<Table, TableError> {
    crate::plan::runs("table");
    let rows: Vec<Row<'_>> = set
        .evaluations
        .iter()
        .flat_map(|evaluation| evaluation.per_image.iter().map(move |image| Row(evaluation, image)))
        .collect();
    let few = |name: &'static str, what: &'static str, of: fn(&Row<'_>) -> String| {
        let mut values: Vec<String> = Vec::new();
        let keys: Vec<Option<u32>> = rows
            .iter()
            .map(|row| {
                let text = of(row);
                let known = values.iter().position(|v| *v == text).unwrap_or_else(|| {
                    values.push(text);
                    values.len() - 1
                });
                u32::try_from(known).ok()
            })
            .collect();
        Column::dictionary(name, what, values, keys)
    };
    let text = |name: &'static str, what: &'static str, of: fn(&Row<'_>) -> String| {
        Column::text(name, what, rows.iter().map(of))
    };
    let number = |name: &'static str, what: &'static str, of: fn(&ImageScores) -> f64| {
        Column::f64(name, what, rows.iter().map(|row| row.1.scores.as_ref().map(of)))
    };
    let maybe = |name: &'static str, what: &'static str, of: fn(&ImageScores) -> Option<f64>| {
        Column::f64(name, what, rows.iter().map(|row| row.1.scores.as_ref().and_then(of)))
    };
    let whole = |name: &'static str, what: &'static str, of: fn(&ImageScores) -> Option<u64>| {
        let of = |row: &Row<'_>| -> Option<i64> {
            row.1.scores.as_ref().and_then(of).and_then(|value| i64::try_from(value).ok())
        };
        Column::i64(name, what, rows.iter().map(of))
    };
    Table::new(vec![
        few("model", "Set of predictions", |r| r.0.model.clone()),
        few("protocol", "What is aligned before scoring", |r| r.0.protocol.name().to_owned()),
        text("name", "Stem of the prediction", |r| r.1.name.clone()),
        few("status", "done, skipped or failed", |r| r.1.status.name().to_owned()),
        text("reason", "Why it was skipped or failed; empty when done", |r| r.1.reason.clone()),
        Column::f64(
            "lat_deg",
            "Latitude of the image's centre, degrees (WGS 84)",
            rows.iter().map(|r| r.1.lat_deg),
        ),
        Column::f64(
            "lon_deg",
            "Longitude of the image's centre, degrees (WGS 84)",
            rows.iter().map(|r| r.1.lon_deg),
        ),
        number("mae_m", "Mean absolute error, metres", |s| s.mae_m),
        number("rmse_m", "Root mean square error, metres", |s| s.rmse_m),
        number("lt_2_5_m_pct", "Share of pixels with |error| < 2.5 m, per cent", |s| {
            s.lt_2_5_m_pct
        }),
        number("lt_7_5_m_pct", "Share of pixels with |error| < 7.5 m, per cent", |s| {
            s.lt_7_5_m_pct
        }),
        number("bias_m", "Mean error (prediction - truth), metres", |s| s.bias_m),
        number("median_m", "Median error, metres", |s| s.median_m),
        number("nmad_m", "1.4826 x median absolute deviation from the median, metres", |s| {
            s.nmad_m
        }),
        number("le68_m", "68th percentile of |error|, metres", |s| s.le68_m),
        number("le90_m", "90th percentile of |error|, metres", |s| s.le90_m),
        number("p95_m", "95th percentile of |error|, metres", |s| s.p95_m),
        number("max_m", "Largest |error|, metres", |s| s.max_m),
        whole("pixels", "Pixels compared", |s| Some(s.pixels)),
        whole("truth_pixels", "Pixels of the aligned truth with a height", |s| {
            Some(s.truth_pixels)
        }),
        number("completeness_pct", "Share of those with a prediction, per cent", |s| {
            s.completeness_pct
        }),
        number("shift_x_px", "Shift applied to the truth, pixels of the prediction, + east", |s| {
            s.shift_px.x
        }),
        number(
            "shift_y_px",
            "Shift applied to the truth, pixels of the prediction, + south",
            |s| s.shift_px.y,
        ),
        number("shift_x_m", "The same on the ground, metres, + east", |s| {
            s.shift_m.map_or(f64::NAN, |shift| shift.x)
        }),
        number("shift_y_m", "The same on the ground, metres, + south", |s| {
            s.shift_m.map_or(f64::NAN, |shift| shift.y)
        }),
        number(
            "rotation_deg",
            "Rotation applied to the truth, degrees, sign of scipy.ndimage.rotate",
            |s| s.rotation_deg,
        ),
        number("vertical_offset_m", "Subtracted from the truth, metres", |s| s.vertical_offset_m),
        maybe("correlation", "Correlation at the rotation found", |s| s.correlation),
        whole("inliers", "Inliers of the vertical offset's RANSAC, pixels", |s| s.inliers),
        whole("coregistration_iterations", "Iterations of Nuth and Kaab's method", |s| {
            s.coregistration.as_ref().map(|c| u64::from(c.iterations))
        }),
        maybe("coregistration_before_std_m", "Std of the errors before, metres", |s| {
            s.coregistration.as_ref().map(|c| c.before.std_m)
        }),
        maybe("coregistration_before_nmad_m", "NMAD of the errors before, metres", |s| {
            s.coregistration.as_ref().map(|c| c.before.nmad_m)
        }),
        maybe("coregistration_after_std_m", "Std of the errors after, metres", |s| {
            s.coregistration.as_ref().map(|c| c.after.std_m)
        }),
        maybe("coregistration_after_nmad_m", "NMAD of the errors after, metres", |s| {
            s.coregistration.as_ref().map(|c| c.after.nmad_m)
        }),
        maybe("shift_error_x_px", "Standard error of the shift, pixels, east", |s| {
            s.coregistration.as_ref().map(|c| c.shift_error_px.x)
        }),
        maybe("shift_error_y_px", "Standard error of the shift, pixels, south", |s| {
            s.coregistration.as_ref().map(|c| c.shift_error_px.y)
        }),
        text("flags", "What a reader should know of the alignment, joined by `; `", |r| {
            r.1.scores.as_ref().map(flags).unwrap_or_default()
        }),
        text("notes", "What else a reader should know, joined by `; `", |r| {
            r.1.scores.as_ref().map(|s| s.notes.join("; ")).unwrap_or_default()
        }),
        Column::geometry(
            "geometry",
            "Centre of the image (WGS 84 longitude, latitude)",
            rows.iter().map(|row| match (row.1.lon_deg, row.1.lat_deg) {
                (Some(lon), Some(lat)) => Some(wkb::point(lon, lat)),
                _ => None,
            }),
        ),
    ])
}

struct Row<'a>(&'a Evaluation, &'a ImageScore);

/// The flags of an image as in JSON, joined by `; `.
pub(super) fn flags(scores: &ImageScores) -> String {
    let names: Vec<String> = scores
        .flags
        .iter()
        .map(|flag| value(flag).as_str().unwrap_or_default().to_owned())
        .collect();
    names.join("; ")
}

#[cfg(test)]
mod tests {
    use super::super::sample;
    use super::*;
    use crate::eval::align::AlignmentFlag;
    use crate::eval::{Protocol, published};

    #[test]
    fn one_evaluation_is_the_document_and_several_are_a_list() {
        let mut set = sample::set(&["a"], &[Protocol::Paper], 12);
        let document = json(&set);
        assert_eq!(document["schema"], "sat3d-eval-1");
        assert_eq!(document["protocol"], "paper");
        assert_eq!(document["images"]["found"], 12);
        assert!(document.get("published").is_none() && document.get("differences").is_none());
        for key in ["name", "mae_m", "rmse_m", "shift_px", "vertical_offset_m", "pixels"] {
            assert!(document["per_image"][0].get(key).is_some(), "{key}");
        }

        set.published = published::paper_rows();
        assert_eq!(json(&set)["published"][6]["scores"]["mae_m"], 3.47);

        let set = sample::set(&["a", "b"], &Protocol::ALL, 12);
        let document = json(&set);
        assert_eq!(document["schema"], SET_SCHEMA);
        assert_eq!(document["evaluations"].as_array().map(Vec::len), Some(8));
        assert_eq!(document["differences"].as_array().map(Vec::len), Some(4));
    }

    #[test]
    fn what_is_no_number_is_null_and_what_was_not_scored_has_no_scores() {
        let document = json(&sample::nothing());
        assert!(document["pooled"]["mae_m"].is_null());
        assert!(document["per_image"][0].get("mae_m").is_none());
        assert!(!document.to_string().contains("NaN"));
    }

    #[test]
    fn the_table_has_a_row_per_image_and_evaluation() {
        let mut set = sample::set(&["a", "b"], &[Protocol::Paper, Protocol::Coregister], 12);
        if let Some(scores) = &mut set.evaluations[0].per_image[0].scores {
            scores.flags = vec![AlignmentFlag::ShiftBeyondLimit, AlignmentFlag::FewInliers];
            scores.notes = vec!["one, two".to_owned(), "three".to_owned()];
        }
        let table = per_image_table(&set).expect("a table");
        assert_eq!(table.rows(), 48);
        let csv = String::from_utf8(table.to_csv()).expect("UTF-8");
        let mut lines = csv.lines();
        let header = lines.next().expect("a header");
        assert!(header.starts_with("model,protocol,name,status,reason,lat_deg,lon_deg,mae_m,"));
        assert!(header.ends_with(",flags,notes"));
        let first = lines.next().expect("a row");
        assert!(first.ends_with(",shift-beyond-limit; few-inliers,\"one, two; three\""), "{first}");
        assert!(table.columns().iter().all(|c| !c.description.is_empty()));

        let table = per_image_table(&sample::nothing()).expect("a table");
        assert!(!String::from_utf8(table.to_csv()).expect("UTF-8").contains("NaN"));
        let none = EvaluationSet { evaluations: vec![], differences: vec![], published: vec![] };
        assert_eq!(per_image_table(&none).expect("a table").rows(), 0);
    }
}
