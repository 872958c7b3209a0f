//! How many metres a model pixel is, and so how large the picture becomes before the network sees it.

use crate::footprint::{Footprint, FootprintError, Place, TRAINING_WIDTH_M};
use crate::grid::WGS84_A;
use serde::{Deserialize, Serialize};

/// Ground metres per model pixel where nothing else is said: about what the training's were.
pub const GROUND_GSD_M: f64 = 0.28;
/// Pixels of zoom 20 per model pixel: 640 became 256 in the training.
pub const ZOOM_20_REDUCTION: f64 = 2.5;
/// Model pixels of the training's crops.
const TRAINING_PX: f64 = 256.0;
/// Share of a pixel's size by which a zoom-20 grid may differ from the exact one.
const ZOOM_20_SLACK: f64 = 0.005;
/// Most model pixels along a side.
const LONGEST: f64 = (1_u64 << 26) as f64;
/// Most model pixels per pixel of the picture, along an axis.
const LARGEST_MAGNIFICATION: f64 = 16.0;

/// Which rule gave the size.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// `--window-gsd`, metres per model pixel.
    Stated {
        /// What was stated.
        metres: f64,
    },
    /// Web Mercator at zoom 20: [`ZOOM_20_REDUCTION`], as in the training.
    Zoom20,
    /// [`GROUND_GSD_M`] on the ground.
    Ground,
    /// The picture's pixels are the model's own.
    AsGiven,
}

impl Rule {
    /// The rule in words, for `--explain`.
    #[must_use]
    pub fn words(&self) -> String {
        match self {
            Self::Stated { metres } => {
                format!("{metres} m on the ground per model pixel (--window-gsd)")
            }
            Self::Zoom20 => format!(
                "Web Mercator at zoom 20, made {ZOOM_20_REDUCTION} times smaller, as in the training"
            ),
            Self::Ground => format!("{GROUND_GSD_M} m on the ground per model pixel"),
            Self::AsGiven => "the picture's pixels are the model's own".to_owned(),
        }
    }
}

/// The picture's size in model pixels and on the ground.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelGround {
    /// Columns and rows, model pixels.
    pub size: [u32; 2],
    /// Place and size on the ground of the picture as it was given.
    pub footprint: Footprint,
    /// Whether the size on the ground was assumed, for want of a place and of `--gsd`.
    pub assumed: bool,
    /// Which rule gave the size.
    pub rule: Rule,
    /// Things the user should know.
    pub warnings: Vec<String>,
}

/// Why there is no size.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GroundError {
    /// A ground sample distance that is none.
    #[error(
        "{option} {gsd} makes no sense; give metres per pixel, more than 0 and less than 100000 (0.1 for VIGOR's \
         images, 0.28 for a model pixel)"
    )]
    Gsd {
        /// The option that states it.
        option: &'static str,
        /// What was given, metres.
        gsd: f64,
    },
    /// The picture's place cannot be used.
    #[error(
        "{source}; or state the metres per pixel with --gsd, and the outputs have no place on Earth"
    )]
    Place {
        /// Why.
        source: FootprintError,
    },
    /// More model pixels than can be counted, or than the picture can show.
    #[error(
        "a picture of {} x {} pixels, {:.4} x {:.4} m each, would become {:.0} x {:.0} model pixels, which is more than \
         {what}; are the metres per pixel (--gsd) and per model pixel (--window-gsd) right?",
        picture[0], picture[1], gsd_m[0], gsd_m[1], size[0], size[1]
    )]
    Size {
        /// Columns and rows of the picture.
        picture: [u32; 2],
        /// Ground metres per pixel of it.
        gsd_m: [f64; 2],
        /// Columns and rows that it would become.
        size: [f64; 2],
        /// The limit, in words.
        what: String,
    },
}

/// Finds the size of a picture of `picture` columns and rows in model pixels. The first rule that fits counts:
///
/// 1. `window_gsd`, metres per model pixel: pixels times `gsd / window_gsd`, along each axis;
/// 2. Web Mercator at zoom 20, by a VIGOR name or as EPSG:3857 with pixels within 0.5 % of 0.1493 m:
///    pixels over 2.5, so that 640 become 256 as in the training, whatever the latitude;
/// 3. a place or `gsd`, metres per pixel across and down: 0.28 m on the ground;
/// 4. neither: the pixels are the model's own, and one is 64.48 / 256 m, which a warning says.
///
/// Sizes are rounded to the nearest and at least 1. `gsd` counts before what the place says of metres, not of where;
/// a place that cannot be used (a rotated grid, a CRS that this build does not have) is an error without
/// `gsd`, and dropped with a warning where `gsd` is given: its outputs are then laid out in metres without a
/// place on Earth.
///
/// # Errors
/// [`GroundError`] for distances that are none, a place that cannot be used, and sizes beyond 2^26 model
/// pixels or 16 model pixels per pixel.
pub fn model_size(
    picture: [u32; 2],
    place: Option<&Place>,
    gsd: Option<[f64; 2]>,
    window_gsd: Option<f64>,
) -> Result<ModelGround, GroundError> {
    let check = |option, values: &[f64]| {
        let wrong = values.iter().find(|value| !(**value > 0.0 && **value < 1e5));
        wrong.map_or(Ok(()), |gsd| Err(GroundError::Gsd { option, gsd: *gsd }))
    };
    check("--gsd", gsd.as_ref().map_or(&[][..], |gsd| gsd))?;
    check("--window-gsd", window_gsd.as_slice())?;

    let mut warnings = Vec::new();
    let (footprint, assumed) = footprint(picture, place, gsd, &mut warnings)?;
    let zoom_20 = footprint.place.as_ref().is_some_and(is_zoom_20);
    let rule = match window_gsd {
        Some(metres) => Rule::Stated { metres },
        None if zoom_20 => Rule::Zoom20,
        None if assumed => Rule::AsGiven,
        None => Rule::Ground,
    };
    if let (Rule::Zoom20, Some([x, y])) = (rule, gsd) {
        warnings.push(format!(
            "the picture is Web Mercator at zoom 20 and is made {ZOOM_20_REDUCTION} times smaller; --gsd {x} {y} changes \
             only its metres, --window-gsd also its model pixels"
        ));
    }
    if assumed {
        warnings.push(format!(
            "the picture has no georeference, so {:.4} m per pixel are assumed, the training's model pixels; state the \
             metres per pixel with --gsd",
            footprint.gsd_m[0]
        ));
    }
    let side = |axis: usize| {
        let (px, metres) = (f64::from(picture[axis]), footprint.gsd_m[axis]);
        let side = match rule {
            Rule::Stated { metres: target } => px * metres / target,
            Rule::Zoom20 => px / ZOOM_20_REDUCTION,
            Rule::Ground => px * metres / GROUND_GSD_M,
            Rule::AsGiven => px,
        };
        side.round().max(1.0)
    };
    let size = [side(0), side(1)];
    let refuse =
        |what: String| Err(GroundError::Size { picture, gsd_m: footprint.gsd_m, size, what });
    // So written that NaN is refused too.
    if !size.iter().all(|side| *side <= LONGEST) {
        return refuse(format!("{LONGEST} along a side"));
    }
    if (0..2).any(|axis| size[axis] > f64::from(picture[axis]) * LARGEST_MAGNIFICATION) {
        return refuse(format!("{LARGEST_MAGNIFICATION} model pixels per pixel"));
    }
    Ok(ModelGround { size: size.map(|side| side as u32), footprint, assumed, rule, warnings })
}

/// Place and size on the ground, and whether the latter is assumed.
fn footprint(
    picture: [u32; 2],
    place: Option<&Place>,
    gsd: Option<[f64; 2]>,
    warnings: &mut Vec<String>,
) -> Result<(Footprint, bool), GroundError> {
    let Some(place) = place else {
        let metres = gsd.unwrap_or([TRAINING_WIDTH_M / TRAINING_PX; 2]);
        return Ok((Footprint::of_gsd(picture, metres), gsd.is_none()));
    };
    match (Footprint::of_place(picture, place.clone()), gsd) {
        (Ok(found), None) => Ok((found, false)),
        (Ok(found), Some(gsd_m)) => Ok((Footprint { gsd_m, ..found }, false)),
        (Err(source), None) => Err(GroundError::Place { source }),
        (Err(source), Some(gsd_m)) => {
            warnings.push(format!("{source}; with --gsd it goes on without a place on Earth"));
            Ok((Footprint::of_gsd(picture, gsd_m), false))
        }
    }
}

/// Whether a place is a grid of Web Mercator's zoom 20.
fn is_zoom_20(place: &Place) -> bool {
    match place {
        Place::WebMercator(grid) => grid.zoom() == 20,
        Place::Raster { geotransform, crs } => {
            let pixel = 2.0 * std::f64::consts::PI * WGS84_A / 256.0 / f64::from(1_u32 << 20);
            let near = |size: f64| (size.abs() / pixel - 1.0).abs() <= ZOOM_20_SLACK;
            crs.epsg == Some(3857) && near(geotransform.0[1]) && near(geotransform.0[5])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crs::CrsSpec;
    use crate::grid::{GeoTransform, ImageGrid, LonLat};

    fn named(size: [u32; 2], zoom: u8) -> Place {
        let center = LonLat { lon_deg: -122.33, lat_deg: 47.6 };
        Place::WebMercator(ImageGrid::new(center, zoom, size[0], size[1]).expect("a grid"))
    }

    fn raster(epsg: u32, geotransform: [f64; 6]) -> Place {
        Place::Raster { geotransform: GeoTransform(geotransform), crs: CrsSpec::from_epsg(epsg) }
    }

    #[test]
    fn zoom_20_is_reduced_as_in_the_training() {
        let found =
            model_size([640, 640], Some(&named([640, 640], 20)), None, None).expect("a size");
        assert_eq!((found.size, found.rule, found.assumed), ([256, 256], Rule::Zoom20, false));
        assert!(found.warnings.is_empty() && (found.footprint.gsd_m[0] - 0.1007).abs() < 1e-4);
        let mercator = |pixel| raster(3857, [-1.36e7, pixel, 0.0, 6.04e6, 0.0, -pixel]);
        for (pixel, rule) in [
            (0.149_291_07, Rule::Zoom20),
            (0.149_291_07 * 1.0049, Rule::Zoom20),
            (0.149_291_07 * 0.994, Rule::Ground),
            (0.149_291_07 * 1.006, Rule::Ground),
            (0.3, Rule::Ground),
        ] {
            let found = model_size([1000, 37], Some(&mercator(pixel)), None, None).expect("a size");
            assert_eq!(found.rule, rule, "{pixel}");
            if rule == Rule::Zoom20 {
                assert_eq!(found.size, [400, 15]);
            }
        }
        // Only half of it.
        let half = raster(3857, [-1.36e7, 0.149_291, 0.0, 6.04e6, 0.0, -0.3]);
        assert_eq!(model_size([9, 9], Some(&half), None, None).expect("a size").rule, Rule::Ground);
        let other =
            model_size([640, 640], Some(&named([640, 640], 19)), None, None).expect("a size");
        assert_eq!(other.rule, Rule::Ground);

        let stated = model_size([640, 640], Some(&named([640, 640], 20)), Some([0.2, 0.3]), None)
            .expect("a size");
        assert_eq!((stated.size, stated.footprint.gsd_m), ([256, 256], [0.2, 0.3]));
        assert!(stated.warnings[0].contains("--window-gsd"), "{:?}", stated.warnings);
    }

    #[test]
    fn other_ground_becomes_28_centimetres_or_what_is_stated() {
        let utm = raster(32610, [550_000.0, 0.25, 0.0, 5_270_000.0, 0.0, -0.5]);
        let found = model_size([1000, 700], Some(&utm), None, None).expect("a size");
        let [x, y] = found.footprint.gsd_m;
        let expected = [1000.0 * x / 0.28, 700.0 * y / 0.28].map(|side: f64| side.round() as u32);
        assert_eq!((found.size, found.rule), (expected, Rule::Ground));
        assert_eq!(found.size, [893, 1250]);

        let stated = model_size([1000, 700], Some(&utm), None, Some(0.5)).expect("a size");
        assert_eq!((stated.size, stated.rule), ([500, 700], Rule::Stated { metres: 0.5 }));
        assert!(stated.rule.words().contains("0.5 m"), "{}", stated.rule.words());
        let given = model_size([1000, 700], None, Some([0.14, 0.28]), None).expect("a size");
        assert_eq!((given.size, given.assumed), ([500, 700], false));
        assert_eq!(given.footprint, Footprint::of_gsd([1000, 700], [0.14, 0.28]));
        // Never nothing.
        let tiny = model_size([3, 1], None, Some([0.01, 0.01]), None).expect("a size");
        assert_eq!(tiny.size, [1, 1]);
    }

    #[test]
    fn a_picture_without_a_place_is_taken_as_it_is_and_that_is_said() {
        let found = model_size([300, 1], None, None, None).expect("a size");
        assert_eq!((found.size, found.rule, found.assumed), ([300, 1], Rule::AsGiven, true));
        assert_eq!(found.footprint.gsd_m, [64.48 / 256.0; 2]);
        assert!(found.warnings[0].contains("0.2519 m") && found.warnings[0].contains("--gsd"));
        let stated = model_size([300, 100], None, None, Some(64.48 / 128.0)).expect("a size");
        assert_eq!((stated.size, stated.assumed), ([150, 50], true));
        // What `infer` assumes of an image of the network's own size.
        let own = model_size([256, 256], None, None, None).expect("a size");
        assert_eq!(own.footprint, Footprint::of_training([256, 256]));
    }

    #[test]
    fn a_place_that_cannot_be_used_is_refused_or_dropped() {
        let rotated = raster(32610, [550_000.0, 0.3, 0.1, 5_270_000.0, 0.1, -0.3]);
        let error = model_size([100, 100], Some(&rotated), None, None).expect_err("rotated");
        let text = error.to_string();
        assert!(["rotated", "gdalwarp", "--gsd"].iter().all(|word| text.contains(word)), "{text}");
        let found =
            model_size([100, 100], Some(&rotated), Some([0.28, 0.28]), None).expect("a size");
        assert_eq!((found.size, found.footprint.place, found.assumed), ([100, 100], None, false));
        assert!(
            found.warnings[0].contains("rotated") && found.warnings[0].contains("without a place")
        );
        let mirrored = raster(32610, [550_000.0, 0.3, 0.0, 5_270_000.0, 0.0, 0.3]);
        let error = model_size([100, 100], Some(&mirrored), None, None).expect_err("mirrored");
        assert!(error.to_string().contains("mirrored"), "{error}");
    }

    #[test]
    fn nonsense_is_refused_with_its_values() {
        for bad in [0.0, -0.3, f64::NAN, f64::INFINITY, 1e5] {
            let error = model_size([9, 9], None, Some([0.3, bad]), None).expect_err("no distance");
            assert!(error.to_string().starts_with("--gsd"), "{error}");
            let error = model_size([9, 9], None, None, Some(bad)).expect_err("no distance");
            assert!(error.to_string().starts_with("--window-gsd"), "{error}");
        }
        let large = model_size([640, 640], None, Some([10.0, 10.0]), None).expect_err("too large");
        let text = large.to_string();
        assert!(text.contains("640 x 640") && text.contains("22857 x 22857"), "{text}");
        assert!(text.contains("16 model pixels per pixel") && text.contains("10.0000"), "{text}");
        let long = model_size([u32::MAX, 1], None, None, None).expect_err("too long");
        assert!(long.to_string().contains("67108864 along a side"), "{long}");
        assert!(model_size([100, 1], None, Some([0.28 * 16.0; 2]), None).is_ok());
    }
}
