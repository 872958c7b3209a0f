//! Reading a scene file, and refusing values that make no sense.

use super::error::SceneError;
use super::spec::{Sampling, SceneSpec, Season, TileStorage};
use std::fmt::Display;
use std::path::Path;

/// Box of the state of Washington, where lidar is delivered in EPSG:2927: west, south, east,
/// north in degrees (the state uses its South zone for statewide deliveries).
const WASHINGTON: [f64; 4] = [-124.9, 45.5, -116.9, 49.05];
/// Side of the largest scene, metres: the index and the plan stay within some GB.
const LARGEST_M: f64 = 20_000.0;
/// Most pixels of a picture: what image libraries count with 31 bits.
const MOST_PIXELS: f64 = 2_147_483_648.0;

impl SceneSpec {
    /// Reads and checks a scene file.
    ///
    /// # Errors
    /// [`SceneError`] naming the file, the key and the value.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// Parses and checks the text of a scene file; `path` is for messages.
    ///
    /// # Errors
    /// [`SceneError`] naming the file, the key and the value.
    pub fn parse(text: &str, path: &Path) -> Result<Self, SceneError> {
        let spec: Self = toml::from_str(text).map_err(|e| SceneError::Toml {
            path: path.to_owned(),
            reason: e.to_string().trim_end().to_owned(),
        })?;
        spec.check(path)?;
        Ok(spec)
    }

    /// Checks every value; `path` is for messages.
    ///
    /// # Errors
    /// [`SceneError::Value`] for the first value that makes no sense.
    pub fn check(&self, path: &Path) -> Result<(), SceneError> {
        let c = Check { path };
        let [west, south, east, north] = WASHINGTON;
        let area = "lidar is delivered in EPSG:2927 only in the state of Washington";
        c.range("place.latitude_degrees", self.place.latitude_degrees, south, north, area)?;
        c.range("place.longitude_degrees", self.place.longitude_degrees, west, east, area)?;
        c.range("extent.width_metres", self.extent.width_metres, 20.0, LARGEST_M, "")?;
        c.range("extent.height_metres", self.extent.height_metres, 20.0, LARGEST_M, "")?;
        self.check_ground(&c)?;
        self.check_objects(&c)?;
        self.check_light(&c)?;
        self.check_lidar(&c)?;
        self.check_images(&c)?;
        self.check_picture(&c)?;
        self.check_camera(&c)?;
        self.check_detail(&c)
    }

    fn check_camera(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let Some(camera) = &self.camera else { return Ok(()) };
        c.range("camera.sky_light", camera.sky_light, 0.1, 2.0, "")?;
        c.range("camera.haze", camera.haze, 0.0, 0.6, "")?;
        c.range("camera.exposure", camera.exposure, 0.2, 4.0, "")?;
        for factor in camera.white_balance {
            c.range("camera.white_balance", factor, 0.5, 2.0, "")?;
        }
        c.range("camera.saturation", camera.saturation, 0.0, 2.0, "")?;
        c.range("camera.contrast", camera.contrast, 0.3, 3.0, "")?;
        c.range("camera.blur_pixels", camera.blur_pixels, 0.0, 5.0, "")?;
        c.range("camera.sharpening", camera.sharpening, 0.0, 2.0, "")
    }

    fn check_detail(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let Some(detail) = &self.detail else { return Ok(()) };
        c.range("detail.railway", detail.railway, 0.0, 1e6, "a weight is not negative")?;
        c.range("detail.larger_trees", detail.larger_trees, 0.0, 2.0, "")?;
        c.share("detail.flats_share", detail.flats_share)?;
        c.share("detail.grey_share", detail.grey_share)?;
        c.share("detail.closed_canopy", detail.closed_canopy)?;
        c.share("detail.wires_share", detail.wires_share)?;
        c.share("detail.fence_share", detail.fence_share)
    }

    fn check_ground(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let t = &self.terrain;
        c.range("terrain.base_height_metres", t.base_height_metres, -400.0, 4400.0, "")?;
        c.range("terrain.relief_metres", t.relief_metres, 0.0, 1000.0, "")?;
        c.range("terrain.wavelength_metres", t.wavelength_metres, 20.0, 1e6, "")?;
        c.range("terrain.slope_percent", t.slope_percent, 0.0, 100.0, "")?;
        c.range("terrain.slope_azimuth_degrees", t.slope_azimuth_degrees, -360.0, 360.0, "")?;
        let steepest = t.relief_metres / 2.0 * std::f64::consts::TAU / (0.75 * t.wavelength_metres);
        c.want(
            "terrain.relief_metres",
            t.relief_metres,
            steepest <= 1.5,
            "hills of this height and wavelength are steeper than 1.5 m per metre; lower them or make the wavelength longer",
        )?;
        if let Some(w) = &self.water {
            c.range("water.share", w.share, 0.0, 0.9, "")?;
            c.range("water.shoreline_swing_metres", w.shoreline_swing_metres, 0.0, 500.0, "")?;
            c.range("water.docks_per_100_metres", w.docks_per_100_metres, 0.0, 10.0, "")?;
            let reach = libm::hypot(self.extent.width_metres, self.extent.height_metres) / 2.0;
            let lowest =
                t.base_height_metres - t.slope_percent / 100.0 * reach - t.relief_metres / 2.0;
            c.want(
                "water.level_metres",
                w.level_metres,
                w.level_metres.is_finite() && w.level_metres < lowest,
                &format!(
                    "the water must lie below the land, whose lowest point can be {lowest:.1} m (terrain.base_height_metres, relief and slope)"
                ),
            )?;
        }
        Ok(())
    }

    fn check_objects(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let s = &self.streets;
        c.range("streets.azimuth_degrees", s.azimuth_degrees, -360.0, 360.0, "")?;
        c.range("streets.block_width_metres", s.block_width_metres, 40.0, 2000.0, "")?;
        c.range("streets.block_length_metres", s.block_length_metres, 40.0, 2000.0, "")?;
        c.range("streets.irregularity", s.irregularity, 0.0, 0.4, "")?;
        let b = &self.blocks;
        let weights = [
            ("blocks.downtown", b.downtown),
            ("blocks.commercial", b.commercial),
            ("blocks.industrial", b.industrial),
            ("blocks.suburb", b.suburb),
            ("blocks.park", b.park),
            ("blocks.forest", b.forest),
        ];
        for (key, weight) in weights {
            c.range(key, weight, 0.0, 1e6, "a weight is not negative")?;
        }
        let sum: f64 = weights.iter().map(|w| w.1).sum();
        c.want("blocks.*", sum, sum > 0.0, "at least one weight must be above 0")?;
        c.range("blocks.tower_height_metres", b.tower_height_metres, 6.0, 400.0, "")?;
        let t = &self.trees;
        c.range("trees.per_garden", t.per_garden, 0.0, 20.0, "")?;
        c.range("trees.street_spacing_metres", t.street_spacing_metres, 0.0, 1e4, "")?;
        c.want(
            "trees.street_spacing_metres",
            t.street_spacing_metres,
            t.street_spacing_metres == 0.0 || t.street_spacing_metres >= 3.0,
            "street trees stand at least 3 m apart (0 for none)",
        )?;
        c.range("trees.park_per_hectare", t.park_per_hectare, 0.0, 1000.0, "")?;
        c.range("trees.forest_per_hectare", t.forest_per_hectare, 0.0, 1000.0, "")?;
        c.range("trees.height_metres", t.height_metres, 2.0, 110.0, "")?;
        c.range("cars.driving_per_100_metres", self.cars.driving_per_100_metres, 0.0, 8.0, "")?;
        for (key, share) in [
            ("blocks.built_share", b.built_share),
            ("blocks.hipped_share", b.hipped_share),
            ("trees.conifer_share", t.conifer_share),
            ("cars.parked_share", self.cars.parked_share),
        ] {
            c.share(key, share)?;
        }
        if let Some(change) = &self.change {
            c.share("change.built_share_per_year", change.built_share_per_year)?;
            c.share("change.demolished_share_per_year", change.demolished_share_per_year)?;
            c.share("change.felled_share_per_year", change.felled_share_per_year)?;
            c.range("change.growth_metres_per_year", change.growth_metres_per_year, 0.0, 5.0, "")?;
        }
        Ok(())
    }

    fn check_light(&self, c: &Check<'_>) -> Result<(), SceneError> {
        if let Some(sun) = &self.sun {
            c.range("sun.azimuth_degrees", sun.azimuth_degrees, -360.0, 360.0, "")?;
            c.want(
                "sun.elevation_degrees",
                sun.elevation_degrees,
                sun.elevation_degrees >= 0.5 && sun.elevation_degrees <= 90.0,
                "the sun must stand above the horizon (0.5 to 90); leave the [sun] table out for an overcast sky",
            )?;
        }
        if let Some(view) = &self.view {
            c.range("view.off_nadir_degrees", view.off_nadir_degrees, 0.0, 45.0, "")?;
            c.range("view.azimuth_degrees", view.azimuth_degrees, -360.0, 360.0, "")?;
        }
        Ok(())
    }

    fn check_lidar(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let l = &self.lidar;
        c.range("lidar.noise_sigma_metres", l.noise_sigma_metres, 0.0, 10.0, "")?;
        c.range("lidar.missing_pulse_share", l.missing_pulse_share, 0.0, 0.9, "")?;
        c.share("lidar.crown_penetration_share", l.crown_penetration_share)?;
        c.range("lidar.gap_width_metres", l.gap_width_metres, 0.0, 1000.0, "")?;
        c.range("lidar.gap_count", f64::from(l.gap_count), 0.0, 1000.0, "")?;
        let t = &self.tiles;
        c.range("tiles.columns", f64::from(t.columns), 1.0, 100.0, "")?;
        c.range("tiles.rows", f64::from(t.rows), 1.0, 100.0, "")?;
        c.range("tiles.pixel_feet", t.pixel_feet, 0.1, 100.0, "")?;
        c.range("tiles.overlap_pixels", f64::from(t.overlap_pixels), 0.0, 4096.0, "")?;
        c.range("tiles.block_pixels", f64::from(t.block_pixels), 1.0, 4096.0, "")?;
        c.want(
            "tiles.block_pixels",
            t.block_pixels,
            t.storage == TileStorage::Strips || t.block_pixels.is_multiple_of(16),
            "the side of a square block is a multiple of 16",
        )?;
        c.want(
            "tiles.nodata",
            t.nodata,
            t.nodata.is_nan() || t.nodata.abs() > 20_000.0 || t.nodata <= -2000.0,
            "a nodata value that could be a height in feet; use -9999, -3.4028234663852886e38 or nan",
        )?;
        c.want(
            "tiles.nodata",
            t.nodata,
            t.nodata.is_nan() || f64::from(t.nodata as f32).is_finite(),
            "it does not fit into 32-bit floats",
        )
    }

    fn check_images(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let i = &self.images;
        c.range("images.zoom", f64::from(i.zoom), 15.0, 23.0, "")?;
        c.range("images.size_pixels", f64::from(i.size_pixels), 16.0, 4096.0, "")?;
        c.range("images.spacing_pixels", i.spacing_pixels, 1.0, 1e5, "")?;
        c.range("images.panoramas_per_image", i.panoramas_per_image, 0.0, 100.0, "")?;
        c.range("images.sensor_noise_levels", i.sensor_noise_levels, 0.0, 60.0, "")?;
        c.range("images.year", f64::from(i.year), 1900.0, 2200.0, "")?;
        c.range("lidar.year", f64::from(self.lidar.year), 1900.0, 2200.0, "")?;
        for (k, [lat, lon]) in i.centres_degrees.iter().enumerate() {
            let near = (lat - self.place.latitude_degrees).abs() < 0.3
                && (lon - self.place.longitude_degrees).abs() < 0.5;
            c.want(
                &format!("images.centres_degrees[{k}]"),
                format!("[{lat}, {lon}]"),
                near,
                "not near the scene's place (latitude comes first)",
            )?;
        }
        Ok(())
    }

    fn check_picture(&self, c: &Check<'_>) -> Result<(), SceneError> {
        let Some(p) = &self.picture else { return Ok(()) };
        if let Some(zoom) = p.zoom {
            c.range("picture.zoom", f64::from(zoom), 10.0, 24.0, "")?;
        }
        if let Some(metres) = p.pixel_metres {
            c.range("picture.pixel_metres", metres, 0.01, 100.0, "")?;
            let why = "zoom gives the size of a pixel too; leave one of the two out";
            c.want("picture.pixel_metres", metres, p.zoom.is_none(), why)?;
        }
        c.range("picture.truth_spacing_pixels", p.truth_spacing_pixels, 1.0, 1000.0, "")?;
        let mut sides = [self.extent.width_metres, self.extent.height_metres];
        let given =
            [("picture.width_metres", p.width_metres), ("picture.height_metres", p.height_metres)];
        for ((key, metres), side) in given.into_iter().zip(&mut sides) {
            if let Some(metres) = metres {
                c.range(key, metres, 1.0, *side, "it must lie in the extent")?;
                *side = metres;
            }
        }
        let pixel = p.pixel_size(self.place.latitude_degrees);
        let [width, height] = sides.map(|side| (side / pixel).ceil());
        c.want(
            "picture",
            format!("{width} x {height} pixels"),
            width * height <= MOST_PIXELS,
            &format!(
                "a picture has at most {MOST_PIXELS} pixels; make [extent], width_metres or height_metres smaller, or the pixels larger (zoom, pixel_metres)"
            ),
        )
    }

    /// Years from the lidar to the images, without sign.
    #[must_use]
    pub fn years_apart(&self) -> f64 {
        f64::from((self.images.year - self.lidar.year).abs())
    }

    /// Whether leaves differ between lidar and images.
    #[must_use]
    pub fn seasons_differ(&self) -> bool {
        (self.lidar.season == Season::Winter) != (self.images.season == Season::Winter)
    }

    /// Whether a lidar cell is a mean.
    #[must_use]
    pub fn samples_areas(&self) -> bool {
        self.lidar.sampling == Sampling::Area
    }
}

struct Check<'a> {
    path: &'a Path,
}

impl Check<'_> {
    fn want(&self, key: &str, value: impl Display, ok: bool, why: &str) -> Result<(), SceneError> {
        if ok {
            return Ok(());
        }
        Err(SceneError::Value {
            path: self.path.to_owned(),
            key: key.to_owned(),
            value: value.to_string(),
            reason: why.to_owned(),
        })
    }

    fn range(
        &self,
        key: &str,
        value: f64,
        low: f64,
        high: f64,
        why: &str,
    ) -> Result<(), SceneError> {
        let mut reason = format!("must be between {low} and {high}");
        if !why.is_empty() {
            reason = format!("{reason}; {why}");
        }
        // NaN fails the comparison, as it should.
        self.want(key, value, value >= low && value <= high, &reason)
    }

    fn share(&self, key: &str, value: f64) -> Result<(), SceneError> {
        self.range(key, value, 0.0, 1.0, "it is a share")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(text: &str) -> String {
        SceneSpec::parse(text, Path::new("city.toml")).expect_err("must be refused").to_string()
    }

    #[test]
    fn an_empty_file_is_a_scene() {
        let spec = SceneSpec::parse("", Path::new("x.toml")).expect("defaults");
        assert_eq!(spec, SceneSpec::default());
        assert!(spec.sun.is_none() && spec.view.is_none() && spec.change.is_none());
    }

    #[test]
    fn bad_values_name_the_file_the_key_and_the_value() {
        for (text, parts) in [
            (
                "[sun]\nazimuth_degrees = 180\nelevation_degrees = -5",
                vec!["sun.elevation_degrees = -5", "overcast"],
            ),
            ("[extent]\nwidth_metres = -10", vec!["extent.width_metres = -10"]),
            (
                "[place]\nlatitude_degrees = 51.5",
                vec!["place.latitude_degrees = 51.5", "Washington"],
            ),
            ("[place]\nlongitude_degrees = nan", vec!["place.longitude_degrees = NaN"]),
            ("[water]\nlevel_metres = 90", vec!["water.level_metres = 90", "below the land"]),
            ("[blocks]\nsuburb = -1", vec!["blocks.suburb = -1"]),
            ("[lidar]\nnoise_sigma_metres = inf", vec!["lidar.noise_sigma_metres = inf"]),
            ("[tiles]\nnodata = 0", vec!["tiles.nodata = 0", "could be a height"]),
            ("[tiles]\nblock_pixels = 100", vec!["tiles.block_pixels = 100", "multiple of 16"]),
            (
                "[view]\noff_nadir_degrees = 60\nazimuth_degrees = 0",
                vec!["view.off_nadir_degrees = 60"],
            ),
            (
                "[images]\ncentres_degrees = [[-122.3, 47.6]]",
                vec!["centres_degrees[0]", "latitude comes first"],
            ),
            ("[terrain]\nrelief_metres = 500", vec!["terrain.relief_metres = 500", "steeper"]),
            ("[picture]\nzoom = 30", vec!["picture.zoom = 30"]),
            (
                "[picture]\nzoom = 20\npixel_metres = 0.3",
                vec!["picture.pixel_metres = 0.3", "leave one of the two out"],
            ),
            ("[picture]\nwidth_metres = 400", vec!["picture.width_metres = 400", "280"]),
            ("[picture]\ntruth_spacing_pixels = 0", vec!["picture.truth_spacing_pixels = 0"]),
            (
                "[extent]\nwidth_metres = 5000\nheight_metres = 6000\n[picture]\npixel_metres = 0.1",
                vec!["picture = 50000 x 60000 pixels", "2147483648", "pixel_metres"],
            ),
        ] {
            let message = error(text);
            assert!(message.starts_with("city.toml: "), "{message}");
            for part in parts {
                assert!(message.contains(part), "{message} lacks {part}");
            }
        }
    }

    #[test]
    fn unknown_keys_are_refused_with_their_line() {
        let message =
            error("seed = 3\n[sun]\nazimuth_degrees = 1\nelevation_degrees = 30\nheight = 2\n");
        assert!(
            message.contains("unknown field `height`") && message.contains("line 5"),
            "{message}"
        );
        assert!(error("[suns]\n").contains("unknown field `suns`"));
        assert!(error("[sun]\nazimuth_degrees = 1").contains("elevation_degrees"));
        assert!(error("seed = \"x\"").contains("seed"));
    }
}
