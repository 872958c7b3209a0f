//! Names of panoramas: `<id>,<lat>,<lon>,.jpg`, the name says where the camera stood.

use super::name::{NameError, coordinate};
use crate::grid::LonLat;
use std::path::Path;

/// A parsed panorama name.
#[derive(Clone, Debug, PartialEq)]
pub struct PanoramaName {
    id: String,
    position: LonLat,
}

impl PanoramaName {
    /// Parses `<id>,<lat>,<lon>,.jpg`, with or without a folder; the extension may be missing, and
    /// so may the comma before it. The id may hold commas of its own.
    ///
    /// # Errors
    /// [`NameError`] with the offending part.
    pub fn parse(path: &str) -> Result<Self, NameError> {
        let name = Path::new(path).file_name().and_then(|n| n.to_str()).unwrap_or(path);
        let stem = match name.rsplit_once('.') {
            Some((stem, extension))
                if ["jpg", "jpeg", "png"].iter().any(|e| extension.eq_ignore_ascii_case(e)) =>
            {
                stem
            }
            _ => name,
        };
        let stem = stem.strip_suffix(',').unwrap_or(stem);
        let mut parts = stem.rsplitn(3, ',');
        let (Some(lon), Some(lat), Some(id)) = (parts.next(), parts.next(), parts.next()) else {
            return Err(NameError::Panorama { name: name.to_owned() });
        };
        let position = LonLat {
            lon_deg: coordinate(name, "longitude", lon, 180)?,
            lat_deg: coordinate(name, "latitude", lat, 90)?,
        };
        Ok(Self { id: id.to_owned(), position })
    }

    /// The part before the position: the id of the panorama at its provider.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Where the camera stood.
    #[must_use]
    pub const fn position(&self) -> LonLat {
        self.position
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forms_that_occur() {
        let at = LonLat { lon_deg: -122.314_680, lat_deg: 47.582_113 };
        for text in [
            "EPdy_wwpT03WDToUUDkHnQ,47.582113,-122.314680,.jpg",
            "Seattle/panorama/EPdy_wwpT03WDToUUDkHnQ,47.582113,-122.314680,.jpg",
            "EPdy_wwpT03WDToUUDkHnQ,47.582113,-122.314680.jpg",
            "EPdy_wwpT03WDToUUDkHnQ,47.582113,-122.314680,",
        ] {
            let name = PanoramaName::parse(text).expect(text);
            assert_eq!((name.id(), name.position()), ("EPdy_wwpT03WDToUUDkHnQ", at), "{text}");
        }
        assert_eq!(PanoramaName::parse("a,b,1,2,.jpg").expect("parses").id(), "a,b");
    }

    #[test]
    fn bad_names_are_told_apart() {
        for bad in ["", "x.jpg", "id,47.5.jpg"] {
            assert!(matches!(PanoramaName::parse(bad), Err(NameError::Panorama { .. })), "{bad}");
        }
        for bad in ["id,nan,1,.jpg", "id,91,0,.jpg", "id,1,x,.jpg", "id,1,-181,.jpg", "id,,1,.jpg"]
        {
            assert!(matches!(PanoramaName::parse(bad), Err(NameError::Coordinate { .. })), "{bad}");
        }
    }
}
