//! Names of satellite images: `satellite_<lat>_<lon>.png`, the name is the image's centre.

use crate::grid::LonLat;
use std::path::Path;

/// Why a file name says no position.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// The name is not `satellite_<lat>_<lon>`.
    #[error(
        "`{name}` is not named satellite_<lat>_<lon>.png (for example satellite_47.6097_-122.3331.png)"
    )]
    Form {
        /// The name as found.
        name: String,
    },
    /// The name is not `<id>,<lat>,<lon>,.jpg`.
    #[error(
        "`{name}` is not named <id>,<lat>,<lon>,.jpg (for example EPdy_ww,47.582113,-122.314680,.jpg)"
    )]
    Panorama {
        /// The name as found.
        name: String,
    },
    /// A coordinate of the name is no finite number or lies outside the globe.
    #[error("`{name}`: {axis} `{value}` is not a number of degrees between -{limit} and {limit}")]
    Coordinate {
        /// The name as found.
        name: String,
        /// `latitude` or `longitude`.
        axis: &'static str,
        /// The text of the coordinate.
        value: String,
        /// 90 or 180.
        limit: u8,
    },
}

/// A parsed satellite image name. The stem is kept as written: it is what pairs files.
#[derive(Clone, Debug, PartialEq)]
pub struct SatelliteName {
    stem: String,
    center: LonLat,
}

impl SatelliteName {
    /// Parses `satellite_<lat>_<lon>`, with or without a folder and an image extension
    /// (`.png`, `.jpg`, `.jpeg`, `.tif`, `.tiff`, `.npz`, `.webp`).
    ///
    /// # Errors
    /// [`NameError`] with the offending part.
    pub fn parse(path: &str) -> Result<Self, NameError> {
        let name = Path::new(path).file_name().and_then(|n| n.to_str()).unwrap_or(path);
        let stem = match name.rsplit_once('.') {
            Some((stem, extension))
                if ["png", "jpg", "jpeg", "tif", "tiff", "npz", "webp"]
                    .iter()
                    .any(|known| extension.eq_ignore_ascii_case(known)) =>
            {
                stem
            }
            _ => name,
        };
        let form = || NameError::Form { name: name.to_owned() };
        let mut parts = stem.split('_');
        let (Some("satellite"), Some(lat), Some(lon), None) =
            (parts.next(), parts.next(), parts.next(), parts.next())
        else {
            return Err(form());
        };
        let center = LonLat {
            lon_deg: coordinate(name, "longitude", lon, 180)?,
            lat_deg: coordinate(name, "latitude", lat, 90)?,
        };
        Ok(Self { stem: stem.to_owned(), center })
    }

    /// The name without folder and extension, exactly as written.
    #[must_use]
    pub fn stem(&self) -> &str {
        &self.stem
    }

    /// The image's centre.
    #[must_use]
    pub const fn center(&self) -> LonLat {
        self.center
    }
}

/// A coordinate in degrees, at most `limit` away from zero.
pub(super) fn coordinate(
    name: &str,
    axis: &'static str,
    text: &str,
    limit: u8,
) -> Result<f64, NameError> {
    text.parse::<f64>()
        .ok()
        // `parse` also reads "nan" and "inf", which are no coordinates.
        .filter(|v| v.abs() <= f64::from(limit))
        .ok_or_else(|| NameError::Coordinate {
            name: name.to_owned(),
            axis,
            value: text.to_owned(),
            limit,
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn latitude_comes_first_in_a_name() {
        let name = SatelliteName::parse("a/b/satellite_47.57_-122.30.png").expect("parses");
        assert_eq!(name.center(), LonLat { lon_deg: -122.30, lat_deg: 47.57 });
        assert_eq!(name.stem(), "satellite_47.57_-122.30");
    }

    #[test]
    fn a_stem_without_extension_keeps_its_digits() {
        let name = SatelliteName::parse("satellite_47.57_-122.30149079418568").expect("parses");
        assert_eq!(name.center().lon_deg, -122.301_490_794_185_68);
    }

    #[test]
    fn bad_names_are_told_apart() {
        for bad in ["", "x.png", "satellite_47.png", "satellite_1_2_3.png", "Satellite_1_2.png"] {
            assert!(matches!(SatelliteName::parse(bad), Err(NameError::Form { .. })), "{bad}");
        }
        for bad in [
            "satellite_nan_1.png",
            "satellite_91_1.png",
            "satellite_1_x.png",
            "satellite_1_-181.png",
        ] {
            assert!(
                matches!(SatelliteName::parse(bad), Err(NameError::Coordinate { .. })),
                "{bad}"
            );
        }
    }
}
