//! A CRS of the table as a function: datum step, projection, unit.

use super::conic::LambertConic;
use super::ellipsoid::Ellipsoid;
use super::helmert::DatumStep;
use super::scale::ground_distance_m;
use super::table::{Entry, Method, Operation, Step};
use super::transverse_mercator::TransverseMercator;
use super::{CrsError, OperationInfo, Projection};
use crate::grid::{LonLat, Projected};
use crate::units::LinearUnit;
use std::fmt::Write;

/// Provider that [`OperationInfo`] names for closed forms.
pub(crate) const PROVIDER: &str = "closed form";

/// The datum step that a run takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Chosen {
    /// The CRS is on WGS 84 itself.
    Same,
    /// Datums are taken for equal: PROJ's ballpark, or the step is left out on purpose.
    Ballpark,
    /// An operation of the table.
    Operation(&'static Operation),
}

#[derive(Clone, Debug, PartialEq)]
enum Projector {
    Conic(LambertConic),
    TransverseMercator(TransverseMercator),
}

/// Closed-form way from WGS 84 to a projected CRS.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ClosedForm {
    /// From the CRS's own datum to WGS 84.
    step: Option<DatumStep>,
    projector: Projector,
    metres_per_unit: f64,
}

impl ClosedForm {
    pub(crate) fn new(entry: &Entry, chosen: Chosen) -> Result<Self, CrsError> {
        let ellipsoid = entry.base.ellipsoid;
        let projector = match entry.method {
            Method::Conic1 { lat_0, lon_0, k_0, x_0, y_0 } => Projector::Conic(
                LambertConic::one_parallel(ellipsoid, (lat_0, lon_0), k_0, (x_0, y_0))?,
            ),
            Method::Conic2 { lat_0, lon_0, lat_1, lat_2, x_0, y_0 } => {
                let (origin, parallels) = ((lat_0, lon_0), (lat_1, lat_2));
                Projector::Conic(LambertConic::two_parallels(
                    ellipsoid,
                    origin,
                    parallels,
                    (x_0, y_0),
                )?)
            }
            Method::TransverseMercator { lat_0, lon_0, k_0, x_0, y_0 } => {
                Projector::TransverseMercator(TransverseMercator::new(
                    ellipsoid,
                    (lat_0, lon_0),
                    k_0,
                    (x_0, y_0),
                )?)
            }
        };
        let step = match chosen {
            Chosen::Operation(Operation { step: Step::Helmert(helmert, _), .. }) => {
                Some(DatumStep::new(ellipsoid, Ellipsoid::WGS84, *helmert))
            }
            _ => None,
        };
        Ok(Self { step, projector, metres_per_unit: entry.unit.metres_per_unit() })
    }

    /// How far the datum step moves a position, metres on the ground.
    fn shift_m(&self, at: LonLat) -> Result<f64, CrsError> {
        match &self.step {
            Some(step) => Ok(ground_distance_m(at, step.inverse(at)?)),
            None => Ok(0.0),
        }
    }
}

impl Projection for ClosedForm {
    fn forward(&self, at: LonLat) -> Result<Projected, CrsError> {
        let at = match &self.step {
            Some(step) => step.inverse(at)?,
            None => at,
        };
        let metres = match &self.projector {
            Projector::Conic(conic) => conic.forward(at)?,
            Projector::TransverseMercator(mercator) => mercator.forward(at)?,
        };
        Ok(Projected { x: metres.x / self.metres_per_unit, y: metres.y / self.metres_per_unit })
    }

    fn inverse(&self, at: Projected) -> Result<LonLat, CrsError> {
        let metres = Projected { x: at.x * self.metres_per_unit, y: at.y * self.metres_per_unit };
        let at = match &self.projector {
            Projector::Conic(conic) => conic.inverse(metres)?,
            Projector::TransverseMercator(mercator) => mercator.inverse(metres)?,
        };
        match &self.step {
            Some(step) => step.forward(at),
            None => Ok(at),
        }
    }
}

/// What goes into manifests about a closed form; `around` are the positions at which the datum
/// shift is measured.
pub(crate) fn operation_info(
    entry: &Entry,
    chosen: Chosen,
    closed: &ClosedForm,
    around: &[LonLat],
) -> Result<OperationInfo, CrsError> {
    let zone = entry.zone_name;
    let (name, code, accuracy_m) = match chosen {
        Chosen::Same => (zone.to_owned(), None, Some(0.0)),
        Chosen::Ballpark => {
            let base = entry.base.name;
            (format!("Ballpark geographic offset from WGS 84 to {base} + {zone}"), None, None)
        }
        Chosen::Operation(step) => {
            (format!("Inverse of {} + {zone}", step.name), Some(step.code), Some(step.accuracy_m))
        }
    };
    let mut datum_shift_m = 0.0_f64;
    for at in around {
        datum_shift_m = datum_shift_m.max(closed.shift_m(*at)?);
    }
    Ok(OperationInfo {
        name,
        code,
        accuracy_m,
        grids: Vec::new(),
        definition: pipeline(entry, chosen),
        datum_shift_m,
        provider: PROVIDER.to_owned(),
    })
}

/// The closed form as a PROJ pipeline, from longitude and latitude in degrees to the CRS's unit.
pub(crate) fn pipeline(entry: &Entry, chosen: Chosen) -> String {
    let ellipsoid = entry.base.ellipsoid.proj_name();
    let mut text = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad".to_owned();
    if let Chosen::Operation(Operation { step: Step::Helmert(_, parameters), .. }) = chosen {
        text.push_str(
            " +step +proj=push +v_3 +step +proj=cart +ellps=WGS84 +step +inv +proj=helmert",
        );
        push_parameters(&mut text, parameters);
        // Writing to a string cannot fail.
        let _ = write!(text, " +step +inv +proj=cart +ellps={ellipsoid} +step +proj=pop +v_3");
    }
    let (name, parameters) = entry.projection.split_once(' ').unwrap_or((entry.projection, ""));
    let _ = write!(text, " +step +proj={name}");
    push_parameters(&mut text, parameters);
    let _ = write!(text, " +ellps={ellipsoid}");
    let unit = match entry.unit {
        LinearUnit::Metre => return text,
        LinearUnit::Foot => "ft",
        LinearUnit::UsSurveyFoot => "us-ft",
    };
    let _ = write!(text, " +step +proj=unitconvert +xy_in=m +xy_out={unit}");
    text
}

fn push_parameters(text: &mut String, parameters: &str) {
    for parameter in parameters.split(' ').filter(|p| !p.is_empty()) {
        text.push_str(" +");
        text.push_str(parameter);
    }
}

#[cfg(test)]
mod tests {
    use crate::crs::{CrsSpec, ResolveOptions, ResolvedCrs, resolve};
    use crate::grid::{LonLat, Projected};

    const SEATTLE: LonLat = LonLat { lon_deg: -122.33, lat_deg: 47.61 };

    fn crs(code: u32) -> ResolvedCrs {
        let area = Some([SEATTLE.lon_deg, SEATTLE.lat_deg, SEATTLE.lon_deg, SEATTLE.lat_deg]);
        let options = ResolveOptions { area, ..ResolveOptions::default() };
        resolve(&CrsSpec::from_epsg(code), &options).expect("in the table")
    }

    #[test]
    fn units_change_the_numbers_and_not_the_place() {
        // Washington South on NAD83(HARN) in metres and in US survey feet.
        let (metres, feet) = (crs(2856), crs(2927));
        let m = metres.projection.forward(SEATTLE).expect("in the domain");
        let ft = feet.projection.forward(SEATTLE).expect("in the domain");
        // The false easting in feet is rounded: 1640416.667 for 500000 m.
        let false_easting = 1_640_416.667 * 1200.0 / 3937.0 - 500_000.0;
        assert!((ft.x * 1200.0 / 3937.0 - m.x - false_easting).abs() < 1e-8, "{ft:?} {m:?}");
        assert!((ft.y * 1200.0 / 3937.0 - m.y).abs() < 1e-8, "{ft:?} {m:?}");
        for (crs, at) in [(metres, m), (feet, ft)] {
            let back = crs.projection.inverse(at).expect("in the domain");
            assert!((back.lon_deg - SEATTLE.lon_deg).abs() < 1e-10, "{back:?}");
            assert!((back.lat_deg - SEATTLE.lat_deg).abs() < 1e-10, "{back:?}");
            let nowhere = Projected { x: f64::NAN, y: at.y };
            assert!(crs.projection.inverse(nowhere).is_err());
        }
    }

    #[test]
    fn the_datum_step_moves_by_what_it_says() {
        let harn = crs(2927);
        // docs/coordinates.md: 1.28 m in Seattle; on EPSG:2286, the same zone, the step is a null shift.
        assert!((harn.operation.datum_shift_m - 1.28).abs() < 0.01, "{:?}", harn.operation);
        let null = crs(2286);
        assert_eq!(null.operation.datum_shift_m, 0.0);
        let at = |crs: &ResolvedCrs| crs.projection.forward(SEATTLE).expect("in the domain");
        let (a, b) = (at(&harn), at(&null));
        let apart = libm::hypot(a.x - b.x, a.y - b.y) * 1200.0 / 3937.0;
        assert!((apart - harn.operation.datum_shift_m).abs() < 1e-3, "{apart}");
    }
}
