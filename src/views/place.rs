//! Places on the command line: pixels, latitude and longitude, metres.

use super::{ViewError, World};
use crate::footprint::Footprint;
use crate::grid::{LonLat, PixelPoint};
use crate::model::Scene;
use crate::model::render::frames::{Vector, from_crop};
use serde::Serialize;
use std::fmt;
use std::str::FromStr;

/// z of the released street camera as a crop position; -0.68 in the cube.
pub const STREET_Z: f64 = -0.85;

/// A place, as it was asked for.
///
/// Written as `px:COLUMN,ROW`, `ll:LATITUDE,LONGITUDE` or `m:EAST,NORTH,UP`. Without a prefix three
/// numbers are metres, two whole numbers without a sign a pixel, two numbers with a decimal point latitude
/// and longitude; every other pair is refused. A pixel or a position on Earth must lie in the image, so
/// that none of them passes for another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// Column and row of the image as it was given; (0, 0) is its north-west corner, the first pixel's
    /// centre is at (0.5, 0.5).
    Pixel([f64; 2]),
    /// WGS 84.
    Geographic(LonLat),
    /// East, north, up in metres ([`World`]).
    Metres(Vector),
}

/// A text that is no place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is no place: {why}")]
pub struct PlaceError {
    /// The text.
    pub text: String,
    /// What is wrong with it, and what to write.
    pub why: String,
}

const FORMS: &str = "write px:COLUMN,ROW or ll:LATITUDE,LONGITUDE or m:EAST,NORTH,UP (metres from the crop's centre)";

impl FromStr for Place {
    type Err = PlaceError;

    fn from_str(text: &str) -> Result<Self, PlaceError> {
        let fail = |why: String| PlaceError { text: text.to_owned(), why };
        let (prefix, list) = match text.split_once(':') {
            Some((prefix, list)) => (Some(prefix.trim()), list),
            None => (None, text),
        };
        let words: Vec<&str> = list.split(',').map(str::trim).collect();
        let numbers = words.iter().map(|word| {
            let number: Option<f64> = word.parse().ok();
            number
                .filter(|v| v.is_finite())
                .ok_or_else(|| fail(format!("`{word}` is no number; {FORMS}")))
        });
        let numbers: Vec<f64> = numbers.collect::<Result<_, _>>()?;
        let geographic = |[lat_deg, lon_deg]: [f64; 2]| {
            if lat_deg.abs() > 90.0 || lon_deg.abs() > 180.0 {
                let hint = format!("a pixel is written px:{list}");
                return Err(fail(format!(
                    "latitude {lat_deg} and longitude {lon_deg} are not on Earth; {hint}"
                )));
            }
            Ok(Self::Geographic(LonLat { lon_deg, lat_deg }))
        };
        match (prefix, &numbers[..]) {
            (Some("px"), &[column, row]) => Ok(Self::Pixel([column, row])),
            (Some("ll"), &[lat, lon]) => geographic([lat, lon]),
            (Some("m") | None, &[east, north, up]) => Ok(Self::Metres([east, north, up])),
            (None, &[a, b]) => {
                let whole = |word: &&str| word.bytes().all(|byte| byte.is_ascii_digit());
                let decimal = |word: &&str| word.contains('.');
                if words.iter().all(whole) {
                    Ok(Self::Pixel([a, b]))
                } else if words.iter().all(decimal) {
                    geographic([a, b])
                } else {
                    Err(fail(format!("it may be a pixel or a latitude and a longitude; {FORMS}")))
                }
            }
            (Some(other), _) if !["px", "ll", "m"].contains(&other) => {
                Err(fail(format!("`{other}:` is no prefix; {FORMS}")))
            }
            (_, numbers) => Err(fail(format!("{} numbers; {FORMS}", numbers.len()))),
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pixel([column, row]) => write!(f, "px:{column},{row}"),
            Self::Geographic(at) => write!(f, "ll:{},{}", at.lat_deg, at.lon_deg),
            Self::Metres([east, north, up]) => write!(f, "m:{east},{north},{up}"),
        }
    }
}

/// How high a camera stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Height {
    /// Where the network was trained to look from: z = [`STREET_Z`] of the crop, whatever the ground.
    #[default]
    Street,
    /// Metres above the surface of the scene at that place.
    AboveSurface(f64),
}

/// Where a camera stands, or what it looks at, in one scene.
pub(super) struct Surroundings<'a> {
    pub scene: &'a Scene,
    pub footprint: &'a Footprint,
    pub world: World,
}

impl Surroundings<'_> {
    /// The crop position `(row, column)` of a pixel or a position on Earth.
    fn on_crop(&self, place: Place) -> Result<[f64; 2], ViewError> {
        let [width, height] = self.footprint.size_px;
        let crop = match place {
            Place::Pixel([x, y]) => self.footprint.crop_of_pixel(PixelPoint { x, y }),
            Place::Geographic(at) => {
                let because = |error: String| ViewError::Georeference { place, why: error };
                let on_earth = self.footprint.georeference().map_err(|e| because(e.to_string()))?;
                let Some(on_earth) = on_earth else {
                    return Err(ViewError::NoGeoreference { place });
                };
                on_earth.crop_of_lonlat(at).map_err(|e| because(e.to_string()))?
            }
            Place::Metres([east, north, _]) => {
                let [x, y, _] = self.world.to_cube([east, north, 0.0]);
                [-y / self.world.scale(), x / self.world.scale()]
            }
        };
        // A position on its edge may come out of a projection a hair outside.
        if crop.iter().any(|v| v.abs() > 1.0 + 1e-9) && !matches!(place, Place::Metres(_)) {
            let pixel = [
                (crop[1] + 1.0) / 2.0 * f64::from(width),
                (crop[0] + 1.0) / 2.0 * f64::from(height),
            ];
            return Err(ViewError::OutsideImage { place, pixel, size: [width, height] });
        }
        Ok(crop)
    }

    /// Where a camera stands, camera-world frame of the cube; without a place in the middle of the crop.
    pub fn camera(&self, place: Option<Place>, height: Height) -> Result<Vector, ViewError> {
        let crop = match (place, height) {
            (Some(Place::Metres(metres)), Height::Street) => return Ok(self.world.to_cube(metres)),
            (Some(place @ Place::Metres(_)), Height::AboveSurface(metres)) => {
                return Err(ViewError::TwoHeights { place, metres });
            }
            (Some(place), _) => self.on_crop(place)?,
            (None, _) => [0.0, 0.0],
        };
        self.camera_on_crop(crop, height)
    }

    /// As [`Self::camera`], for a crop position `(row, column)`.
    pub fn camera_on_crop(
        &self,
        [row, column]: [f64; 2],
        height: Height,
    ) -> Result<Vector, ViewError> {
        let street = from_crop([row, column, STREET_Z], self.world.scale());
        match height {
            Height::Street => Ok(street),
            Height::AboveSurface(metres) => {
                let [x, y, _] = street;
                let surface = self.world.surface_or_error(self.scene, [x, y])?;
                let [east, north, up] = self.world.to_metres([x, y, surface]);
                Ok(self.world.to_cube([east, north, up + metres]))
            }
        }
    }

    /// What a camera looks at: a place in metres as it is, any other on the surface there.
    pub fn target(&self, place: Place) -> Result<Vector, ViewError> {
        if let Place::Metres(metres) = place {
            return Ok(self.world.to_cube(metres));
        }
        let [row, column] = self.on_crop(place)?;
        let [x, y, _] = from_crop([row, column, 0.0], self.world.scale());
        Ok([x, y, self.world.surface_or_error(self.scene, [x, y])?])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_is_read_and_written_back() {
        let lonlat = LonLat { lat_deg: 47.6, lon_deg: -122.33 };
        for (text, want) in [
            ("px:320,200", Place::Pixel([320.0, 200.0])),
            ("320,200", Place::Pixel([320.0, 200.0])),
            ("px: 320.5, 200.25", Place::Pixel([320.5, 200.25])),
            ("47.6,-122.33", Place::Geographic(lonlat)),
            ("ll:47.6,-122.33", Place::Geographic(lonlat)),
            ("ll:47,9", Place::Geographic(LonLat { lat_deg: 47.0, lon_deg: 9.0 })),
            ("1,-2,3.5", Place::Metres([1.0, -2.0, 3.5])),
            ("m:1,-2,3.5", Place::Metres([1.0, -2.0, 3.5])),
        ] {
            let place: Place = text.parse().expect(text);
            assert_eq!(place, want, "{text}");
            assert_eq!(place.to_string().parse(), Ok(want), "{place}");
        }
    }

    #[test]
    fn what_could_be_misread_is_refused_with_the_value_and_what_to_write() {
        for (text, says) in [
            ("320.5,200.5", "px:320.5,200.5"),
            ("-3,7", "may be a pixel or"),
            ("320,200.5", "may be a pixel or"),
            ("px:1,2,3", "3 numbers"),
            ("m:1,2", "2 numbers"),
            ("5", "1 numbers"),
            ("px:a,2", "`a` is no number"),
            ("nan,1.0", "`nan` is no number"),
            ("1.0,inf", "`inf` is no number"),
            ("latlon:1,2", "`latlon:` is no prefix"),
            ("ll:91,0", "not on Earth"),
            ("", "`` is no number"),
        ] {
            let error = text.parse::<Place>().expect_err(text).to_string();
            assert!(error.contains(says) && error.contains(&format!("`{text}`")), "{error}");
        }
    }
}
