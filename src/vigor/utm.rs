//! The formula behind the corrected labels: differences of UTM coordinates over one resolution per
//! city.
//!
//! `d0 = round(-(N_pano - N_sat) / res)`, `d1 = round(-(E_pano - E_sat) / res)` in WGS 84 / UTM
//! (EPSG:326zz, 327zz), so `+d0` is south and `+d1` is west. The formula takes grid north for true
//! north and one pixel size for a whole city; the exact pixel does neither.

use crate::crs::{CrsError, CrsSpec, Projection, ResolveOptions, resolve};
use crate::grid::{LonLat, Projected};
use std::collections::BTreeMap;
use std::sync::Arc;

/// A zone of WGS 84 / UTM.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UtmZone {
    number: u8,
    south: bool,
}

impl UtmZone {
    /// The zone of a position: 6 degrees of longitude each, from 180 W. The exceptions around
    /// Norway and Svalbard, which the labels do not know, are not made.
    #[must_use]
    pub fn of(at: LonLat) -> Self {
        // 180 E belongs to zone 60.
        let number = (((at.lon_deg + 180.0) / 6.0).floor() as u8 + 1).min(60);
        Self { number, south: at.lat_deg < 0.0 }
    }

    /// EPSG code: 32601 to 32660 in the north, 32701 to 32760 in the south.
    #[must_use]
    pub fn epsg(self) -> u32 {
        u32::from(self.number) + if self.south { 32_700 } else { 32_600 }
    }
}

/// Projections of the zones that a data set touches.
#[derive(Debug, Default)]
pub struct UtmZones(BTreeMap<UtmZone, Arc<dyn Projection>>);

impl UtmZones {
    /// Resolves every zone that occurs once; each further look-up is a map access.
    ///
    /// # Errors
    /// [`CrsError`] if a zone cannot be served.
    pub fn resolve(zones: impl IntoIterator<Item = UtmZone>) -> Result<Self, CrsError> {
        let mut all = BTreeMap::new();
        for zone in zones {
            if let std::collections::btree_map::Entry::Vacant(slot) = all.entry(zone) {
                let spec = CrsSpec::from_epsg(zone.epsg());
                slot.insert(resolve(&spec, &ResolveOptions::default())?.projection);
            }
        }
        Ok(Self(all))
    }

    /// Easting and northing in a zone, metres; `None` where the zone was not resolved or the
    /// projection is undefined.
    #[must_use]
    pub fn project(&self, zone: UtmZone, at: LonLat) -> Option<Projected> {
        self.0.get(&zone)?.forward(at).ok()
    }
}

/// The offset `[d0, d1]` of a panorama from an image's centre, both in UTM metres of one zone, as
/// the corrected labels give it. Halves round to even, as numpy does.
#[must_use]
pub fn corrected_offset(panorama: Projected, satellite: Projected, resolution_m: f64) -> [i64; 2] {
    let pixels = |metres: f64| (-metres / resolution_m).round_ties_even() as i64;
    [pixels(panorama.y - satellite.y), pixels(panorama.x - satellite.x)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(lon_deg: f64, lat_deg: f64) -> LonLat {
        LonLat { lon_deg, lat_deg }
    }

    #[test]
    fn zones_of_the_four_cities_and_of_the_seams() {
        for (position, epsg) in [
            (at(-122.33, 47.61), 32_610),
            (at(-122.42, 37.77), 32_610),
            (at(-87.63, 41.88), 32_616),
            (at(-73.99, 40.73), 32_618),
            (at(-180.0, 1.0), 32_601),
            (at(180.0, 1.0), 32_660),
            (at(-0.0001, -1.0), 32_730),
            (at(0.0, 0.0), 32_631),
        ] {
            assert_eq!(UtmZone::of(position).epsg(), epsg, "{position:?}");
        }
    }

    #[test]
    fn halves_round_to_even() {
        let p = |x, y| Projected { x, y };
        let offset = |dx: f64, dy: f64| corrected_offset(p(dx, dy), p(0.0, 0.0), 1.0);
        assert_eq!(offset(0.5, 1.5), [-2, 0]);
        assert_eq!(offset(-2.5, -0.5), [0, 2]);
        assert_eq!(offset(1.0, 2.0), [-2, -1], "north is minus d0, east is minus d1");
    }

    #[test]
    fn projects_as_proj_does() {
        // PROJ 9.1.1: echo 47.582113 -122.314680 | cs2cs -f %.9f EPSG:4326 EPSG:32610
        let place = at(-122.314_680, 47.582_113);
        let zones = UtmZones::resolve([UtmZone::of(place)]).expect("a zone");
        let p = zones.project(UtmZone::of(place), place).expect("inside");
        assert!(
            (p.x - 551_533.161_016_286).abs() < 1e-7 && (p.y - 5_270_083.048_258_77).abs() < 1e-7,
            "{p:?}"
        );
        assert_eq!(zones.project(UtmZone::of(at(3.0, 1.0)), place), None, "not resolved");
    }

    proptest! {
        #[test]
        fn every_longitude_has_a_zone_whose_meridian_is_within_three_degrees(lon in -180.0..=180.0_f64) {
            let epsg = UtmZone::of(at(lon, 10.0)).epsg();
            let meridian = f64::from(epsg - 32_600) * 6.0 - 183.0;
            prop_assert!((lon - meridian).abs() <= 3.0);
        }
    }
}
