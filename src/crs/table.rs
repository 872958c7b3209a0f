//! The closed-form CRSs and the datum operations to WGS 84: EPSG's registry as PROJ computes with
//! it, in `epsg.tsv` and `operations.tsv` (written by `fixtures/crs/make_table.py`).

use super::ellipsoid::Ellipsoid;
use super::helmert::{Convention, Helmert};
use crate::units::LinearUnit;
use std::sync::LazyLock;

/// A geographic CRS on which the closed-form CRSs are based.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Base {
    /// EPSG code.
    pub code: u32,
    /// EPSG code of its datum or datum ensemble.
    pub datum: u32,
    /// Name.
    pub name: &'static str,
    /// Ellipsoid.
    pub ellipsoid: Ellipsoid,
}

/// The bases of the table.
pub(crate) const BASES: [Base; 6] = [
    base(4326, 6326, "WGS 84", Ellipsoid::WGS84),
    base(4269, 6269, "NAD83", Ellipsoid::GRS80),
    base(4152, 6152, "NAD83(HARN)", Ellipsoid::GRS80),
    base(4759, 6759, "NAD83(NSRS2007)", Ellipsoid::GRS80),
    base(6318, 1116, "NAD83(2011)", Ellipsoid::GRS80),
    base(4258, 6258, "ETRS89", Ellipsoid::GRS80),
];

const fn base(code: u32, datum: u32, name: &'static str, ellipsoid: Ellipsoid) -> Base {
    Base { code, datum, name, ellipsoid }
}

/// The base of an EPSG code.
pub(crate) fn base_by_code(code: u32) -> Option<&'static Base> {
    BASES.iter().find(|base| base.code == code)
}

/// A rectangle of longitudes and latitudes, degrees; west above east crosses the antimeridian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Area {
    west: f64,
    south: f64,
    east: f64,
    north: f64,
}

impl Area {
    /// From west, south, east, north.
    pub(crate) const fn new([west, south, east, north]: [f64; 4]) -> Self {
        Self { west, south, east, north }
    }

    /// West, south, east, north.
    pub(crate) const fn bounds(&self) -> [f64; 4] {
        [self.west, self.south, self.east, self.north]
    }

    fn width(&self) -> f64 {
        (self.east - self.west).rem_euclid(360.0)
    }

    /// Middle of the rectangle: longitude, latitude.
    pub(crate) fn centre(&self) -> (f64, f64) {
        let lon = super::ellipsoid::wrap_degrees(self.west + 0.5 * self.width());
        (lon, 0.5 * (self.south + self.north))
    }

    /// Whether a position lies in it.
    pub(crate) fn contains(&self, (lon, lat): (f64, f64)) -> bool {
        (lon - self.west).rem_euclid(360.0) <= self.width()
            && (self.south..=self.north).contains(&lat)
    }

    /// Whether two rectangles overlap.
    pub(crate) fn intersects(&self, other: &Self) -> bool {
        let gap = (other.west - self.west).rem_euclid(360.0);
        let meets = gap <= self.width() || 360.0 - gap <= other.width();
        meets && self.south <= other.north && other.south <= self.north
    }

    fn parse(text: &str) -> Option<Self> {
        let mut numbers = text.split(' ').map(str::parse);
        let mut next = || numbers.next()?.ok();
        Some(Self::new([next()?, next()?, next()?, next()?]))
    }
}

impl std::fmt::Display for Area {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [west, south, east, north] = self.bounds();
        write!(f, "{west} to {east} east, {south} to {north} north")
    }
}

/// Parameters of a projection as PROJ takes them: degrees and metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Method {
    /// Lambert conformal conic with one standard parallel (EPSG:9801).
    Conic1 { lat_0: f64, lon_0: f64, k_0: f64, x_0: f64, y_0: f64 },
    /// Lambert conformal conic with two standard parallels (EPSG:9802).
    Conic2 { lat_0: f64, lon_0: f64, lat_1: f64, lat_2: f64, x_0: f64, y_0: f64 },
    /// Transverse Mercator (EPSG:9807).
    TransverseMercator { lat_0: f64, lon_0: f64, k_0: f64, x_0: f64, y_0: f64 },
}

impl Method {
    fn parse(text: &str) -> Option<Self> {
        let get = |key: &str| -> Option<f64> {
            text.split(' ').find_map(|token| token.strip_prefix(key)?.parse().ok())
        };
        let (lat_0, lon_0) = (get("lat_0=")?, get("lon_0=")?);
        let (x_0, y_0) = (get("x_0=")?, get("y_0=")?);
        match (text.split(' ').next()?, get("lat_2=")) {
            ("tmerc", _) => {
                Some(Self::TransverseMercator { lat_0, lon_0, k_0: get("k=")?, x_0, y_0 })
            }
            ("lcc", None) => Some(Self::Conic1 { lat_0, lon_0, k_0: get("k_0=")?, x_0, y_0 }),
            ("lcc", Some(lat_2)) => {
                Some(Self::Conic2 { lat_0, lon_0, lat_1: get("lat_1=")?, lat_2, x_0, y_0 })
            }
            _ => None,
        }
    }

    /// Whether two sets of parameters mean the same projection to within 1 mm of the false origin
    /// and 1e-7 degrees (1 cm on the ground), which is how far software rounds what it writes.
    pub(crate) fn is_close_to(&self, other: &Self) -> bool {
        let angle = |a: f64, b: f64| (a - b).abs() < 1e-7;
        let scale = |a: f64, b: f64| (a - b).abs() < 1e-9;
        let length = |a: f64, b: f64| (a - b).abs() < 1e-3;
        match (*self, *other) {
            (
                Self::Conic1 { lat_0, lon_0, k_0, x_0, y_0 },
                Self::Conic1 { lat_0: p, lon_0: l, k_0: k, x_0: x, y_0: y },
            )
            | (
                Self::TransverseMercator { lat_0, lon_0, k_0, x_0, y_0 },
                Self::TransverseMercator { lat_0: p, lon_0: l, k_0: k, x_0: x, y_0: y },
            ) => {
                angle(lat_0, p)
                    && angle(lon_0, l)
                    && scale(k_0, k)
                    && length(x_0, x)
                    && length(y_0, y)
            }
            (
                Self::Conic2 { lat_0, lon_0, lat_1, lat_2, x_0, y_0 },
                Self::Conic2 { lat_0: p, lon_0: l, lat_1: a, lat_2: b, x_0: x, y_0: y },
            ) => {
                // Either parallel may be called the first.
                let parallels =
                    (angle(lat_1, a) && angle(lat_2, b)) || (angle(lat_1, b) && angle(lat_2, a));
                parallels && angle(lat_0, p) && angle(lon_0, l) && length(x_0, x) && length(y_0, y)
            }
            _ => false,
        }
    }
}

/// The datum operation that PROJ prefers for a CRS where no grids are installed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Datum {
    /// The base is WGS 84.
    Same,
    /// PROJ knows none and takes the two datums for equal.
    Ballpark,
    /// EPSG code of the operation.
    Operation(u32),
}

/// One projected CRS of the table.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Entry {
    /// EPSG code.
    pub code: u32,
    /// The geographic CRS.
    pub base: &'static Base,
    /// Unit of both axes.
    pub unit: LinearUnit,
    /// Preferred datum operation.
    pub datum: Datum,
    /// Projection.
    pub method: Method,
    /// The projection as PROJ's parameters, without `+`, beginning with its name.
    pub projection: &'static str,
    /// Area of use.
    pub area: Area,
    /// EPSG code of the conversion (the zone).
    pub zone: u32,
    /// Name of the conversion.
    pub zone_name: &'static str,
    /// Name of the CRS.
    pub name: &'static str,
    /// ESRI's name of the CRS.
    pub esri_name: Option<&'static str>,
}

impl Entry {
    fn parse(line: &'static str) -> Option<Self> {
        let mut fields = line.split('\t');
        let mut next = || fields.next();
        Some(Self {
            code: next()?.parse().ok()?,
            base: base_by_code(next()?.parse().ok()?)?,
            unit: LinearUnit::from_name(next()?)?,
            datum: match next()? {
                "-" => Datum::Same,
                "ballpark" => Datum::Ballpark,
                code => Datum::Operation(code.parse().ok()?),
            },
            projection: next()?,
            method: Method::parse(line.split('\t').nth(4)?)?,
            area: Area::parse(next()?)?,
            zone: next()?.parse().ok()?,
            zone_name: next()?,
            name: next()?,
            esri_name: next().filter(|name| *name != "-"),
        })
    }
}

/// What a datum operation does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Step {
    /// Nothing: longitude and latitude stay.
    Null,
    /// Helmert, from the source datum to WGS 84; its parameters as PROJ writes them.
    Helmert(Helmert, &'static str),
    /// A grid file, named as PROJ names it.
    Grid(&'static str),
}

/// A datum operation to WGS 84.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Operation {
    /// EPSG code.
    pub code: u32,
    /// EPSG code of the source geographic CRS.
    pub source: u32,
    /// Stated accuracy, metres.
    pub accuracy_m: f64,
    /// What it does.
    pub step: Step,
    /// Area of use.
    pub area: Area,
    /// Name.
    pub name: &'static str,
}

impl Operation {
    fn parse(line: &'static str) -> Option<Self> {
        let mut fields = line.split('\t');
        let mut next = || fields.next();
        Some(Self {
            code: next()?.parse().ok()?,
            source: next()?.parse().ok()?,
            accuracy_m: next()?.parse().ok()?,
            step: match next()? {
                "null" => Step::Null,
                what => match what.split_once(' ')? {
                    ("helmert", parameters) => Step::Helmert(helmert(parameters)?, parameters),
                    ("grid", name) => Step::Grid(name),
                    _ => return None,
                },
            },
            area: Area::parse(next()?)?,
            name: next()?,
        })
    }
}

fn helmert(text: &str) -> Option<Helmert> {
    let get = |key: &str| -> f64 {
        let value = text.split(' ').find_map(|token| token.strip_prefix(key)?.parse().ok());
        value.unwrap_or(0.0)
    };
    let convention = match text.split(' ').find_map(|token| token.strip_prefix("convention=")) {
        Some("position_vector") => Convention::PositionVector,
        // Without rotations neither is stated, and neither matters.
        Some("coordinate_frame") | None => Convention::CoordinateFrame,
        Some(_) => return None,
    };
    Some(Helmert {
        translation_m: [get("x="), get("y="), get("z=")],
        rotation_arcsec: [get("rx="), get("ry="), get("rz=")],
        scale_ppm: get("s="),
        convention,
    })
}

const EPSG_TSV: &str = include_str!("epsg.tsv");
const OPERATIONS_TSV: &str = include_str!("operations.tsv");

fn rows(text: &'static str) -> impl Iterator<Item = &'static str> {
    text.lines().filter(|line| !line.starts_with('#'))
}

/// All CRSs, in the order of their codes.
pub(crate) static ENTRIES: LazyLock<Vec<Entry>> =
    LazyLock::new(|| rows(EPSG_TSV).filter_map(Entry::parse).collect());

/// All operations, in the order of their codes.
pub(crate) static OPERATIONS: LazyLock<Vec<Operation>> =
    LazyLock::new(|| rows(OPERATIONS_TSV).filter_map(Operation::parse).collect());

/// The CRS of an EPSG code.
pub(crate) fn entry(code: u32) -> Option<&'static Entry> {
    let at = ENTRIES.binary_search_by_key(&code, |entry| entry.code).ok()?;
    ENTRIES.get(at)
}

/// The operation of an EPSG code.
pub(crate) fn operation(code: u32) -> Option<&'static Operation> {
    let at = OPERATIONS.binary_search_by_key(&code, |operation| operation.code).ok()?;
    OPERATIONS.get(at)
}

/// EPSG codes of every CRS that the closed forms serve, ascending.
pub fn closed_form_codes() -> impl Iterator<Item = u32> {
    ENTRIES.iter().map(|entry| entry.code)
}

/// Area of use of a CRS of the table: west, south, east, north, degrees; west above east crosses the
/// antimeridian.
#[must_use]
pub fn area_of_use(epsg: u32) -> Option<[f64; 4]> {
    entry(epsg).map(|entry| entry.area.bounds())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_of_both_tables_is_understood() {
        assert_eq!(ENTRIES.len(), rows(EPSG_TSV).count());
        assert_eq!(OPERATIONS.len(), rows(OPERATIONS_TSV).count());
        assert!(ENTRIES.len() > 1_500);
        assert!(ENTRIES.is_sorted_by_key(|entry| entry.code));
        assert!(OPERATIONS.is_sorted_by_key(|operation| operation.code));
        for entry in ENTRIES.iter() {
            if let Datum::Operation(code) = entry.datum {
                let operation = operation(code).expect("every operation of a CRS is listed");
                assert_eq!(operation.source, entry.base.code, "{}", entry.code);
                assert!(!matches!(operation.step, Step::Grid(_)), "{}", entry.code);
                assert!(operation.area.intersects(&entry.area), "{}", entry.code);
            }
        }
    }

    #[test]
    fn washington_is_complete_and_in_the_right_feet() {
        let units: Vec<_> = [2926, 2927, 2285, 2286, 6596, 6597, 6598, 6599, 2855, 2856]
            .map(|code| entry(code).expect("listed"))
            .map(|entry| (entry.unit, entry.base.code))
            .into();
        let (m, ft) = (LinearUnit::Metre, LinearUnit::UsSurveyFoot);
        let expected = [
            (ft, 4152),
            (ft, 4152),
            (ft, 4269),
            (ft, 4269),
            (m, 6318),
            (ft, 6318),
            (m, 6318),
            (ft, 6318),
            (m, 4152),
            (m, 4152),
        ];
        assert_eq!(units, expected);
    }

    #[test]
    fn utm_zones_are_complete() {
        for zone in 1..=60 {
            assert!(entry(32_600 + zone).is_some() && entry(32_700 + zone).is_some());
        }
        let rest = (26_901..=26_923).chain(25_828..=25_838).chain(3_740..=3_750);
        for code in rest.chain(6_328..=6_348).filter(|c| *c != 25_838) {
            assert!(entry(code).is_some(), "{code}");
        }
    }

    #[test]
    fn areas_may_cross_the_antimeridian() {
        let fiji = Area::new([177.0, -20.0, -178.0, -12.0]);
        assert!(fiji.contains((179.0, -15.0)) && fiji.contains((-179.0, -15.0)));
        assert!(!fiji.contains((0.0, -15.0)) && !fiji.contains((179.0, 0.0)));
        assert!((fiji.centre().0 - 179.5).abs() < 1e-12);
        let east = Area::new([-180.0, -30.0, -170.0, 0.0]);
        assert!(fiji.intersects(&east) && east.intersects(&fiji));
        assert!(!fiji.intersects(&Area::new([0.0, -30.0, 10.0, 0.0])));
    }
}
