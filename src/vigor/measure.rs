//! Where each panorama really lies in its images, and what its label says instead.

use super::dataset::{Dataset, Pair};
use super::utm::{UtmZone, UtmZones, corrected_offset};
use crate::crs::CrsError;
use crate::grid::{LonLat, PixelPoint, Projected, WGS84_A};
use rayon::prelude::*;
use std::f64::consts::PI;

/// Flattening of the WGS 84 ellipsoid (EPSG:7030).
const WGS84_F: f64 = 1.0 / 298.257_223_563;

/// What is found out about one pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Exact Web-Mercator pixel of the panorama in the image; the centre of the first pixel is 0.5.
    pub pixel: PixelPoint,
    /// Whether that pixel lies inside the image.
    pub inside: bool,
    /// Whether the label lies inside the image; `None` where there is no label.
    pub label_inside: Option<bool>,
    /// The offset `[d0, d1]` that the UTM formula gives; `None` where the city's resolution is
    /// unknown.
    pub utm: Option<[i64; 2]>,
    /// Whether the label is what the UTM formula gives.
    pub reproduced: Option<bool>,
    /// Label minus exact pixel; `None` where there is no label.
    pub residual: Option<Residual>,
}

/// Where a label puts the panorama, minus where it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// Pixels to the east.
    pub x_px: f64,
    /// Pixels to the south.
    pub y_px: f64,
    /// Length, pixels.
    pub px: f64,
    /// Length on the ground, metres.
    pub metres: f64,
}

/// Ground size of a Web-Mercator pixel on the WGS 84 ellipsoid, metres: along the parallel and
/// along the meridian. (On the sphere, which is the usual shortcut, both would be the pixel size
/// times the cosine of the latitude: 0.2 % short in Seattle.)
#[must_use]
pub fn ground_pixel_size(lat_deg: f64, zoom: u8) -> [f64; 2] {
    let (sin, cos) = libm::sincos(lat_deg.to_radians());
    let e2 = WGS84_F * (2.0 - WGS84_F);
    let w2 = 1.0 - e2 * sin * sin;
    let prime_vertical = WGS84_A / w2.sqrt();
    let meridional = prime_vertical * (1.0 - e2) / w2;
    // One pixel is this much longitude, and this much latitude over the cosine of the latitude.
    let radians = 2.0 * PI / (256_u64 << zoom) as f64 * cos;
    [radians * prime_vertical, radians * meridional]
}

/// Measures every pair. `resolution_m` replaces the resolutions of the cities, if given.
///
/// # Errors
/// [`CrsError`] if a UTM zone cannot be served.
pub fn measure(dataset: &Dataset, resolution_m: Option<f64>) -> Result<Vec<Measured>, CrsError> {
    let resolutions: Vec<Option<f64>> = (0..dataset.cities.len())
        .map(|city| resolution_m.or_else(|| dataset.resolution_m(city as u32)))
        .collect();
    let wanted = |city: u32| resolutions[city as usize].is_some();
    let panoramas: Vec<LonLat> = dataset.panoramas.iter().map(|p| p.position).collect();
    let satellites: Vec<LonLat> = dataset.satellites.iter().map(|s| s.grid.center()).collect();
    let zones = UtmZones::resolve(
        dataset.panoramas.iter().filter(|p| wanted(p.city)).map(|p| UtmZone::of(p.position)),
    )?;
    let project = |at: &LonLat| (UtmZone::of(*at), zones.project(UtmZone::of(*at), *at));
    let panorama_utm: Vec<_> = panoramas.par_iter().map(project).collect();
    let satellite_utm: Vec<_> = satellites.par_iter().map(project).collect();
    // Both in the panorama's zone: across the seam of two zones, eastings have nothing in common.
    let utm_of = |pair: &Pair| -> Option<(Projected, Projected)> {
        let (zone, panorama) = panorama_utm[pair.panorama as usize];
        let (own_zone, satellite) = satellite_utm[pair.satellite as usize];
        let satellite = if own_zone == zone {
            satellite
        } else {
            zones.project(zone, satellites[pair.satellite as usize])
        };
        Some((panorama?, satellite?))
    };
    let pixel_sizes: Vec<[f64; 2]> = dataset
        .satellites
        .par_iter()
        .map(|s| ground_pixel_size(s.grid.center().lat_deg, s.grid.zoom()))
        .collect();

    let one = |pair: &Pair| {
        let image = &dataset.satellites[pair.satellite as usize];
        let (width, height) = (f64::from(image.grid.width()), f64::from(image.grid.height()));
        let pixel = image.grid.pixel(panoramas[pair.panorama as usize]);
        let utm = resolutions[image.city as usize].and_then(|resolution| {
            let (panorama, satellite) = utm_of(pair)?;
            Some(corrected_offset(panorama, satellite, resolution))
        });
        let is_inside = |p: PixelPoint| (0.0..width).contains(&p.x) && (0.0..height).contains(&p.y);
        let label =
            pair.offset.map(|[d0, d1]| PixelPoint { x: width / 2.0 - d1, y: height / 2.0 + d0 });
        let residual = label.map(|label| {
            let (x_px, y_px) = (label.x - pixel.x, label.y - pixel.y);
            let [east, south] = pixel_sizes[pair.satellite as usize];
            let metres = libm::hypot(x_px * east, y_px * south);
            Residual { x_px, y_px, px: libm::hypot(x_px, y_px), metres }
        });
        Measured {
            pixel,
            inside: is_inside(pixel),
            label_inside: label.map(is_inside),
            utm,
            reproduced: pair.offset.zip(utm).map(|(label, utm)| label == utm.map(|d| d as f64)),
            residual,
        }
    };
    Ok(dataset.pairs.par_iter().map(one).collect())
}

/// The resolution that makes the UTM differences fit the labels best (least squares), metres per
/// pixel: what the labels assume, if they follow the formula. `None` without labels.
#[must_use]
pub fn fitted_resolution(pairs: impl Iterator<Item = ([f64; 2], [i64; 2], f64)>) -> Option<f64> {
    // utm pixels x resolution = metres; the rounding of both averages out over many labels.
    let (mut product, mut square) = (0.0, 0.0);
    for (label, utm, resolution) in pairs {
        for (label, utm) in label.into_iter().zip(utm) {
            product += label * utm as f64 * resolution;
            square += label * label;
        }
    }
    (square > 0.0).then(|| product / square)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixel_sizes_on_the_ellipsoid() {
        // At the equator the parallel has the sphere's radius, the meridian is 0.67 % tighter.
        let [east, north] = ground_pixel_size(0.0, 20);
        let world = 2.0 * PI * WGS84_A / 268_435_456.0;
        assert!((east / world - 1.0).abs() < 1e-15);
        assert!((north / east - (1.0 - 0.006_694_379_990_14)).abs() < 1e-12);
        // The resolutions behind the corrected labels are the size along the parallel, somewhere
        // in the city.
        for (lat, resolution) in
            [(47.61, 0.100_817), (40.72, 0.113_248), (37.77, 0.118_141), (41.88, 0.111_262)]
        {
            let [east, _] = ground_pixel_size(lat, 20);
            assert!((east / resolution - 1.0).abs() < 1e-3, "{lat}: {east}");
        }
    }

    #[test]
    fn the_meridian_agrees_with_a_geodesic() {
        // PROJ 9.1.1: echo 47.6 -122.3 47.601 -122.3 | geod +ellps=WGS84 -I -F %.6f
        let [_, north] = ground_pixel_size(47.6005, 20);
        let pixels_per_degree = 268_435_456.0 / 360.0 / libm::cos(47.6005_f64.to_radians());
        assert!((north * pixels_per_degree * 1e-3 - 111.182_546).abs() < 2e-6);
    }

    #[test]
    fn the_fit_finds_the_resolution_that_was_used() {
        // Labels made with 0.114 m where the formula used 0.1.
        let rows = (-50..50).map(|i| {
            let metres = f64::from(i) * 1.7;
            let label = metres / 0.114;
            let utm = (metres / 0.1).round() as i64;
            ([label, -label], [utm, -utm], 0.1)
        });
        let fitted = fitted_resolution(rows).expect("labels");
        assert!((fitted - 0.114).abs() < 2e-4, "{fitted}");
        assert_eq!(fitted_resolution(std::iter::empty()), None);
    }
}
